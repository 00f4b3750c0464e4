"""From a verified database to a folder of models, by any mapper."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.model_files import registered_names, write_model
from colmap_affrect.colmap.verification import inlier_matches
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.arrivals import arrivals, read_arrivals, write_arrivals
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.doubts import find_doubts, without_impossible
from colmap_affrect.mappers.existing import require_extends
from colmap_affrect.mappers.last_adjustment import adjust_last
from colmap_affrect.mappers.pair_graph import graph_of
from colmap_affrect.mappers.snapshots import snapshots_of, with_snapshots
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
    often as the mapper's options allow, and the attempt that agrees best with the verified pairs is
    kept. Images that are certainly wrong are taken out first
    (:mod:`colmap_affrect.mappers.doubts`). ``sparse_path`` appears only once all models are
    written. A model is extended once, and what was in ``sparse_path``, perhaps this model, stays
    there until then.

    Args:
        mapper: with its options.
        task: what to map.
        sparse_path: folder to make; an old one is removed.
        next_image: called with the number of images registered since the last call; never
            more than there are, also when mapping is tried again.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped and what it wrote, but snapshots, removed.
        OptionError: when the mapper cannot extend a model.
    """
    if task.extend:
        require_extends(mapper.options)
    partial = sparse_path.with_name(sparse_path.name + ".partial")
    for old in (partial,) if task.extend else (partial, sparse_path):
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
        with with_snapshots(task, mapper.options, snapshots_of(sparse_path), num_images) as kept:
            for attempt in range(1 if task.extend else mapper.options.max_num_attempts):
                raw = partial / "raw"
                raw.mkdir(parents=True)
                seed = mapper.options.random_seed + attempt * ATTEMPT_SEED_STEP
                found = mapper.map(kept, raw, seed, show)
                shutil.rmtree(raw)
                if not task.extend:  # whose images stay, whatever they are
                    found = [m for m in (without_impossible(model, kept) for model in found) if m]
                best = better(kept, best, sorted(found, key=_size, reverse=True))
                if best and _size(best[0])[0] >= min(num_images, LARGE_MODEL):
                    break
        if not task.extend:
            _adjust_weak(mapper, task, best)
        shutil.rmtree(sparse_path, ignore_errors=True)
        for index, model in enumerate(best):
            write_model(model.reconstruction, partial / str(index))
            write_arrivals(model, partial / str(index))
        partial.rename(sparse_path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return [summarize(model, task) for model in best]


def _adjust_weak(mapper: Mapper, task: MappingTask, models: list[MappedModel]) -> None:
    """Adjust models that guided matches or bridges hold; others stay as COLMAP made them."""
    weak = [model for model in models if task.guided or model.bridges]
    verified = inlier_matches(task.database_path, 1) if weak else {}
    refine = not (task.intrinsics_given and mapper.options.keep_given_intrinsics)
    for model in weak:
        adjust_last(model.reconstruction, verified, task.guided, refine_intrinsics=refine)


def _size(model: MappedModel) -> tuple[int, int]:
    return model.reconstruction.num_reg_images(), model.reconstruction.num_points3D()


def better(
    task: MappingTask, models: list[MappedModel], others: list[MappedModel]
) -> list[MappedModel]:
    """Return the models of two attempts with which the verified pairs agree best."""
    if not models or not others:
        return models or others
    graph = graph_of(task)
    return max(models, others, key=lambda found: graph.best_score(m.reconstruction for m in found))


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
