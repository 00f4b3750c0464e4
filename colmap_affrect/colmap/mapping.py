"""Incremental mapping by pycolmap."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.running import run_cancellable
from colmap_affrect.options import MappingOptions
from colmap_affrect.outcomes import ModelSummary

ATTEMPT_SEED_STEP = 1_000_003
"""Distance of the seeds of repeated attempts, so that those of runs 0, 1, 2, ... differ."""


def pipeline_options(
    options: MappingOptions, random_seed: int, *, intrinsics_given: bool
) -> pycolmap.IncrementalPipelineOptions:
    """Translate our options into pycolmap's.

    One thread: with several the choice of the first pair, and so the model, differs from
    run to run in spite of the seed (measured: in 12 of 100 runs).
    """
    refine = not (intrinsics_given and options.keep_given_intrinsics)
    return pycolmap.IncrementalPipelineOptions(
        min_model_size=options.min_model_size,
        random_seed=random_seed,
        num_threads=1,
        ba_refine_focal_length=refine,
        ba_refine_extra_params=refine,
        mapper=dict(
            init_min_tri_angle=options.init_min_tri_angle_deg,
            init_min_num_inliers=options.init_min_num_inliers,
            abs_pose_min_num_inliers=options.abs_pose_min_num_inliers,
            abs_pose_refine_focal_length=refine,
            abs_pose_refine_extra_params=refine,
            random_seed=random_seed,
            num_threads=1,
        ),
        triangulation=dict(
            ignore_two_view_tracks=options.ignore_two_view_tracks, random_seed=random_seed
        ),
    )


def map_incrementally(
    database_path: Path,
    image_path: Path,
    sparse_path: Path,
    options: MappingOptions,
    random_seed: int,
    *,
    intrinsics_given: bool,
    next_image: Callable[[int], None],
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    Which pair mapping begins with is partly chance, and a bad one ends in a small model. So,
    while images are missing, mapping is tried again and the attempt with the largest model
    is kept. ``sparse_path`` appears only once all models are written.

    Args:
        database_path: database with two-view geometries.
        image_path: folder of the images, for the colours of the points.
        sparse_path: folder to make; an old one is removed.
        options: the mapping preset.
        random_seed: seed of all random parts.
        intrinsics_given: the user gave the camera parameters.
        next_image: called with the number of images registered since the last call; never
            more than there are, also when mapping is tried again.
    """
    partial = sparse_path.with_name(sparse_path.name + ".partial")
    for old in (partial, sparse_path):
        shutil.rmtree(old, ignore_errors=True)
    num_images = len(image_ids(database_path))
    most_shown = 0
    best: list[pycolmap.Reconstruction] = []

    def show(count: int) -> None:
        nonlocal most_shown
        news = min(count, num_images) - most_shown
        if news > 0:
            most_shown += news
            next_image(news)

    for attempt in range(options.max_num_attempts):
        models = _map_once(
            database_path,
            image_path,
            partial,
            pipeline_options(
                options,
                random_seed + attempt * ATTEMPT_SEED_STEP,
                intrinsics_given=intrinsics_given,
            ),
            show,
        )
        best = max(best, models, key=_size_of_largest)
        if _size_of_largest(best)[0] == num_images:
            break
    for index, model in enumerate(best):
        (partial / str(index)).mkdir()
        model.write(partial / str(index))
    partial.rename(sparse_path)
    return [summarize(model) for model in best]


def _map_once(
    database_path: Path,
    image_path: Path,
    scratch_path: Path,
    options: pycolmap.IncrementalPipelineOptions,
    show: Callable[[int], None],
) -> list[pycolmap.Reconstruction]:
    """Map once; ``show`` is told how many images have been registered so far."""
    count = 0

    def add(number: int) -> None:
        nonlocal count
        count += number
        show(count)

    raw = scratch_path / "raw"
    raw.mkdir(parents=True)
    models = run_cancellable(
        lambda token: pycolmap.incremental_mapping(
            database_path,
            image_path,
            raw,
            options=options,
            initial_image_pair_callback=lambda: add(2),
            next_image_callback=lambda: add(1),
            cancellation_token=token,
        )
    )
    shutil.rmtree(raw)
    return sorted(
        models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D())
    )


def _size_of_largest(models: list[pycolmap.Reconstruction]) -> tuple[int, int]:
    return (models[0].num_reg_images(), models[0].num_points3D()) if models else (0, 0)


def read_models(sparse_path: Path) -> list[ModelSummary]:
    """Summarize the models that :func:`map_incrementally` wrote."""
    folders = sorted(
        (p for p in sparse_path.iterdir() if p.name.isdigit()), key=lambda p: int(p.name)
    )
    return [summarize(pycolmap.Reconstruction(folder)) for folder in folders]


def summarize(model: pycolmap.Reconstruction) -> ModelSummary:
    """Count what a reconstruction holds."""
    return ModelSummary(
        registered_names=tuple(
            sorted(model.images[image_id].name for image_id in model.reg_image_ids())
        ),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
    )
