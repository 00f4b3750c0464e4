"""A comparison on a small scene: figures, files, failures, going on after a stop."""

from __future__ import annotations

import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import FAST, run_in_process_of_its_own, start
from small_scene import INTRINSICS, NAMES, write_photographs
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.comparison import compare as module
from colmap_affrect.comparison import worker
from colmap_affrect.comparison.compare import CompareOptions, compare
from colmap_affrect.comparison.method_run import MethodRun, masks_for_colmap
from colmap_affrect.comparison.results import Comparison
from colmap_affrect.comparison.tables import to_json, verdict
from colmap_affrect.errors import AffrectError, OptionError, StoreError
from colmap_affrect.images.masks import read_mask
from colmap_affrect.images.photographs import CameraOptions, MaskOptions, Photographs
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.pairs.lists import PairOptions
from colmap_affrect.progress import SILENT
from colmap_affrect.session.context import Resources

pytestmark = pytest.mark.long

CAMERAS = CameraOptions(mode="per-image", model="PINHOLE", params=INTRINSICS)
NUM_IMAGES = 3
GIVEN = (*NAMES[:NUM_IMAGES], "broken.png")
METHODS = ("sift", "unrectified-rootsift", "depth-planes-recommended")


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
        methods=METHODS,
        seeds=(0, 1),
        cameras=CAMERAS,
        ground_truth_path=scene / "truth",
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
def asked(monkeypatch: pytest.MonkeyPatch) -> list[MethodRun]:
    """What would be run in other processes; nothing is."""
    asked = []

    def run_alone(run: MethodRun, *_: object) -> str:
        asked.append(run)
        return "not run"

    monkeypatch.setattr(module, "run_alone", run_alone)
    return asked


def test_methods_register_the_scene(compared) -> None:
    comparison, out = compared
    assert (out / "comparison.json").read_text(encoding="utf-8") == to_json(comparison)
    assert [method.name for method in comparison.methods] == list(METHODS)
    assert comparison.image_names == tuple(sorted(GIVEN))
    assert comparison.num_pairs == 6
    for method in comparison.methods[:-1]:
        assert method.failed == ""
        assert method.registered.min == method.registered.max == NUM_IMAGES
        assert method.trusted.mean == NUM_IMAGES
        assert method.peak_memory_bytes > 50e6
        assert {*method.stage_seconds} == {"extract", "match", "verify", "map"}


def test_a_photograph_that_no_method_registers_is_named(compared) -> None:
    comparison, _ = compared
    assert comparison.registered_by_none == ("broken.png",)
    for method in comparison.methods[:-1]:
        assert list(method.failures) == ["broken.png"]
    ours = f"our features (unrectified-rootsift): 3 of {len(GIVEN)}, 3 of them correct"
    assert ours in verdict(comparison)


def test_a_method_that_fails_says_why(compared) -> None:
    comparison, _ = compared
    failed = comparison.methods[-1]
    assert "depth" in failed.failed
    assert "Traceback" not in failed.failed
    texts = verdict(comparison)
    assert any(text.startswith(f"{failed.name} failed: ") for text in texts)


def test_methods_had_the_same_cameras_images_and_pairs(compared) -> None:
    comparison, out = compared
    shared = []
    for method in comparison.finished:
        with open_copy(out / method.folder / "database.db") as database:
            images = [
                (i.image_id, i.name, i.camera_id) for i in database.read_all_images()
            ]
            cameras = [list(camera.params) for camera in database.read_all_cameras()]
            shared.append(
                (sorted(images), cameras, sorted(database.read_num_matches()[0]))
            )
    assert shared[0] == shared[1]


