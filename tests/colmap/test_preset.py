"""The sparse preset on a scene with known truth, and the differences of presets from COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mapping_tasks import ALL_GIVEN, NOTHING_KNOWN, SEED, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.model_files import model_poses
from colmap_affrect.colmap.native_options import differences, flat_values
from colmap_affrect.colmap.verification import VerificationOptions, two_view_options
from colmap_affrect.comparison.results import pair_errors
from colmap_affrect.errors import OptionError
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.incremental import IncrementalOptions

ROTATION_ERROR_DEG = 0.05
"""Keypoints are exact; what is left are float32 coordinates and the optimiser's tolerance."""


def mapper_of(name: str, preset: str = "sparse", **values: Any) -> Any:
    options = MAPPERS.part(name).Options.preset(preset, random_seed=SEED, **values)
    return MAPPERS.make(options)


def of_verification(options: VerificationOptions) -> dict[str, Any]:
    """What differs from COLMAP's defaults."""
    return differences(two_view_options(options), pycolmap.TwoViewGeometryOptions())


def of_mapping(mapper: Any, task: MappingTask = NOTHING_KNOWN) -> dict[str, Any]:
    return differences(mapper.native(task, SEED), pycolmap.IncrementalPipelineOptions())


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


def max_rotation_error_deg(
    model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction
) -> float:
    """Largest error of the relative rotation of two registered images."""
    errors = pair_errors(model_poses(model), model_poses(truth))
    return max(degrees for degrees, _ in errors.values())


def test_two_images_register_with_our_preset_and_not_with_colmaps_default(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=1, num_frames_per_rig=2, num_points3D=400)
    with open_database(path) as database:
        database.clear_two_view_geometries()
    verify(path, VerificationOptions(random_seed=SEED))
    assert (
        reconstruct(path, pycolmap.IncrementalPipelineOptions(random_seed=SEED)) == []
    )
    (model,) = reconstruct(path)
    assert model.num_reg_images() == 2
    assert {point.track.length() for point in model.points3D.values()} == {2}
    assert max_rotation_error_deg(model, truth) < 10 * ROTATION_ERROR_DEG


def test_options_are_passed_on_to_pycolmap() -> None:
    verification = VerificationOptions.preset(
        "colmap",
        max_error_px=3.0,
        min_num_inliers=21,
        min_inlier_ratio=0.17,
        random_seed=5,
    )
    assert of_verification(verification) == {
        "ransac.max_error": 3.0, "min_num_inliers": 21, "min_inlier_ratio": 0.17,
        "ransac.random_seed": 5,
    }  # fmt: skip
    mapper = mapper_of(
        "incremental", "colmap", ignore_two_view_tracks=False, init_min_tri_angle_deg=7.0,
        init_min_num_inliers=44, abs_pose_min_num_inliers=17, min_model_size=6,
    )  # fmt: skip
    assert of_mapping(mapper) == repeatable() | {
        "triangulation.ignore_two_view_tracks": False, "mapper.init_min_tri_angle": 7.0,
        "mapper.init_min_num_inliers": 44, "mapper.abs_pose_min_num_inliers": 17,
        "min_model_size": 6,
    }  # fmt: skip


def repeatable() -> dict[str, int]:
    """What makes results repeatable: all seeds and numbers of threads that pycolmap has."""
    names = {"num_threads": 1, "random_seed": SEED}
    keys = flat_values(pycolmap.IncrementalPipelineOptions())
    return {
        key: names[key.split(".")[-1]] for key in keys if key.split(".")[-1] in names
    }


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("mapper", ["sparse", "incremental"])
def test_colmap_preset_is_what_pycolmap_has_by_default(
    mapper: str, given: bool
) -> None:
    verification = VerificationOptions.preset("colmap", random_seed=SEED)
    assert of_verification(verification) == {"ransac.random_seed": SEED}
    made = mapper_of(mapper, "colmap")
    differs = of_mapping(made, ALL_GIVEN if given else NOTHING_KNOWN)
    assert differs == repeatable()


def test_unknown_preset_and_mapper_are_refused() -> None:
    for make in (VerificationOptions.preset, IncrementalOptions.preset):
        with pytest.raises(
            OptionError, match="preset 'dense' is not one of sparse, colmap"
        ):
            make("dense")
    with pytest.raises(
        OptionError, match=r"unknown mapper 'sparce' .did you mean 'sparse'"
    ):
        MAPPERS.options("sparce")
