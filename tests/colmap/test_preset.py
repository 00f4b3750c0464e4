"""The sparse preset on scenes with known truth, written through our writer."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import ALL_GIVEN, NOTHING_KNOWN
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database, write_keypoints, write_matches
from colmap_affrect.colmap.native_options import flat_values
from colmap_affrect.colmap.verification import (
    VerificationOptions,
    verification_differences,
    verified_pairs,
    verify,
)
from colmap_affrect.comparison.pose_scores import pair_errors
from colmap_affrect.errors import OptionError
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS, pixel_from_colmap
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.mappers.incremental import IncrementalOptions
from colmap_affrect.options import PRESETS

SEED = 3

ROTATION_ERROR_DEG = 0.05
"""Keypoints are exact; what is left are float32 coordinates and the optimiser's tolerance."""

SIZE = (1600, 1200)

Pair = tuple[int, int]
Matches = dict[Pair, NDArray[np.integer]]


def synthesize(
    path: Path, num_images: int, num_points: int
) -> tuple[pycolmap.Reconstruction, dict[int, NDArray[np.floating]], Matches]:
    """Let COLMAP make a scene; return the truth, keypoints (corner origin) and all matches."""
    pycolmap.set_random_seed(SEED)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=num_images, num_points3D=num_points
    )
    with open_database(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        ids = sorted(image.image_id for image in database.read_all_images())
        keypoints = {image_id: database.read_keypoints(image_id)[:, :2] for image_id in ids}
        matches = {pair: database.read_matches(*pair) for pair in combinations(ids, 2)}
    return truth, keypoints, matches


def write_scene(
    path: Path,
    truth: pycolmap.Reconstruction,
    keypoints: dict[int, NDArray[np.floating]],
    matches: Matches,
) -> Path:
    """Write a scene through our writer, from keypoints with COLMAP's corner origin."""
    with open_database(path) as database:
        for camera in truth.cameras.values():
            database.write_camera(camera, use_camera_id=True)
        for image_id, found in sorted(truth.images.items()):
            image = pycolmap.Image(name=found.name, image_id=image_id, camera_id=found.camera_id)
            database.write_image(image, use_image_id=True)
        for image_id, points in keypoints.items():
            lafs = np.zeros((len(points), 2, 3))
            lafs[:, :, :2] = MEASUREMENT_SIGMAS * np.eye(2)
            lafs[:, :, 2] = pixel_from_colmap(points.astype(float))
            write_keypoints(database, image_id, lafs)
        for pair, indices in matches.items():
            write_matches(database, *pair, indices)
    return path


def rewrite(folder: Path, num_images: int, num_points: int) -> tuple[Path, pycolmap.Reconstruction]:
    """Write a synthesized scene through our writer."""
    truth, keypoints, matches = synthesize(folder / "source.db", num_images, num_points)
    return write_scene(folder / "ours.db", truth, keypoints, matches), truth


def verified(path: Path) -> dict[Pair, int]:
    """Verify a database and return the inliers of each pair that passed."""
    verify(path, VerificationOptions(random_seed=SEED))
    return verified_pairs(path, 1)


def mapper_of(name: str, preset: str = "sparse", **values: Any) -> Any:
    options = MAPPERS.part(name).Options.preset(preset, random_seed=SEED, **values)
    return MAPPERS.make(options)


def reconstruct(
    path: Path, options: pycolmap.IncrementalPipelineOptions | None = None
) -> list[pycolmap.Reconstruction]:
    """Map a verified database; models by falling number of images."""
    output = path.parent / "sparse"
    output.mkdir(exist_ok=True)
    ours = mapper_of("incremental").native(NOTHING_KNOWN, SEED)
    chosen = ours if options is None else options
    models = pycolmap.incremental_mapping(path, path.parent, output, options=chosen)
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def registered(model: pycolmap.Reconstruction) -> list[str]:
    """Names of the registered images, sorted."""
    return sorted(model.images[image_id].name for image_id in model.reg_image_ids())


def max_rotation_error_deg(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> float:
    """Largest error of the relative rotation of two registered images."""
    poses = []
    for scene in (model, truth):
        found = {image.name: image.cam_from_world() for image in scene.images.values()}
        poses.append({k: (v.rotation.matrix(), v.translation) for k, v in found.items()})
    return max(degrees for degrees, _ in pair_errors(*poses).values())


def test_synthetic_scene_through_our_writer_registers_all_images_in_place(
    tmp_path: Path,
) -> None:
    path, truth = rewrite(tmp_path, num_images=5, num_points=150)
    assert len(verified(path)) == 10
    (model,) = reconstruct(path)
    assert registered(model) == sorted(image.name for image in truth.images.values())
    assert model.num_points3D() >= 140
    assert max_rotation_error_deg(model, truth) < ROTATION_ERROR_DEG
    assert model.compute_mean_reprojection_error() < 0.05
    # The principal point is half the size: a shift by half a pixel would show in the points.
    point = next(iter(model.points3D.values()))
    element = point.track.elements[0]
    with open_database(path) as database:
        stored = database.read_keypoints(element.image_id)[element.point2D_idx, :2]
    with open_database(tmp_path / "source.db") as database:
        source = database.read_keypoints(element.image_id)[element.point2D_idx, :2]
    assert_allclose(stored, source, atol=1e-3)


def test_two_images_register_with_our_preset_and_not_with_colmaps_default(
    tmp_path: Path,
) -> None:
    path, truth = rewrite(tmp_path, num_images=2, num_points=400)
    verified(path)
    assert reconstruct(path, pycolmap.IncrementalPipelineOptions(random_seed=SEED)) == []
    (model,) = reconstruct(path)
    assert registered(model) == sorted(image.name for image in truth.images.values())
    assert {point.track.length() for point in model.points3D.values()} == {2}
    assert max_rotation_error_deg(model, truth) < 10 * ROTATION_ERROR_DEG


def test_options_are_passed_on_to_pycolmap() -> None:
    verification = VerificationOptions.preset(
        "colmap", max_error_px=3.0, min_num_inliers=21, min_inlier_ratio=0.17, random_seed=5
    )
    assert verification_differences(verification) == {
        "ransac.max_error": 3.0, "min_num_inliers": 21, "min_inlier_ratio": 0.17,
        "ransac.random_seed": 5,
    }  # fmt: skip
    mapper = mapper_of(
        "incremental", "colmap", ignore_two_view_tracks=False, init_min_tri_angle_deg=7.0,
        init_min_num_inliers=44, abs_pose_min_num_inliers=17, min_model_size=6,
    )  # fmt: skip
    assert mapper.differences(NOTHING_KNOWN) == repeatable("incremental") | {
        "triangulation.ignore_two_view_tracks": False, "mapper.init_min_tri_angle": 7.0,
        "mapper.init_min_num_inliers": 44, "mapper.abs_pose_min_num_inliers": 17,
        "min_model_size": 6,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("given", "keep", "refined"),
    [(False, True, True), (True, True, False), (True, False, True)],
)
def test_pipeline_options_leave_given_intrinsics_alone_if_asked_to(
    given: bool, keep: bool, refined: bool
) -> None:
    mapper = mapper_of("incremental", keep_given_intrinsics=keep)
    passed = mapper.native(ALL_GIVEN if given else NOTHING_KNOWN, 0)
    assert passed.ba_refine_focal_length is refined
    assert passed.ba_refine_extra_params is refined
    assert passed.mapper.abs_pose_refine_focal_length is refined
    assert passed.mapper.abs_pose_refine_extra_params is refined


NATIVE = {
    "sparse": pycolmap.IncrementalPipelineOptions,
    "incremental": pycolmap.IncrementalPipelineOptions,
}


def repeatable(mapper: str) -> dict[str, int]:
    """What makes results repeatable: all seeds and numbers of threads that pycolmap has."""
    names = {"num_threads": 1, "random_seed": SEED}
    keys = flat_values(NATIVE[mapper]())
    return {key: names[key.split(".")[-1]] for key in keys if key.split(".")[-1] in names}


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("mapper", NATIVE)
def test_colmap_preset_is_what_pycolmap_has_by_default(mapper: str, given: bool) -> None:
    verification = VerificationOptions.preset("colmap", random_seed=SEED)
    assert verification_differences(verification) == {"ransac.random_seed": SEED}
    made = mapper_of(mapper, "colmap")
    differs = made.differences(ALL_GIVEN if given else NOTHING_KNOWN)
    assert differs == repeatable(mapper)


@pytest.mark.parametrize("name", PRESETS)
def test_preset_knows_its_name(name: str) -> None:
    assert VerificationOptions.preset(name).preset_name == name
    for mapper in MAPPERS.names():
        options = mapper_of(mapper, name, mapper_options={"min_num_matches": 4}).options
        assert options.preset_name == name
        assert options.changed(min_model_size=51).preset_name == "custom"
    assert VerificationOptions(min_num_inliers=21).preset_name == "custom"


def test_unknown_preset_and_mapper_are_refused() -> None:
    for make in (VerificationOptions.preset, IncrementalOptions.preset):
        with pytest.raises(OptionError, match="preset 'dense' is not one of sparse, colmap"):
            make("dense")
    with pytest.raises(OptionError, match=r"unknown mapper 'sparce' .did you mean 'sparse'"):
        MAPPERS.options("sparce")
