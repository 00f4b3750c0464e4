"""A comparison on a small scene: figures, files, failures, going on after a stop."""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest
from command import FAST, run_in_process_of_its_own, start
from small_scene import INTRINSICS, NAMES, write_photographs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.comparison import compare as module
from colmap_affrect.comparison.compare import CompareOptions, compare
from colmap_affrect.comparison.results import MEASURES, Comparison
from colmap_affrect.comparison.verdict import verdict
from colmap_affrect.errors import (
    ComparisonError,
    DeviceError,
    OptionError,
    StaleStoreError,
    WeightsError,
)
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context, Resources
from colmap_affrect.stages.guide import guided_counts

CAMERAS = CameraOptions(mode="per-image", model="PINHOLE", params=INTRINSICS)
NUM_IMAGES = 3
GIVEN = (*NAMES[:NUM_IMAGES], "broken.png")
METHODS = ("sift", "unrectified-rootsift", "depth-planes-recommended")
MIN_NUM_INLIERS = 20


def write_ground_truth(folder: Path, suffix: str = ".png") -> None:
    """Write the true poses of the small scene as a COLMAP model."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 300.0, 320, 240)
    model.add_camera_with_trivial_rig(camera)
    for index, name in enumerate(GIVEN[:NUM_IMAGES]):
        yaw = np.deg2rad(-5.0 * (index - 1.5))
        position = np.array([0.55 * (index - 1.5), -0.1 * index, 0.1 * index])
        rotation = np.array(
            [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ position)
        image = pycolmap.Image(name.replace(".png", suffix), [], 1, index + 1)
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir()
    model.write(folder)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with images, one of them broken, and ground truth."""
    folder = tmp_path_factory.mktemp("scene")
    write_photographs(folder / "images", NUM_IMAGES)
    (folder / "images" / "broken.png").write_bytes(b"no image")
    write_ground_truth(folder / "truth")
    return folder


@pytest.fixture(scope="module")
def options(scene: Path) -> CompareOptions:
    return CompareOptions(
        methods=METHODS, seeds=(0, 1), cameras=CAMERAS, ground_truth_path=scene / "truth"
    )


