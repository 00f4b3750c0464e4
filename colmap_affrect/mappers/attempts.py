"""From a verified database to a folder of models, by any mapper."""

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import all_cameras, image_ids
from colmap_affrect.colmap.model_files import SUMMARY, num_long_tracks, read_model, write_model
from colmap_affrect.colmap.verification import inlier_matches, num_tied
from colmap_affrect.mappers.arrivals import arrivals
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.doubts import (
    FOCAL_DOUBT,
    MIRRORED_COPY,
    find_doubts,
    loose_names,
    without_impossible,
)
from colmap_affrect.mappers.existing import require_extends
from colmap_affrect.mappers.last_adjustment import MIN_NUM_TRACKS, adjust_last, robust_options
from colmap_affrect.mappers.loose_cameras import loose_images
from colmap_affrect.mappers.pair_graph import MIN_NUM_MATCHES, graph_of
from colmap_affrect.mappers.snapshots import snapshots_of, with_snapshots
from colmap_affrect.mappers.starts import (
    Start,
    focals_px,
    rival_focals_px,
    runaways,
    started,
    starts,
    unknown_cameras,
)
from colmap_affrect.mappers.summaries import model_folders, read_summary, write_summary
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.report import ModelSummary

logger = logging.getLogger(__name__)

ATTEMPT_SEED_STEP = 1_000_003
"""Distance of the seeds of repeated attempts, so that those of runs 0, 1, 2, ... differ."""

MAX_HOLDING_ATTEMPTS = 2
"""More than the others, to hold cameras that ran away."""

LARGE_MODEL = 100
"""From this size on the first pair no longer matters, and another attempt takes long."""

REFINING = "ba_refine_", "mapper.bundle_adjustment.refine_"
"""What options of COLMAP's two mappers begin with that say what of cameras is refined."""


