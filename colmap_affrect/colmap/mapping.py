"""Mapping by pycolmap: incremental, or global."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.global_mapping import map_globally
from colmap_affrect.colmap.model_files import registered_names
from colmap_affrect.colmap.native_options import Plain, differences, resolve, set_values
from colmap_affrect.colmap.running import run_cancellable
from colmap_affrect.errors import MappingError, OptionError, StoreError
from colmap_affrect.files import cannot_write
from colmap_affrect.options import MappingOptions
from colmap_affrect.outcomes import ModelSummary

ATTEMPT_SEED_STEP = 1_000_003
"""Distance of the seeds of repeated attempts, so that those of runs 0, 1, 2, ... differ."""

LARGE_MODEL = 100
"""So many images are a model whose first pair no longer matters, and another attempt takes long."""

GLOBAL_TRACK_LENGTHS = (
    "mapper.track_min_num_views_per_track",
    "mapper.global_positioning.min_num_view_per_track",
    "mapper.bundle_adjustment.min_track_length",
)
GLOBAL_SEEDED_SECTIONS = (
    "",
    "mapper.",
    "mapper.rotation_averaging.",
    "mapper.global_positioning.",
    "mapper.retriangulation.",
)

MAPPER_OPTIONS = "--mapper-options"


def checked_mapping_options(options: MappingOptions) -> MappingOptions:
    """Return options whose ``mapper_options`` have pycolmap's full keys and types.

    Raises:
        OptionError: for options that pycolmap does not have or does not take.
    """
    if options.mapper == "global" and not hasattr(pycolmap, "global_mapping"):
        raise OptionError(
            f"--mapper global: pycolmap {pycolmap.__version__} has no global mapper; install 4.2"
        )
    native = _default_options(options.mapper)
    resolved = resolve(native, options.mapper_options, MAPPER_OPTIONS)
    if isinstance(native, pycolmap.IncrementalPipelineOptions) and not native.check():
        given = " ".join(f"{key}={value}" for key, value in resolved.items())
        raise OptionError(f"{MAPPER_OPTIONS} {given}: COLMAP does not accept these values")
    return replace(options, mapper_options=resolved)


def mapping_differences(
    options: MappingOptions, random_seed: int, *, intrinsics_given: bool
) -> dict[str, Plain]:
    """Return where mapping differs from COLMAP's defaults, by pycolmap's dotted keys."""
    translate = global_options if options.mapper == "global" else pipeline_options
    native = translate(options, random_seed, intrinsics_given=intrinsics_given)
    return differences(native, _default_options(options.mapper))


def _default_options(
    mapper: str,
) -> pycolmap.IncrementalPipelineOptions | pycolmap.GlobalPipelineOptions:
    if mapper == "global":
        return pycolmap.GlobalPipelineOptions()
    return pycolmap.IncrementalPipelineOptions()


def pipeline_options(
    options: MappingOptions, random_seed: int, *, intrinsics_given: bool
) -> pycolmap.IncrementalPipelineOptions:
    """Translate our options into pycolmap's for incremental mapping.

    One thread: with several the choice of the first pair, and so the model, differs from
    run to run in spite of the seed (measured: in 12 of 100 runs).
    """
    refine = not (intrinsics_given and options.keep_given_intrinsics)
    native = pycolmap.IncrementalPipelineOptions(
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
    set_values(native, options.mapper_options)
    return native


def global_options(
    options: MappingOptions, random_seed: int, *, intrinsics_given: bool
) -> pycolmap.GlobalPipelineOptions:
    """Translate our options into pycolmap's for global mapping, in one thread too.

    Tracks of two views count in all steps or in none: triangulated at the end only, they make
    points that bundle adjustment has not seen (measured: mean errors of up to 4 px). With them
    two photographs have a model, and on sparse sets the error of rotations fell more than it
    rose (Sacre Coeur 1.3 to 0.2, Herz-Jesu 0.14 to 0.07, Kermit 0.43 to 0.96 degrees).
    """
    refine = not (intrinsics_given and options.keep_given_intrinsics)
    native = pycolmap.GlobalPipelineOptions()
    values: dict[str, Plain] = {
        "min_model_size": options.min_model_size,
        "mapper.retriangulation.ignore_two_view_tracks": options.ignore_two_view_tracks,
        "mapper.bundle_adjustment.refine_focal_length": refine,
        "mapper.bundle_adjustment.refine_extra_params": refine,
    }
    if not options.ignore_two_view_tracks:
        values |= dict.fromkeys(GLOBAL_TRACK_LENGTHS, 2)
    for section in ("", "mapper.", "mapper.bundle_adjustment.ceres.solver_options."):
        values[f"{section}num_threads"] = 1
    for section in GLOBAL_SEEDED_SECTIONS:
        values[f"{section}random_seed"] = random_seed
    set_values(native, values | options.mapper_options)
    return native


def map_database(
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

    Which pair incremental mapping begins with is partly chance, and a bad one ends in a small
    model. So, while images are missing and the model is not large, it is tried again and the
    attempt with the largest model is kept. ``sparse_path`` appears only once all models are
    written.

    Args:
        database_path: database with two-view geometries.
        image_path: folder of the images, for the colours of the points.
        sparse_path: folder to make; an old one is removed.
        options: the mapper and its preset; ``mapper_options`` checked.
        random_seed: seed of all random parts.
        intrinsics_given: the user gave the camera parameters.
        next_image: called with the number of images registered since the last call; never
            more than there are, also when mapping is tried again. Global mapping registers
            all at once.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped and what it wrote removed.
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

    map_once = _map_globally_once if options.mapper == "global" else _map_incrementally_once
    try:
        for attempt in range(options.num_attempts):
            raw = partial / "raw"
            raw.mkdir(parents=True)
            seed = random_seed + attempt * ATTEMPT_SEED_STEP
            models = map_once(
                database_path,
                image_path,
                raw,
                options,
                seed,
                intrinsics_given=intrinsics_given,
                show=show,
            )
            shutil.rmtree(raw)
            best = max(best, sorted(models, key=_size, reverse=True), key=_size_of_largest)
            if _size_of_largest(best)[0] >= min(num_images, LARGE_MODEL):
                break
        for index, model in enumerate(best):
            _write(model, partial / str(index))
        partial.rename(sparse_path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return [summarize(model) for model in best]


def _map_incrementally_once(
    database_path: Path,
    image_path: Path,
    output_path: Path,
    options: MappingOptions,
    random_seed: int,
    *,
    intrinsics_given: bool,
    show: Callable[[int], None],
) -> list[pycolmap.Reconstruction]:
    """Map once; ``show`` is told how many images have been registered so far."""
    count = 0

    def add(number: int) -> None:
        nonlocal count
        count += number
        show(count)

    native = pipeline_options(options, random_seed, intrinsics_given=intrinsics_given)
    try:
        models = run_cancellable(
            lambda token: pycolmap.incremental_mapping(
                database_path,
                image_path,
                output_path,
                options=native,
                initial_image_pair_callback=lambda: add(2),
                next_image_callback=lambda: add(1),
                cancellation_token=token,
            )
        )
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise MappingError(f"COLMAP's incremental mapper failed: {reason}") from error
    return list(models.values())


def _map_globally_once(
    database_path: Path,
    image_path: Path,
    output_path: Path,
    options: MappingOptions,
    random_seed: int,
    *,
    intrinsics_given: bool,
    show: Callable[[int], None],
) -> list[pycolmap.Reconstruction]:
    """Map once; ``show`` is told at the end how many images are registered."""
    values = mapping_differences(options, random_seed, intrinsics_given=intrinsics_given)
    map_globally(database_path, image_path, output_path, values)
    models = [_read(folder) for folder in sorted(output_path.iterdir())]
    show(max((model.num_reg_images() for model in models), default=0))
    return models


def _write(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a new folder; pycolmap does not say when the disk is full."""
    folder.mkdir()
    model.write(folder)
    _require_written(folder)


def _read(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that pycolmap has just written."""
    _require_written(folder)
    return pycolmap.Reconstruction(folder)


def _require_written(folder: Path) -> None:
    try:
        registered_names(folder)
    except StoreError as error:
        raise cannot_write(folder, error) from error


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _size_of_largest(models: list[pycolmap.Reconstruction]) -> tuple[int, int]:
    return _size(models[0]) if models else (0, 0)


def read_models(sparse_path: Path) -> list[ModelSummary]:
    """Summarize the models that :func:`map_database` wrote."""
    folders = sorted(
        (p for p in sparse_path.iterdir() if p.name.isdigit()), key=lambda p: int(p.name)
    )
    for folder in folders:
        try:
            registered_names(folder)
        except StoreError as error:
            raise StoreError(f"{error}; run map again with --overwrite") from error
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
