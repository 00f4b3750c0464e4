"""From a verified database to a folder of models, by any mapper."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.model_files import registered_names, write_model
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.arrivals import arrivals, read_arrivals, write_arrivals
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.doubts import find_doubts, without_impossible
from colmap_affrect.project.report import ModelSummary

ATTEMPT_SEED_STEP = 1_000_003
"""Distance of the seeds of repeated attempts, so that those of runs 0, 1, 2, ... differ."""

LARGE_MODEL = 100
"""From this size on the first pair no longer matters, and another attempt takes long."""


def map_database(
    mapper: Mapper, task: MappingTask, sparse_path: Path, next_image: Callable[[int], None]
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    While images are missing and the model is not large, it is tried again with another seed, as
    often as the mapper's options allow, and the attempt with the largest model is kept. Images
    that are certainly wrong are taken out first (:mod:`colmap_affrect.mappers.doubts`).
    ``sparse_path`` appears only once all models are written.

    Args:
        mapper: with its options.
        task: what to map.
        sparse_path: folder to make; an old one is removed.
        next_image: called with the number of images registered since the last call; never
            more than there are, also when mapping is tried again.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped and what it wrote removed.
    """
    partial = sparse_path.with_name(sparse_path.name + ".partial")
    for old in (partial, sparse_path):
        shutil.rmtree(old, ignore_errors=True)
    num_images = len(image_ids(task.database_path))
    most_shown = 0
    best: list[MappedModel] = []

    def show(count: int) -> None:
        nonlocal most_shown
        news = min(count, num_images) - most_shown
        if news > 0:
            most_shown += news
            next_image(news)

    try:
        for attempt in range(mapper.options.max_num_attempts):
            raw = partial / "raw"
            raw.mkdir(parents=True)
            seed = mapper.options.random_seed + attempt * ATTEMPT_SEED_STEP
            found = mapper.map(task, raw, seed, show)
            shutil.rmtree(raw)
            models = [m for m in (without_impossible(model, task) for model in found) if m]
            best = max(best, sorted(models, key=_size, reverse=True), key=_size_of_largest)
            if _size_of_largest(best)[0] >= min(num_images, LARGE_MODEL):
                break
        for index, model in enumerate(best):
            write_model(model.reconstruction, partial / str(index))
            write_arrivals(model, partial / str(index))
        partial.rename(sparse_path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return [summarize(model, task) for model in best]


def _size(model: MappedModel) -> tuple[int, int]:
    return model.reconstruction.num_reg_images(), model.reconstruction.num_points3D()


def _size_of_largest(models: list[MappedModel]) -> tuple[int, int]:
    return _size(models[0]) if models else (0, 0)


def read_models(sparse_path: Path, task: MappingTask) -> list[ModelSummary]:
    """Summarize the models that :func:`map_database` wrote for a task."""
    folders = sorted(
        (p for p in sparse_path.iterdir() if p.name.isdigit()), key=lambda p: int(p.name)
    )
    for folder in folders:
        try:
            registered_names(folder)
        except StoreError as error:
            raise StoreError(f"{error}; run map again with --overwrite") from error
    models = (read_arrivals(pycolmap.Reconstruction(folder), folder) for folder in folders)
    return [summarize(model, task) for model in models]


def summarize(mapped: MappedModel, task: MappingTask) -> ModelSummary:
    """Count what a model holds, and judge it."""
    model, doubts = mapped.reconstruction, find_doubts(mapped, task)
    return ModelSummary(
        registered_names=tuple(
            sorted(model.images[image_id].name for image_id in model.reg_image_ids())
        ),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        doubtful=dict(doubts.images),
        doubts=doubts.model,
        arrivals=arrivals(mapped, task),
        taken_out=dict(mapped.taken_out),
    )