def map_database(
    mapper: Mapper, task: MappingTask, sparse_path: Path, next_image: Callable[[int], None]
) -> list[ModelSummary]:
    """Map a verified database and write the models to ``sparse_path``/0, /1, ..., largest first.

    While images that verified pairs connect are missing and the model is not large, it is tried
    again with another seed, as often as the mapper's options allow, and the attempt that agrees
    best with the verified pairs is kept. Images that are certainly wrong are taken out first
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
    remove_own([partial] if task.extend else [partial, sparse_path])
    try:
        best = _best_attempt(mapper, task, sparse_path, partial, next_image)
        is_final = task.extend or mapper.options.is_complete
        if not is_final and _adjust_weak(mapper, task, best):
            best = sorted(_possible(best, task), key=_size, reverse=True)
        summaries = []
        for index, model in enumerate(best):
            write_model(model.reconstruction, partial / str(index))
            summaries.append(summarize(model, task, is_largest=index == 0))
            write_summary(summaries[-1], partial / str(index))
        remove_own([sparse_path])
        partial.rename(sparse_path)
    finally:
        remove_own([partial])
    return summaries


def _best_attempt(
    mapper: Mapper,
    task: MappingTask,
    sparse_path: Path,
    partial: Path,
    next_image: Callable[[int], None],
) -> list[MappedModel]:
    """Return the models of the best of all attempts, largest first; ``partial`` is for their work.

    Snapshots are kept beside ``sparse_path``.
    """
    num_images = len(image_ids(task.database_path))
    most_shown = 0
    best: list[MappedModel] = []

    def show(count: int) -> None:
        nonlocal most_shown
        news = min(count, num_images) - most_shown
        if news > 0:
            most_shown += news
            next_image(news)

    with with_snapshots(task, mapper.options, snapshots_of(sparse_path), num_images) as kept:
        attempts = _Attempts(mapper, kept, num_tied(task.database_path, MIN_NUM_MATCHES))
        while attempts.go_on(best):
            raw = partial / "raw"
            raw.mkdir(parents=True)
            found = attempts.next(partial / "started.db", raw, show)
            remove_own([raw])
            if not task.extend:  # whose images stay, whatever they are
                found = _possible(found, kept)
            found = sorted(found, key=_size, reverse=True)
            attempts.judge(found)
            best = better(kept, best, found)
        (partial / "started.db").unlink(missing_ok=True)
    return attempts.with_rivals(best)


class _Attempts:
    """Which attempts there are: with several seeds, and from several focal lengths.

    One that has all images that verified pairs connect, each with enough points of three images, is
    the last.
    Cameras that ran away in the last one are held in those that follow.
    """

    def __init__(self, mapper: Mapper, task: MappingTask, num_images: int) -> None:
        self._mapper, self._num_images = mapper, num_images
        self._given = self._task = task
        once = task.extend or num_images >= LARGE_MODEL or mapper.options.is_complete
        self._starts = [Start()] if once else starts(task)
        num = 1 if task.extend else mapper.options.max_num_attempts
        self._limit = max(num, len(self._starts))
        self._most = self._limit + MAX_HOLDING_ATTEMPTS
        self._done = 0
        self._ran: set[int] = set()
        self._focals: list[tuple[float, dict[str, float]]] = []

    def go_on(self, best: list[MappedModel]) -> bool:
        """Tell whether there is another attempt, after the best models so far."""
        task = self._task
        is_final = task.extend or self._mapper.options.is_complete
        if self._ran - task.held and not is_final and self._done < self._most:
            self._task = replace(task, held=task.held | self._ran)
            self._limit = max(self._limit, self._done + 1)
            return True
        if self._done >= self._limit:
            return False
        if not best or _num_settled(best[0]) < min(self._num_images, LARGE_MODEL):
            return True
        return self._done < len(self._starts) and not _is_well_tied(best[0].reconstruction)

    def judge(self, found: list[MappedModel]) -> None:
        """Keep how well the largest model of an attempt agrees with the pairs, and its focals."""
        if found and len(self._starts) > 1:
            model = found[0].reconstruction
            self._focals.append((graph_of(self._given).score_of(model), focals_px(model)))

    def with_rivals(self, best: list[MappedModel]) -> list[MappedModel]:
        """Return models whose largest one knows the focal lengths of those as good as it."""
        told_by = self._given.told_by
        if not best or not (self._focals or told_by):
            return best
        rivals = dict(told_by.rival_focals_px) if told_by else {}
        if self._focals:
            rivals |= rival_focals_px(self._focals)
        names = focals_px(best[0].reconstruction).keys()
        inside = {name: ends for name, ends in rivals.items() if name in names}
        return [replace(best[0], rival_focals_px=inside), *best[1:]]

    def next(
        self, database_path: Path, output_path: Path, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """Map once more."""
        seed = self._mapper.options.random_seed + self._done * ATTEMPT_SEED_STEP
        start = self._starts[self._done % len(self._starts)]
        self._done += 1
        task = started(self._task, start, database_path)
        self._task = replace(self._task, snapshot_path=None)  # those are of the first attempt
        found = self._mapper.map(task, output_path, seed, show)
        self._ran = runaways(max(found, key=_size).reconstruction, self._task) if found else set()
        return found


def _num_settled(model: MappedModel) -> int:
    """Return how many images are registered, or are copies that belong nowhere."""
    copies = [why for why in model.taken_out.values() if MIRRORED_COPY in why]
    return _size(model)[0] + len(copies)


def _is_well_tied(model: pycolmap.Reconstruction) -> bool:
    """Tell whether all images see enough points of three images, which know focal lengths."""
    counts = num_long_tracks(model)
    return all(counts[image_id] >= MIN_NUM_TRACKS for image_id in model.reg_image_ids())


def _needs_cameras(model: MappedModel, task: MappingTask) -> bool:
    """Tell whether nobody knows cameras of a model, nor many images."""
    if model.reconstruction.num_reg_images() >= LARGE_MODEL:  # has points of many images
        return False
    images = model.reconstruction.images.values()
    used = {image.camera_id for image in images if image.has_pose}
    return not used.isdisjoint(unknown_cameras(task))


def _possible(models: list[MappedModel], task: MappingTask) -> list[MappedModel]:
    """Return models without the images that are certainly wrong."""
    return [model for model in (without_impossible(each, task) for each in models) if model]


def _adjust_weak(mapper: Mapper, task: MappingTask, models: list[MappedModel]) -> bool:
    """Adjust models that guided matches or bridges hold, or small ones whose cameras nobody knows.

    Others stay as COLMAP made them. What the user says is not to be refined stays as well.

    Returns:
        Whether there were any.
    """
    weak = [
        model for model in models if task.guided or model.bridges or _needs_cameras(model, task)
    ]
    if not weak:
        return False
    verified = inlier_matches(task.database_path, 1)
    unknown = unknown_cameras(task)
    begun = {c.camera_id: c for c in all_cameras(task.database_path) if c.camera_id in unknown}
    for model in weak:
        constant = task.constant_cameras(mapper.options) | runaways(model.reconstruction, task)
        if task.keeps_focal_lengths(mapper.options):
            constant = set(model.reconstruction.cameras)
        adjust_last(
            model.reconstruction,
            verified,
            task.guided,
            constant_cameras=constant,
            starts=begun,
            options=_refining(mapper.options.mapper_options),
        )
    return True


def _refining(given: Mapping[str, Any]) -> pycolmap.BundleAdjustmentOptions:
    """Return robust options that refine of cameras what options of a mapper say."""
    options = robust_options()
    for part in ("focal_length", "principal_point", "extra_params"):
        for prefix in REFINING:
            if prefix + part in given:
                setattr(options, f"refine_{part}", given[prefix + part])
    return options


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
    """Return the summaries of the models that :func:`map_database` wrote for a task.

    A model whose summary is damaged is judged anew; how it came about is not known any more.
    """
    return [read_summary(path) or _judged_anew(path, task) for path in model_folders(sparse_path)]


def _judged_anew(folder: Path, task: MappingTask) -> ModelSummary:
    logger.warning("%s: %s is missing or damaged; the model is judged anew", folder, SUMMARY)
    return summarize(MappedModel(read_model(folder)), task, is_largest=folder.name == "0")


def _sharing_cameras(model: pycolmap.Reconstruction, names: Collection[str]) -> set[str]:
    """Return the names of the registered images that have the cameras of some of them."""
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    keys = {image.camera_id for image in images if image.name in names}
    return {image.name for image in images if image.camera_id in keys}


def summarize(mapped: MappedModel, task: MappingTask, *, is_largest: bool) -> ModelSummary:
    """Count what a model holds, and judge it."""
    model = mapped.reconstruction
    loose = set(loose_images(model, task)) if is_largest and not task.extend else set()
    if task.told_by:
        loose |= _sharing_cameras(model, loose_names(task.told_by))
    doubts, focals = find_doubts(mapped, task, loose), focals_px(model)
    return ModelSummary(
        registered_names=tuple(sorted(focals)),
        num_points3D=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error_px=float(model.compute_mean_reprojection_error()),
        doubtful=dict(doubts.images),
        doubts=doubts.model,
        arrivals=arrivals(mapped, task),
        taken_out=dict(mapped.taken_out),
        focals_px=focals,
        rival_focals_px=dict(mapped.rival_focals_px),
        loose=tuple(name for name, why in doubts.images.items() if why == FOCAL_DOUBT),
    )