@pytest.fixture(scope="module")
def compared(
    scene: Path, options: CompareOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Comparison, Path]:
    out = tmp_path_factory.mktemp("out")
    comparison = compare(scene / "images", out, options)
    assert (out / "report.html").stat().st_size > 10_000
    return comparison, out


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take time and have tests of their own."""
    monkeypatch.setattr(module, "write_page", lambda *_: None)


@pytest.fixture
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may be run again."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a method was run")

    monkeypatch.setattr(module, "child", refuse)


def test_methods_register_the_scene_and_one_fails_with_its_reason(compared) -> None:
    comparison, _ = compared
    *finished, failed = comparison.methods
    assert [method.name for method in comparison.methods] == list(METHODS)
    assert comparison.image_names == tuple(sorted(GIVEN))
    assert comparison.num_pairs == 6
    for method in finished:
        assert method.failed == ""
        assert method.registered.min == method.registered.max == NUM_IMAGES
        assert method.correct.mean == NUM_IMAGES
        assert list(method.num_keypoints) == sorted(GIVEN[:NUM_IMAGES])
        assert len(method.raw_matches) == 3
        assert "COLMAP cannot read it" in method.failures["broken.png"]
        assert method.peak_memory_bytes > 50e6
        assert {*method.stage_seconds} == {"extract", "match", "verify", "map"}
    assert "depth" in failed.failed
    assert "Traceback" not in failed.failed
    assert comparison.registered_by_none == ("broken.png",)
    assert verdict(comparison)[0].startswith("No benefit on this set")
    assert any(text.startswith("depth-planes-recommended failed: ") for text in verdict(comparison))


def test_poses_are_measured_against_ground_truth(compared) -> None:
    """Of 3 pairs of images with ground truth all count, those of the broken image not."""
    for method in compared[0].finished:
        for seed in method.seeds:
            assert seed.scores.num_pairs == len(seed.scores.pair_errors_deg) == 3
            assert 1e-4 < seed.scores.median_rotation_error_deg < 0.5
            assert 0.9 < seed.scores.auc[10.0] <= 1
            assert seed.scores.auc[1.0] < seed.scores.auc[10.0]
            assert seed.scores.median_position_error is None  # the cameras are on one line


def test_figures_equal_those_of_the_models_on_disk(compared) -> None:
    comparison, out = compared
    for method in comparison.finished:
        for seed in method.seeds:
            model = pycolmap.Reconstruction(out / seed.model_path)
            images = [model.images[image_id] for image_id in model.reg_image_ids()]
            assert seed.registered_names == tuple(sorted(image.name for image in images))
            lengths = [len(point.track.elements) for point in model.points3D.values()]
            assert seed.num_points3D == len(lengths)
            assert seed.mean_track_length == pytest.approx(fmean(lengths))
            assert seed.mean_observations == pytest.approx(sum(lengths) / len(images))
            assert sum(seed.num_observations.values()) == sum(lengths)
            errors = [point.error for point in model.points3D.values()]
            assert seed.mean_reprojection_error_px == pytest.approx(fmean(errors))
            with open_copy(out / method.folder / f"seed-{seed.seed}" / "database.db") as database:
                names = {image.image_id: image.name for image in database.read_all_images()}
                counts = {
                    tuple(sorted(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id))): count
                    for pair_id, count in zip(
                        *database.read_two_view_geometry_num_inliers(), strict=True
                    )
                }
            assert seed.pair_inliers == {
                pair: count for pair, count in counts.items() if count >= MIN_NUM_INLIERS
            }


def test_methods_had_the_same_cameras_images_and_pairs(compared) -> None:
    comparison, out = compared
    shared = []
    for method in comparison.finished:
        with open_copy(out / method.folder / "database.db") as database:
            images = database.read_all_images()
            shared.append(
                (
                    sorted((image.image_id, image.name, image.camera_id) for image in images),
                    [list(camera.params) for camera in database.read_all_cameras()],
                )
            )
    assert shared[0] == shared[1]
    assert len({tuple(sorted(method.raw_matches)) for method in comparison.finished}) == 1


def test_json_holds_the_figures_of_the_seeds(compared) -> None:
    comparison, out = compared
    values = json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert values["verdict"] == list(verdict(comparison))
    assert values["registered_by_none"] == ["broken.png"]
    assert next(iter(values["methods"]["depth-planes-recommended"])) == "failed"
    for result in comparison.finished:
        method = values["methods"][result.name]
        for key, measure in MEASURES.items():
            numbers = [measure(seed) for seed in result.seeds]
            assert method[key] == {
                "mean": fmean(numbers), "min": min(numbers), "max": max(numbers),
            }  # fmt: skip
            assert [seed[key] for seed in method["seeds"]] == numbers
        assert method["wall_s"]["map"] == fmean(seed.wall_s["map"] for seed in result.seeds)
        assert list(method["registered_names"]) == ["0", "1"]


@pytest.mark.usefixtures("no_processes", "no_page")
def test_finished_methods_are_not_run_again(scene, options, compared) -> None:
    """Without the one that failed, which would be."""
    comparison, out = compared
    again = compare(scene / "images", out, replace(options, methods=METHODS[:2]))
    assert again.methods == tuple(replace(m) for m in comparison.methods[:2])


@pytest.mark.usefixtures("no_processes", "no_page")
def test_photographs_that_moved_are_the_same_and_others_are_refused(
    scene, options, compared, tmp_path
) -> None:
    images = Path(shutil.copytree(scene / "images", tmp_path / "moved"))
    chosen = replace(options, methods=METHODS[:2])
    assert compare(images, compared[1], chosen).methods == compared[0].methods[:2]
    name = min(path.name for path in images.iterdir())
    (images / name).write_bytes((images / name).read_bytes() + b" ")
    with pytest.raises(StaleStoreError, match=rf"compared there with photographs\.{name}='.*, and"):
        compare(images, compared[1], chosen)


@pytest.mark.usefixtures("no_processes")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"mapping": SparseOptions(min_model_size=3)},
            "mapping.min_model_size=2, and it is 3",
        ),
        (
            {"methods": ["unrectified-rootsift=default"]},
            r"unrectified-rootsift was run there with rectifier.name='identity', and it is",
        ),
    ],
)
def test_other_options_than_before_are_refused(scene, options, compared, changes, message) -> None:
    with pytest.raises(StaleStoreError, match=f"{message}.*; use --overwrite"):
        compare(scene / "images", compared[1], replace(options, **changes))


@pytest.mark.usefixtures("no_processes")
@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"methods": ["sift", "defualt"]}, OptionError, "did you mean 'default'"),
        ({"seeds": (1, 1)}, OptionError, "give different seeds"),
        ({"resources": Resources(device="cuda:99")}, DeviceError, "--device cuda:99"),
        ({"ground_truth_path": Path("nowhere")}, OptionError, "nowhere: no such folder"),
    ],
)
def test_bad_input_is_refused_before_any_work(
    scene, options, tmp_path, changes, error, message
) -> None:
    with pytest.raises(error, match=message):
        compare(scene / "images", tmp_path / "out", replace(options, **changes))
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_processes")
def test_ground_truth_of_other_images_is_refused(scene, options, tmp_path) -> None:
    write_ground_truth(tmp_path / "truth", ".jpg")
    options = replace(options, ground_truth_path=tmp_path / "truth")
    with pytest.raises(ComparisonError, match=r"shares no image name .* \(it has a.jpg, they"):
        compare(scene / "images", tmp_path / "out", options)


def test_folders_that_were_not_made_here_are_left_alone(scene, options, tmp_path) -> None:
    (tmp_path / "methods").mkdir()
    with pytest.raises(OptionError, match=r"is not empty \(methods\) and was not made by"):
        compare(scene / "images", tmp_path, options, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["methods"]


@pytest.mark.long
@pytest.mark.usefixtures("no_page")
def test_recipes_are_guided_seed_by_seed(scene, options, compared, tmp_path) -> None:
    """Each seed has geometries of its own; features and raw matches stay those of the method."""
    options = replace(options, methods=["guided=unrectified-rootsift:guided.enabled=always"])
    (method,) = compare(scene / "images", tmp_path, options).methods
    plain = compared[0].methods[1]
    assert method.raw_matches == plain.raw_matches
    for seed, found, before in zip((0, 1), method.seeds, plain.seeds, strict=True):
        guided = Workspace(tmp_path / method.folder / f"seed-{seed}")
        assert guided_counts(Context(guided))["pairs"] > 0
        assert sum(found.pair_inliers.values()) > sum(before.pair_inliers.values())
        assert found.registered_names == before.registered_names
    assert not Workspace(tmp_path / method.folder).guided.exists()


DYING = """
import os, signal
print('{"stage": "extract", "total": 4, "unit": "images"}', flush=True)
os.kill(os.getpid(), signal.SIGSEGV)
"""


@pytest.mark.usefixtures("no_page")
def test_method_whose_process_dies_is_reported(
    scene, options, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dying_worker.py").write_text(DYING)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(module.worker, "__name__", "dying_worker")
    (method,) = compare(
        scene / "images", tmp_path / "out", replace(options, methods=["sift"])
    ).methods
    assert method.failed.startswith("its process ended by SIGSEGV; ")
    assert method.failed.endswith("run.log may say why")


@pytest.fixture
def killed(scene: Path, tmp_path: Path) -> Iterator[Path]:
    """Folder of a comparison that was killed while features were extracted."""
    out = tmp_path / "out"
    arguments = [
        "compare", "--image-path", scene / "images", "--output-path", out,
        "--methods", METHODS[1], "--seeds", "0", *FAST[2:],
    ]  # fmt: skip
    features = out / "methods" / METHODS[1] / "features.h5"
    with start(*arguments) as process:
        while not features.exists() and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert not (out / "comparison.json").exists()
    return out


@pytest.mark.long
@pytest.mark.usefixtures("no_page")
def test_killed_comparison_goes_on_and_ends_as_an_undisturbed_one(
    scene, options, compared, killed
) -> None:
    options = replace(options, methods=[METHODS[1]], seeds=[0])
    (method,) = compare(scene / "images", killed, options).methods
    expected = compared[0].methods[1]
    assert method.num_keypoints == expected.num_keypoints
    assert method.raw_matches == expected.raw_matches
    assert method.seeds[0].registered_names == expected.seeds[0].registered_names
    assert method.seeds[0].num_points3D == expected.seeds[0].num_points3D


@pytest.mark.long
def test_command_prints_the_table_and_fails_when_an_image_does(scene, compared) -> None:
    """The methods are finished there: it only prints."""
    ended = run_in_process_of_its_own(
        "compare", "--image-path", scene / "images", "--output-path", compared[1],
        "--ground-truth-path", scene / "truth", "--seeds", "0,1", *FAST[2:],
        "--methods", ",".join(METHODS[:2]),
    )  # fmt: skip
    assert ended.code == 1
    assert ended.errors == ["error: could not read 1 of the images: broken.png"]
    assert ended.stdout.startswith("method")
    assert "No benefit on this set" in ended.stdout


def test_missing_weights_of_any_method_are_told_before_the_first(
    scene, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(keys: list[str], *_: object, **__: object) -> None:
        assert keys == ["affnet", "hardnet", "orinet"]
        raise WeightsError("no AffNet.pth")

    monkeypatch.setattr(module, "resolve", missing)
    methods = ["sift", "default", "asift-recommended"]
    with pytest.raises(WeightsError, match=r"no AffNet\.pth"):
        compare(scene / "images", tmp_path / "out", CompareOptions(methods=methods))
    assert not (tmp_path / "out").exists()


def test_colmaps_sift_is_verified_and_mapped_as_colmap_does_it(scene, tmp_path) -> None:
    options = CompareOptions(methods=["sift-colmap", "sift"])
    plan = module._Plan.checked(scene / "images", module.Layout(tmp_path), options)
    colmaps, ours = plan.tasks()
    presets = [(r.verification.preset_name, r.mapping.preset_name) for r in (colmaps, ours)]
    assert presets == [("colmap", "colmap"), ("sparse", "sparse")]
    assert (colmaps.mapping.name, ours.mapping.name) == ("incremental", "sparse")
    assert (colmaps.focal_vote, ours.focal_vote) == (False, True)