@pytest.mark.usefixtures("no_page")
def test_finished_methods_are_not_run_again_where_photographs_moved_only(
    scene, options, compared, tmp_path, asked
) -> None:
    images = Path(shutil.copytree(scene / "images", tmp_path / "moved"))
    chosen = options.changed(methods=METHODS[:2])
    assert compare(images, compared[1], chosen).methods == compared[0].methods[:2]
    name = min(path.name for path in images.iterdir())
    (images / name).write_bytes((images / name).read_bytes() + b" ")
    with pytest.raises(
        StoreError, match=rf"run there with photographs\.{name}='.*, and"
    ):
        compare(images, compared[1], chosen)
    assert asked == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"cameras": CameraOptions()},
            "sift was run there with camera.mode='per-image', and it is",
        ),
        (
            {"mapping": SparseOptions(min_model_size=3)},
            "mapping.min_model_size=2, and it is 3",
        ),
        (
            {"methods": ["unrectified-rootsift=default"]},
            "unrectified-rootsift was run there with rectifier.name='identity', and it is",
        ),
    ],
)
def test_other_options_than_before_are_refused(
    scene, options, compared, asked, changes, message
) -> None:
    with pytest.raises(StoreError, match=f"{message}.*; use --overwrite"):
        compare(scene / "images", compared[1], options.changed(**changes))
    assert asked == []


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"methods": ["sift", "defualt"]}, OptionError, "did you mean 'default'"),
        ({"seeds": (1, 1)}, OptionError, "give different seeds"),
        (
            {"seeds": (0, -5)},
            OptionError,
            "random_seed=-5: should be greater than or equal to -1",
        ),
        ({"resources": Resources(device="cuda:99")}, AffrectError, "--device cuda:99"),
        (
            {"ground_truth_path": Path("nowhere")},
            OptionError,
            "nowhere: no such folder",
        ),
        (
            {"pairs": PairOptions(match_list_path="nowhere")},
            OptionError,
            "nowhere: cannot be read",
        ),
        (
            {"cameras": CameraOptions(model="PINHOLES")},
            OptionError,
            "PINHOLES is not one of",
        ),
    ],
)
def test_bad_input_is_refused_before_any_work(
    scene, options, tmp_path, changes, error, message
) -> None:
    with pytest.raises(error, match=message):
        compare(scene / "images", tmp_path / "out", options.changed(**changes))
    write_ground_truth(tmp_path / "truth", ".jpg")
    options = options.changed(ground_truth_path=tmp_path / "truth")
    with pytest.raises(
        AffrectError, match=r"shares no image name .* \(it has a.jpg, they"
    ):
        compare(scene / "images", tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_page")
def test_fewer_than_two_images_are_refused(tmp_path) -> None:
    images = tmp_path / "images"
    write_photographs(images, 1)
    with pytest.raises(AffrectError, match=r"only a\.png to use; .* at least two"):
        compare(images, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (images / "broken.png").write_bytes(b"no image")
    (images / "a.png").write_bytes(b"no image either")
    comparison = compare(images, tmp_path / "out", CompareOptions(methods=METHODS[:2]))
    sift, recipe = comparison.methods
    assert sift.failed == "COLMAP cannot use any of the 2 images"
    assert "none of the 2 images can be used" in recipe.failed


@pytest.mark.usefixtures("no_page")
def test_all_methods_take_the_cameras_of_a_database(scene, compared, tmp_path) -> None:
    database = tmp_path / "given.db"
    shutil.copy(compared[1] / "methods" / METHODS[0] / "database.db", database)
    options = CompareOptions(methods=METHODS[:2], seeds=(0,), from_database=database)
    comparison = compare(scene / "images", tmp_path / "out", options)
    assert [method.failed for method in comparison.methods] == ["", ""]
    for method in comparison.methods:
        (camera, *_) = pycolmap.Reconstruction(
            tmp_path / "out" / method.seeds[0].model_path
        ).cameras.values()
        assert camera.model_name == "PINHOLE"


DYING = """
import os, signal
os.kill(os.getpid(), signal.SIGSEGV)
"""


@pytest.fixture
def dying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dying_worker.py").write_text(DYING)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(worker, "__name__", "dying_worker")


@pytest.mark.usefixtures("no_page", "dying")
def test_record_of_many_photographs_reaches_the_process(
    scene, options, tmp_path, asked
) -> None:
    """It is longer than an argument of a command may be."""
    compare(scene / "images", tmp_path / "out", options.changed(methods=["sift"]))
    many = replace(asked[0], inputs={"photographs": "x" * 200_000})
    assert "SIGSEGV" in worker.run_alone(many, "", SILENT)


@pytest.mark.usefixtures("no_page", "dying")
def test_method_whose_process_dies_is_reported(scene, options, tmp_path) -> None:
    (method,) = compare(
        scene / "images", tmp_path / "out", options.changed(methods=["sift"])
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


@pytest.mark.usefixtures("no_page")
def test_killed_comparison_goes_on_and_ends_as_an_undisturbed_one(
    scene, options, compared, killed
) -> None:
    options = options.changed(methods=[METHODS[1]], seeds=[0])
    (method,) = compare(scene / "images", killed, options).methods
    expected = compared[0].methods[1]
    assert replace(method.seeds[0], wall_s={}) == replace(expected.seeds[0], wall_s={})


def test_command_prints_the_table_and_fails_when_an_image_does(scene, compared) -> None:
    """The methods are finished there: it only prints."""
    ended = run_in_process_of_its_own(
        "compare", "--image-path", scene / "images", "--output-path", compared[1],
        "--ground-truth-path", scene / "truth", "--seeds", "0,1", *FAST[2:],
        "--methods", ",".join(METHODS[:2]),
    )  # fmt: skip
    assert ended.code == 1
    (error,) = ended.errors
    assert error.startswith("error: could not read 1 of the images: broken.png; ")
    assert ended.stdout.startswith("method")
    assert (
        "Photographs that are registered:\nour mapper with SIFT (sift): 3 of 4"
        in ended.stdout
    )


@pytest.mark.usefixtures("no_page")
def test_colmaps_sift_is_verified_and_mapped_as_colmap_does_it(
    scene, tmp_path, asked
) -> None:
    compare(scene / "images", tmp_path, CompareOptions(methods=["sift-colmap", "sift"]))
    presets = [(run.verification.preset_name, run.mapping.preset_name) for run in asked]
    assert presets == [("colmap", "colmap"), ("sparse", "sparse")]
    assert [run.mapping.name for run in asked] == ["incremental", "sparse"]


def test_a_folder_of_a_run_is_refused(
    scene: Path, options: CompareOptions, tmp_path: Path
) -> None:
    page = tmp_path / "out" / "report.html"
    page.parent.mkdir()
    page.write_text("of the run")
    (tmp_path / "out" / "run.log").write_text("colmap-affrect 0.1.0: output folder")
    (tmp_path / "out" / "config.toml").write_text("format_version = 11")
    with pytest.raises(OptionError, match="has the results of a run"):
        compare(scene, tmp_path / "out", options)
    assert page.read_text() == "of the run"


def test_colmaps_sift_has_the_masks_of_alpha_channels(tmp_path: Path) -> None:
    photographs = Photographs(
        tmp_path / "photos", MaskOptions(path=str(tmp_path / "masks"))
    )
    (tmp_path / "masks").mkdir()
    (tmp_path / "photos" / "side").mkdir(parents=True)
    image = np.full((40, 60, 4), 255, np.uint8)
    write_image(tmp_path / "photos" / "whole.png", image)
    with masks_for_colmap(photographs, ["whole.png"]) as folder:
        assert folder == str(tmp_path / "masks")
    image[:10, :, 3] = 0
    write_image(tmp_path / "photos" / "side" / "cut.png", image)
    write_image(tmp_path / "masks" / "whole.png", image[:, :, 0])
    with masks_for_colmap(photographs, ["side/cut.png", "whole.png"]) as folder:
        assert read_mask(Path(folder) / "side" / "cut.png.png").mean() == 0.75
        assert read_mask(Path(folder) / "whole.png.png").all()


@pytest.mark.usefixtures("no_page")
def test_first_seed_of_a_recipe_with_levels_has_the_models_of_escalation(
    scene: Path, tmp_path: Path
) -> None:
    """Others are mapped anew from its matches."""
    options = CompareOptions(methods=["on-demand"], seeds=(0, 1), cameras=CAMERAS)
    (method,) = compare(scene / "images", tmp_path / "out", options).methods
    folder = tmp_path / "out" / method.folder
    first, second = method.seeds
    assert first.wall_s == {}
    assert {*second.wall_s} == {"verify", "map"}
    assert {*method.stage_seconds} == {"extract", "match", "escalate", "verify", "map"}
    for seed in method.seeds:
        assert len(seed.registered_names) == NUM_IMAGES
        assert seed.verified_pairs == NUM_IMAGES * (NUM_IMAGES - 1) // 2
    models = [folder / name / "sparse" / "0" / "images.bin" for name in ("", "seed-0")]
    assert models[0].read_bytes() == models[1].read_bytes()
