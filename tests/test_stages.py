"""Photographs in, COLMAP model out: the whole chain, again, interrupted, and on bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import start
from numpy.testing import assert_array_equal
from results import database_content, hdf5_content
from small_scene import IMAGE_SIZE, INTRINSICS, NAMES, photograph, write_photographs
from synthetic import write_image

from colmap_affrect import stages
from colmap_affrect.cli import main
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.errors import DatabaseError, StoreError
from colmap_affrect.options import CameraOptions, VerificationOptions
from colmap_affrect.outcomes import ReconstructionReport
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.recipes import load_recipe
from colmap_affrect.store import FeatureStore, MatchStore, pair_key
from colmap_affrect.workspace import Workspace

CAMERAS = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)
CAMERA_ARGUMENTS = [
    "--camera-mode", "single", "--camera-model", "PINHOLE", "--camera-params", INTRINSICS,
]  # fmt: skip
OPTIONS = RunOptions(cameras=CAMERAS, random_seed=3)
FAST = ["--recipe", "unrectified-rootsift", *CAMERA_ARGUMENTS]

DIGITS = 9
"""Means over a model that was read back may differ from those before in the last digits."""


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos č")
    write_photographs(folder)
    return folder


@pytest.fixture(scope="module")
def finished(
    photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Workspace, ReconstructionReport]:
    """A run of all four photographs; nothing may be changed in it."""
    path = tmp_path_factory.mktemp("finished") / "out"
    return Workspace(path), run(photos, path, OPTIONS)


@pytest.fixture
def copy(finished: tuple[Workspace, ReconstructionReport], tmp_path: Path) -> Workspace:
    """A copy of the finished run, to be changed."""
    return Workspace(Path(shutil.copytree(finished[0].path, tmp_path / "copy")))


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, list[str]]]:
    """Run the command line here; returns the exit code, stdout, and the lines of stderr."""

    def run_command(*arguments: object) -> tuple[int, str, list[str]]:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return code, captured.out, captured.err.splitlines()

    return run_command


Call = Callable[..., tuple[int, str, list[str]]]


def without_times(report: dict[str, object]) -> dict[str, object]:
    """What a report says beside its times; means depend on the order of summation."""
    return {
        key: round(value, DIGITS) if isinstance(value, float) else value
        for key, value in report.items()
        if key != "stages"
    }


def test_run_registers_all_photographs(finished: tuple[Workspace, ReconstructionReport]) -> None:
    _, report = finished
    assert report.status == "ok"
    assert report.registered_names == tuple(sorted(NAMES))
    assert report.unregistered == {}
    assert (report.num_pairs, report.num_verified_pairs) == (6, 6)
    assert report.models[0].num_points3D > 300
    assert 2.0 <= report.models[0].mean_track_length <= 4.0
    assert 0.0 < report.models[0].mean_reprojection_error_px < 1.0


def test_run_leaves_all_results(finished: tuple[Workspace, ReconstructionReport]) -> None:
    workspace, report = finished
    assert {
        "config.toml", "database.db", "features.h5", "matches.h5", "pairs.txt", "report.json",
        "sparse",
    } <= {path.name for path in workspace.path.iterdir()}  # fmt: skip
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    names = sorted(model.images[image_id].name for image_id in model.reg_image_ids())
    assert names == list(report.registered_names)
    (camera,) = model.cameras.values()
    assert camera.params.tolist() == [float(value) for value in INTRINSICS.split(",")]
    assert (camera.width, camera.height) == IMAGE_SIZE
    assert len(workspace.pairs.read_text(encoding="utf-8").splitlines()) == 6
    assert list(workspace.recorded()) == ["recipe", "extract", "pairs", "match", "verify", "map"]


def test_report_file_has_the_promised_keys(
    finished: tuple[Workspace, ReconstructionReport],
) -> None:
    workspace, report = finished
    read = json.loads(workspace.report.read_text(encoding="utf-8"))
    assert read == json.loads(report.to_json())
    assert {
        "status", "images_total", "images_registered", "registered_names", "unregistered",
        "num_models", "points3D", "mean_track_length", "mean_reprojection_error_px", "stages",
        "recipe", "random_seed", "versions",
    } <= set(read)  # fmt: skip
    assert [stage["name"] for stage in read["stages"]] == [
        "extract", "pairs", "match", "verify", "map",
    ]  # fmt: skip
    assert all(stage["wall_s"] >= 0.0 for stage in read["stages"])
    assert (read["recipe"], read["random_seed"]) == ("default", 3)
    assert read["versions"]["pycolmap"].startswith("4.")


def test_keypoints_in_the_database_are_those_of_the_store_plus_half_a_pixel(
    finished: tuple[Workspace, ReconstructionReport],
) -> None:
    workspace, _ = finished
    ids = image_ids(workspace.database)
    assert sorted(ids) == sorted(NAMES)
    with h5py.File(workspace.features, "r") as file, open_database(workspace.database) as database:
        for name in NAMES:
            keypoints = database.read_keypoints(ids[name])
            assert len(keypoints) > 500
            assert_array_equal(keypoints[:, :2], file[name]["keypoints"][()] + np.float32(0.5))


def test_matches_in_the_database_are_those_of_the_store(
    finished: tuple[Workspace, ReconstructionReport],
) -> None:
    workspace, _ = finished
    ids = image_ids(workspace.database)
    pairs = [tuple(line.split("\t")) for line in workspace.pairs.read_text().splitlines()]
    with open_database(workspace.database) as database:
        stored = MatchStore(workspace.matches).read_indices(pairs)
        for (name1, name2), indices in zip(pairs, stored, strict=True):
            assert len(indices) > 50
            assert_array_equal(database.read_matches(ids[name1], ids[name2]), indices)


def test_stage_commands_do_exactly_what_run_does(
    finished: tuple[Workspace, ReconstructionReport], photos: Path, tmp_path: Path, call: Call
) -> None:
    expected, _ = finished
    out = ["--output-path", tmp_path / "out"]
    seed = ["--random-seed", 3]
    for command in (
        ["extract", "--image-path", photos, *CAMERA_ARGUMENTS],
        ["pairs"],
        ["match"],
        ["verify", *seed],
        ["map", *seed],
    ):
        code, stdout, stderr = call(command[0], *out, *command[1:])
        assert code == 0, stderr
        assert stdout
    made = Workspace(tmp_path / "out")
    assert hdf5_content(made.features) == hdf5_content(expected.features)
    assert hdf5_content(made.matches) == hdf5_content(expected.matches)
    assert made.pairs.read_bytes() == expected.pairs.read_bytes()
    assert made.config.read_bytes() == expected.config.read_bytes()
    assert image_ids(made.database) == image_ids(expected.database)
    assert database_content(made.database) == database_content(expected.database)
    reports = [json.loads(space.report.read_text(encoding="utf-8")) for space in (made, expected)]
    assert without_times(reports[0]) == without_times(reports[1])


def test_run_again_does_nothing_twice(copy: Workspace, photos: Path) -> None:
    before = {path: path.read_bytes() for path in (copy.features, copy.matches, copy.pairs)}
    model = (copy.sparse / "0" / "points3D.bin").stat().st_mtime_ns
    tables = database_content(copy.database)
    report = run(photos, copy.path, OPTIONS)
    done = {stage.name: (stage.num_done, stage.num_kept) for stage in report.stages}
    assert done == {
        "extract": (0, 4), "pairs": (6, 0), "match": (0, 6), "verify": (0, 6), "map": (0, 1),
    }  # fmt: skip
    assert report.status == "ok"
    assert {path: path.read_bytes() for path in before} == before
    assert (copy.sparse / "0" / "points3D.bin").stat().st_mtime_ns == model
    assert database_content(copy.database) == tables


@pytest.mark.parametrize("name", NAMES[1:3])
def test_image_whose_features_are_lost_gets_the_same_again(
    finished: tuple[Workspace, ReconstructionReport], copy: Workspace, photos: Path, name: str
) -> None:
    expected, first = finished
    with h5py.File(copy.features, "a") as file:
        del file[name]
    report = run(photos, copy.path, OPTIONS)
    assert (report.stages[0].num_done, report.stages[0].num_kept) == (1, 3)
    assert hdf5_content(copy.features) == hdf5_content(expected.features)
    assert without_times(report.to_mapping()) == without_times(first.to_mapping())


@pytest.mark.long
@pytest.mark.parametrize("line", ["extract: 2/4 images", "match: 3/6 pairs", "verify: 6/6 pairs"])
def test_run_killed_anywhere_completes_with_the_same_result(
    finished: tuple[Workspace, ReconstructionReport], photos: Path, tmp_path: Path, line: str
) -> None:
    expected, first = finished
    out = tmp_path / "out"
    with start(
        "run", "--image-path", photos, "--output-path", out, "--random-seed", 3, *CAMERA_ARGUMENTS
    ) as process:
        while process.stderr.readline().strip() != line:
            assert process.poll() is None
        os.kill(process.pid, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not Workspace(out).report.exists()
    report = run(photos, out, OPTIONS)
    assert hdf5_content(Workspace(out).features) == hdf5_content(expected.features)
    assert hdf5_content(Workspace(out).matches) == hdf5_content(expected.matches)
    assert database_content(Workspace(out).database) == database_content(expected.database)
    assert without_times(report.to_mapping()) == without_times(first.to_mapping())
    assert report.stages[0].num_kept >= 2


@pytest.mark.long
def test_image_added_later_is_picked_up_and_the_others_are_kept(tmp_path: Path) -> None:
    photos, workspace = tmp_path / "photos", Workspace(tmp_path / "out")
    options = RunOptions(recipe=load_recipe("unrectified-rootsift"), cameras=CAMERAS)
    write_photographs(photos, 3)
    first = run(photos, workspace.path, options)
    assert first.images_total == len(first.registered_names) == 3
    before = hdf5_content(workspace.features) | hdf5_content(workspace.matches)
    write_photographs(photos, 4)
    report = run(photos, workspace.path, options)
    done = {stage.name: (stage.num_done, stage.num_kept) for stage in report.stages}
    assert (done["extract"], done["match"], done["verify"]) == ((1, 3), (3, 3), (3, 3))
    after = hdf5_content(workspace.features) | hdf5_content(workspace.matches)
    assert {key: after[key] for key in before} == before
    assert report.registered_names == tuple(sorted(NAMES))


@pytest.fixture
def trio(tmp_path: Path) -> Path:
    """Three photographs in a folder of their own, to be mixed with bad input."""
    write_photographs(tmp_path / "trio", 3)
    return tmp_path / "trio"


@pytest.mark.parametrize("content", [b"", b"no image at all"])
def test_unreadable_image_is_reported_and_the_run_goes_on(
    trio: Path, tmp_path: Path, call: Call, content: bytes
) -> None:
    (trio / "broken.jpg").write_bytes(content)
    arguments = ["run", "--image-path", trio, "--output-path", tmp_path / "out", *FAST]
    code, stdout, stderr = call(*arguments)
    assert code == 1
    assert stderr[-1] == "error: could not read 1 of the images: broken.jpg"
    assert sum(line.startswith("error:") for line in stderr) == 1
    assert any("broken.jpg: not a readable image" in line for line in stderr[:-1])
    assert "registered  3 of 4 images" in stdout
    assert "not broken.jpg: unreadable" in stdout
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["unregistered"] == {"broken.jpg": "unreadable"}
    assert report["status"] == "partial"
    code, _, stderr = call(*arguments, "--max-failures", 1)
    assert code == 0
    assert not any(line.startswith("error:") for line in stderr)


def test_folder_of_unreadable_images_only_is_one_clear_line(tmp_path: Path, call: Call) -> None:
    for name in ("a.png", "b.jpg"):
        (tmp_path / name).write_bytes(b"text")
    code, stdout, stderr = call(
        "run", "--image-path", tmp_path, "--output-path", tmp_path / "o", "-q"
    )
    assert (code, stdout) == (1, "")
    assert stderr == [
        f"error: {tmp_path}: none of the 2 images can be used; the first: {tmp_path / 'a.png'}: "
        "not a readable image (damaged, empty, or of an unknown format)"
    ]


def test_blank_image_has_no_features_and_the_run_goes_on(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    write_image(trio / "blank.png", np.full(IMAGE_SIZE[::-1], 128, np.uint8))
    code, stdout, stderr = call(
        "run", "--image-path", trio, "--output-path", tmp_path / "out", *CAMERA_ARGUMENTS, "--json"
    )
    assert code == 0, stderr
    report = json.loads(stdout)
    assert report["unregistered"] == {"blank.png": "no features"}
    assert report["images_registered"] == 3
    assert (report["num_pairs"], report["num_verified_pairs"]) == (6, 3)
    assert FeatureStore(tmp_path / "out" / "features.h5").num_keypoints()["blank.png"] == 0
    assert any("blank.png: no features" in line for line in stderr)


def test_image_of_another_place_has_no_verified_pair(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    write_image(trio / "elsewhere.png", photograph((0.0, 0.0, 0.0), 0.0)[::-1, ::-1].T[:240, :240])
    code, stdout, _ = call(
        "run", "--image-path", trio, "--output-path", tmp_path / "out", "--json",
        "--recipe", "unrectified-rootsift",
        "--match-list-path", _list(tmp_path, "a.png", "b c.png"),
    )  # fmt: skip
    report = json.loads(stdout)
    assert report["num_pairs"] == 1
    assert report["unregistered"]["elsewhere.png"] == "no verified pair"
    assert code in (0, 3)


def _list(folder: Path, *names: str) -> Path:
    """A pair list of one pair."""
    path = folder / "list.txt"
    path.write_text("\t".join(names) + "\n", encoding="utf-8")
    return path


def test_one_image_ends_without_a_model(tmp_path: Path, call: Call) -> None:
    write_photographs(tmp_path / "photos", 1)
    out = tmp_path / "out"
    code, stdout, stderr = call(
        "run", "--image-path", tmp_path / "photos", "--output-path", out, *FAST, "-q"
    )
    assert code == 3
    assert stderr == [f"error: one image cannot make a model; see {out / 'report.json'}"]
    assert "registered  0 of 1 images" in stdout
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert (report["status"], report["num_models"], report["num_pairs"]) == ("no_model", 0, 0)
    assert report["unregistered"] == {"a.png": "no verified pair"}


def test_images_without_overlap_end_without_a_model(tmp_path: Path, call: Call) -> None:
    rng = np.random.default_rng(0)
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, rng.integers(0, 256, (120, 160), dtype=np.uint8))
    code, _, stderr = call("run", "--image-path", tmp_path, "--output-path", tmp_path / "o", "-q")
    assert code == 3
    assert stderr == [f"error: no model was found; see {tmp_path / 'o' / 'report.json'}"]


def test_bad_input_is_one_clear_line_and_writes_no_results(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("no image")
    cases = [
        (["--image-path", empty], f"{empty}: holds no images (.jpg"),
        (["--image-path", tmp_path / "none"], "none: no such folder"),
        (["--image-path", trio, "--camera-model", "PINHOL"], "--camera-model PINHOL: not one of"),
        (
            ["--image-path", trio, "--camera-model", "PINHOLE", "--camera-params", "1,2,3"],
            "--camera-params: PINHOLE needs 4 values (fx, fy, cx, cy), not 3",
        ),
        (["--image-path", trio, "--camera-params", "f,1,2,3"], "--camera-params f,1,2,3: not num"),
        (["--image-path", trio, "--recipe", "defualt"], "did you mean 'default'"),
        (["--image-path", trio, "--set", "features.x=1"], "unknown option 'x'"),
        (["--image-path", trio, "--image-list-path", tmp_path / "none"], "none: cannot be read"),
    ]
    for arguments, message in cases:
        code, stdout, stderr = call("run", "--output-path", tmp_path / "out", *arguments)
        assert (code, stdout, len(stderr)) == (1, "", 1), stderr
        assert stderr[0].startswith("error: ")
        assert message in stderr[0]
        assert {path.name for path in (tmp_path / "out").iterdir()} <= {".lock", "run.log"}


@pytest.mark.parametrize("mode", ["single", "per-folder"])
def test_images_of_different_sizes_cannot_share_a_camera(
    trio: Path, tmp_path: Path, call: Call, mode: str
) -> None:
    write_image(trio / "side" / "z.png", photograph((0.0, 0.0, 0.0), 0.0)[:, :300])
    out = tmp_path / "out"
    arguments = ["extract", "--image-path", trio, "--output-path", out]
    code, _, stderr = call(*arguments, "--camera-mode", mode)
    assert code == 1
    other = {"single": "a.png", "per-folder": "side/č.png"}[mode]
    places = {"single": "side/z.png", "per-folder": "side/č.png"}
    assert len(stderr) == 1
    assert stderr[0].startswith(f"error: --camera-mode {mode}: ")
    assert "320 x 240 px" in stderr[0]
    assert "300 x 240 px" in stderr[0]
    assert other in stderr[0] or places[mode] in stderr[0]
    assert not Workspace(out).config.exists()
    # The same folder works with another mode, without --overwrite.
    code, _, stderr = call(*arguments, "--recipe", "unrectified-rootsift")
    assert code == 0, stderr
    assert len(image_ids(Workspace(out).database)) == 4


def test_folders_of_different_sizes_work_with_a_camera_per_folder(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    (trio / "other").mkdir()
    write_image(trio / "other" / "z.png", photograph((0.0, 0.0, 0.0), 0.0)[:, :300])
    code, _, stderr = call(
        "extract", "--image-path", trio, "--output-path", tmp_path / "out",
        "--camera-mode", "per-folder", "--recipe", "unrectified-rootsift",
    )  # fmt: skip
    assert code == 0, stderr
    with open_database(tmp_path / "out" / "database.db") as database:
        widths = sorted(camera.width for camera in database.read_all_cameras())
    assert widths == [300, 320, 320]


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_database_of_another_program_is_refused_and_left_as_it_is(
    trio: Path, tmp_path: Path, call: Call, overwrite: list[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with pycolmap.Database.open(out / "database.db") as database:
        database.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 9.0, 8, 6))
    before = (out / "database.db").read_bytes()
    for command in ("run", "extract"):
        code, stdout, stderr = call(
            command, "--image-path", trio, "--output-path", out, *FAST, *overwrite
        )
        assert (code, stdout, len(stderr)) == (1, "", 1)
        assert "database.db: exists and was not made here" in stderr[0]
        assert (out / "database.db").read_bytes() == before


def test_output_folder_in_use_is_refused(copy: Workspace, photos: Path, call: Call) -> None:
    before = copy.features.read_bytes()
    out = ["--output-path", copy.path]
    with copy.locked():
        for command in (["run", "--image-path", photos, *CAMERA_ARGUMENTS], ["match"], ["map"]):
            code, stdout, stderr = call(*command, *out, "--overwrite")
            assert (code, stdout, len(stderr)) == (1, "", 1)
            assert "another colmap-affrect is working in this folder" in stderr[0]
    assert copy.features.read_bytes() == before
    assert copy.database.exists()


@pytest.mark.parametrize("below", ["file", "file/out"])
def test_output_folder_that_cannot_be_made_is_refused(
    trio: Path, tmp_path: Path, call: Call, below: str
) -> None:
    (tmp_path / "file").write_text("")
    code, stdout, stderr = call(
        "run", "--image-path", trio, "--output-path", tmp_path / below, *FAST
    )
    assert (code, stdout, len(stderr)) == (1, "", 1)
    assert str(tmp_path / below) in stderr[0]


def test_other_options_than_before_are_named(copy: Workspace, photos: Path, call: Call) -> None:
    out = ["--output-path", copy.path]
    images = ["--image-path", photos]
    cameras, seed = CAMERA_ARGUMENTS, ["--random-seed", 3]
    before = {path: path.read_bytes() for path in (copy.features, copy.matches, copy.config)}
    cases = [
        (["run", *images, *seed], "camera.mode"),
        (["run", *images, *seed, *cameras, "--set", "features.contrast_threshold=0.02"],
         "features.contrast_threshold=0.013, and it is 0.02"),
        (["run", *images, *seed, *cameras, "--set", "matching.max_ratio=0.7"], "max_ratio=0.85"),
        (["run", *images, *cameras], "random_seed=3, and it is 0"),
        (["run", *images, *seed, "--camera-mode", "single"], "camera.model='PINHOLE'"),
        (["run", "--image-path", photos / "side", *seed, *cameras], f"image_path='{photos}'"),
        (["run", *images, *seed, *cameras, "--match-list-path",
          _list(copy.path.parent, "a.png", "b c.png")], "match_list_path=''"),
        (["extract", *images, *cameras, "--recipe", "unrectified-rootsift"], "rectifier.name"),
        (["match", "--set", "matching.duplicate_radius_px=3"], "duplicate_radius_px=2.0"),
        (["verify"], "random_seed=3"),
        (["map", "--random-seed", 4], "random_seed=3, and it is 4"),
    ]  # fmt: skip
    for command, named in cases:
        code, stdout, stderr = call(*command, *out)
        assert (code, stdout, len(stderr)) == (1, "", 1), stderr
        assert named in stderr[0]
        assert "--overwrite" in stderr[0]
    assert {path: path.read_bytes() for path in before} == before


def test_overwrite_redoes_a_stage_and_run_goes_on_from_it(
    finished: tuple[Workspace, ReconstructionReport], copy: Workspace, call: Call
) -> None:
    features = copy.features.read_bytes()
    code, stdout, _ = call("match", "--overwrite", "--output-path", copy.path)
    assert (code, stdout.split(" in ")[0]) == (0, "match: 6 done")
    assert copy.features.read_bytes() == features
    assert not copy.sparse.exists()
    assert not database_content(copy.database)["inliers"]
    for stage in ("verify", "map"):
        code, _, stderr = call(stage, "--random-seed", 3, "--output-path", copy.path)
        assert code == 0, stderr
    assert database_content(copy.database) == database_content(finished[0].database)
    report = json.loads(copy.report.read_text(encoding="utf-8"))
    assert without_times(report) == without_times(finished[1].to_mapping())


@pytest.mark.parametrize("stage", ["pairs", "match", "verify", "map"])
def test_stage_before_its_turn_says_what_to_run(tmp_path: Path, call: Call, stage: str) -> None:
    code, stdout, stderr = call(stage, "--output-path", tmp_path)
    assert (code, stdout, len(stderr)) == (1, "", 1)
    assert "stage has not been run there; run 'colmap-affrect " in stderr[0]


def test_unknown_name_in_the_pair_list_is_one_clear_line(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    pair_list = _list(tmp_path, "a.png", "b d.png")
    code, stdout, stderr = call(
        "run", "--image-path", trio, "--output-path", tmp_path / "out", *FAST,
        "--match-list-path", pair_list, "-q",
    )  # fmt: skip
    assert (code, stdout, len(stderr)) == (1, "", 1)
    assert f"{pair_list}: names that are not among the images: line 1" in stderr[0]
    assert not Workspace(tmp_path / "out").pairs.exists()


def test_pair_list_may_name_an_image_that_cannot_be_read(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    (trio / "broken.png").write_bytes(b"text")
    pair_list = tmp_path / "list.txt"
    pair_list.write_text("broken.png a.png\na.png\tb c.png\n", encoding="utf-8")
    out = ["--output-path", tmp_path / "out"]
    recipe = ["--recipe", "unrectified-rootsift"]
    call("extract", "--image-path", trio, *out, *recipe)
    code, stdout, _ = call("pairs", *out, "--match-list-path", pair_list)
    assert (code, stdout.split(" in ")[0]) == (0, "pairs: 1 done")
    assert Workspace(tmp_path / "out").pairs.read_text() == "a.png\tb c.png\n"


def test_pair_list_that_lost_pairs_is_refused(copy: Workspace, call: Call) -> None:
    names = FeatureStore(copy.features).names()
    path = copy.path.parent / "list.txt"
    for lines, overwrite, expected in [
        ([names[:2], names[1:3]], ["--overwrite"], 0),
        ([names[:2], names[1:3], names[2:4]], [], 0),
        ([names[:2]], [], 1),
        ([names[:2]], ["--overwrite"], 0),
    ]:
        path.write_text("".join("\t".join(line) + "\n" for line in lines), encoding="utf-8")
        arguments = ["--output-path", copy.path, "--match-list-path", path, *overwrite]
        code, _, stderr = call("pairs", *arguments)
        assert code == expected, stderr
        if expected:
            assert names[1] in stderr[-1]
            assert "--overwrite" in stderr[-1]


def test_match_index_out_of_range_is_refused_before_it_is_written(copy: Workspace) -> None:
    pair = ("a.png", "b c.png")
    count = FeatureStore(copy.features).num_keypoints()[pair[1]]
    with h5py.File(copy.matches, "a") as file:
        file[pair_key(*pair)]["matches0"][3] = count
    copy.database.unlink()
    with pytest.raises(DatabaseError, match="point at keypoints that do not exist"):
        stages.verify_matches(copy, VerificationOptions(), 3)
    with sqlite3.connect(copy.database) as connection:
        assert connection.execute("SELECT count(*) FROM matches").fetchone() == (0,)
    connection.close()


def test_features_of_another_number_than_in_the_database_are_refused(
    copy: Workspace, photos: Path
) -> None:
    store = FeatureStore(copy.features)
    features = store.read("a.png")
    store.write("a.png", features.select(np.arange(10)), IMAGE_SIZE)
    with pytest.raises(DatabaseError, match=r"keypoints in the database and 10 in the"):
        run(photos, copy.path, OPTIONS)


def test_names_with_the_same_key_are_refused(tmp_path: Path) -> None:
    for name in ("wing/b-c.png", "wing-b/c.png"):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "photos" / name, photograph((0, 0, 0), 0))
    with pytest.raises(StoreError, match=r"wing-b/c\.png and wing/b-c\.png have the same key"):
        run(tmp_path / "photos", tmp_path / "out", OPTIONS)
    assert not Workspace(tmp_path / "out").features.exists()
