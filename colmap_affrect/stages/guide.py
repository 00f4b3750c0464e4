"""Guide: matches of verified pairs once more, where their geometry allows them.

For the pairs of images that hang on few tracks through three images. Guided matches are less exact
than others, and where they outweigh these a model becomes less accurate; so other images are left
alone, and what was there before stays on record (``guided.h5``), to be told from it. The raw
matches stay as they are, as with COLMAP's own guided matching.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.connections import weakly_connected_images
from colmap_affrect.colmap.database import cameras_of_images
from colmap_affrect.colmap.database_verification import PairVerifier
from colmap_affrect.colmap.two_views import CALIBRATED, pair_model
from colmap_affrect.geometry.arrays import Array, Indices, Singles, rows_in
from colmap_affrect.geometry.epipolar import PairModel
from colmap_affrect.geometry.tilts import are_individual_shapes
from colmap_affrect.matchers.guided import GuidedOptions, guided_matches
from colmap_affrect.options import digest_of
from colmap_affrect.pairs.lists import USUAL_IMAGES_IN_MEMORY, Pair, ordered_for_reuse
from colmap_affrect.parallel.executor import Threads, available_cores
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.guided_store import GuidedPair
from colmap_affrect.project.match_store import PAIRS_PER_WRITE
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.session.context import Context
from colmap_affrect.stages.stationary import StationaryFilter
from colmap_affrect.stages.verify import extracted_px

MIN_SHARE_KEPT = 0.8  # of the inliers before, in a geometry with guided matches; judged
NOTHING: Indices = np.zeros((0, 2), np.int64)  # theory


def guide(context: Context, options: GuidedOptions | None = None) -> StageReport:
    """Match the verified pairs of some images again, guided by their geometry.

    A pair gets the geometry of its inliers and guided matches when that has more inliers than the
    one before. Pairs that were guided are not guided again.

    Args:
        context: of the workspace, whose pairs are verified.
        options: by default those on record.

    Returns:
        How many pairs were matched again now, and how many before.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    options = options or context.guiding
    workspace.record_options("guide", options.to_mapping())
    known = current(context)
    todo = list[Pair]()
    guiding = Guiding(context, options)
    if not _is_finished(context, options, known):
        todo = guiding.todo(known)
    with context.progress.stage("guide", len(todo), "pairs") as advance:
        guiding.guide(todo, advance)
    digest = _digest(context, options, current(context) if todo else known)
    workspace.record_input_digests(guided=digest)
    return StageReport(
        name="guide",
        wall_s=time.perf_counter() - start,
        num_done=len(todo),
        num_kept=len(known),
    )


def _is_finished(
    context: Context, options: GuidedOptions, known: Sequence[GuidedPair]
) -> bool:
    """Tell whether all pairs were looked at when they were as they are now."""
    finished = context.workspace.input_digest("guided")
    return bool(finished) and finished == _digest(context, options, known)


def _digest(
    context: Context, options: GuidedOptions, known: Sequence[GuidedPair]
) -> str:
    """Return a digest of what decides which pairs are guided.

    Args:
        context: of the workspace.
        options: of guided matching.
        known: the guided pairs whose geometry is the one on record.
    """
    guided = [[*pair.names, pair.num_inliers, len(pair.exact)] for pair in known]
    chosen = [options.to_mapping(), context.verification.to_mapping()]
    return digest_of([context.graph.digest(), chosen, guided])


def exact_inliers(
    context: Context, guided: Iterable[GuidedPair]
) -> dict[Pair, Indices]:
    """Return the inliers of each verified pair without the matches of :func:`current` ones."""
    exact = {pair.names: pair.exact for pair in guided if pair.num_inliers}
    return {**context.verified_inliers(), **exact}


def current(context: Context) -> list[GuidedPair]:
    """Return the guided pairs whose geometry is still the one on record.

    It is not where a run was killed before it was written, or the pair has other raw matches now.
    """
    path = context.workspace.database
    if not (context.workspace.guided.exists() and path.exists()):
        return []
    counts = context.graph.num_inliers(0)
    pairs = context.guided.read()
    return [pair for pair in pairs if pair.num_inliers in (0, counts.get(pair.names))]


def guided_counts(context: Context) -> dict[str, int]:
    """Return what the report says: pairs with more inliers, and these before and after."""
    gained = [pair for pair in current(context) if pair.num_inliers]
    if not gained:
        return {}
    return {
        "pairs": len(gained),
        "matches_before": sum(len(pair.exact) for pair in gained),
        "matches_after": sum(pair.num_inliers for pair in gained),
    }


@dataclass(frozen=True)
class GuidedTask:
    """A verified pair to match again; its image with the lower id comes first."""

    names: Pair  # of the two images
    model: PairModel  # its geometry, and all keypoints
    inliers: Indices  # (M, 2) of the geometry
    is_calibrated: bool  # the focal lengths of its cameras agree with the geometry

    def __str__(self) -> str:
        return " and ".join(self.names)


class GuidedMatcher:
    """Matches pairs again, with the features that it keeps of some images."""

    def __init__(self, store: FeatureStore, options: GuidedOptions) -> None:
        """Name the features; they are read when an image comes first."""
        self._store = store
        self._options = options
        self._images = lru_cache(USUAL_IMAGES_IN_MEMORY)(self._read)

    def __reduce__(self) -> tuple[Any, ...]:
        return GuidedMatcher, (self._store, self._options)

    def __call__(self, task: GuidedTask) -> Indices:
        """Return the (K, 2) inliers of a pair and its guided matches."""
        descriptors1, shapes1 = self._images(task.names[0])
        descriptors2, shapes2 = self._images(task.names[1])
        have_shapes = len(shapes1) and len(shapes2)
        return guided_matches(
            descriptors=(descriptors1, descriptors2),
            shapes=(shapes1, shapes2) if have_shapes else None,
            model=task.model,
            inliers=task.inliers,
            options=self._options,
        )

    def _read(self, name: str) -> tuple[Singles, Array]:
        """Return descriptors and, where frames were measured one by one, their linear parts."""
        features = self._store.read(name)
        shapes = features.lafs[:, :, :2]
        if not (len(shapes) and are_individual_shapes(shapes)):
            shapes = shapes[:0]
        return features.descriptors, shapes


class Guiding:
    """Guides the pairs of a workspace, with the options on record."""

    def __init__(self, context: Context, options: GuidedOptions) -> None:
        """Name the workspace.

        Args:
            context: of the workspace, whose pairs are verified.
            options: of guided matching.
        """
        self.context = context
        self.options = options
        self.ids = context.graph.ids
        max_size_px = context.extraction.max_image_size_px
        # Bands are as wide as features are exact: in pixels of the images as they were extracted.
        sizes = context.features.image_sizes().items()
        self.scales = {name: max(1.0, max(size) / max_size_px) for name, size in sizes}

    @cached_property
    def verifier(self) -> PairVerifier:
        """What verifies guided pairs, made when the first one is there."""
        return PairVerifier(
            ids=self.context.graph.ids,
            cameras=self.context.graph.cameras,
            options=self.context.verification,
            extracted_px=extracted_px(self.context),
        )

    def todo(self, known: Sequence[GuidedPair]) -> list[Pair]:
        """Return the pairs to guide.

        Args:
            known: those that are guided already.
        """
        exact = exact_inliers(self.context, known)
        images = self._images_to_guide(exact)
        pairs = [pair for pair in exact if not images.isdisjoint(pair)]
        escalated = self._escalated(pairs)
        done = {pair.names for pair in known}
        todo = list[Pair]()
        for pair in pairs:
            if pair not in done and frozenset(pair) not in escalated:
                todo.append(pair)
        return todo

    def _escalated(self, pairs: Sequence[Pair]) -> set[frozenset[str]]:
        """Return those pairs, as sets, that were matched again: they need no guided matching."""
        if not pairs:
            return set()
        asked = set(map(frozenset, pairs))
        listed = [
            pair for pair in self.context.listed_pairs() if frozenset(pair) in asked
        ]
        levels = self.context.matches.levels(listed)
        return {frozenset(pair) for pair, level in levels.items() if level}

    def _images_to_guide(self, exact: Mapping[Pair, Indices]) -> set[str]:
        """Return the images whose verified pairs are guided, by their exact inliers."""
        if self.options.enabled == "always":
            return set(self.ids)
        if self.options.enabled != "auto":
            return set()
        num_images = len(set[str]().union(*exact))
        # Of two images alone there are no longer tracks.
        limit = self.options.min_num_tracks if num_images > 2 else 0
        return weakly_connected_images(exact, limit)

    def guide(self, pairs: Sequence[Pair], advance: Callable[[int], None]) -> None:
        """Match verified pairs again, batch by batch, and keep what has more inliers.

        Args:
            pairs: of image names.
            advance: is called with the number of pairs that are done.
        """
        if not pairs:
            return
        features = self.context.features
        executor = self.context.executor or Threads(available_cores())
        matcher = GuidedMatcher(features, self.options)
        stationary = StationaryFilter(features, self.context.matches)
        ordered = ordered_for_reuse(pairs, USUAL_IMAGES_IN_MEMORY)
        for begin in range(0, len(ordered), PAIRS_PER_WRITE):
            batch = ordered[begin : begin + PAIRS_PER_WRITE]
            tasks = self._tasks(batch)
            found = list[tuple[GuidedTask, Indices]]()
            matched = executor.map(matcher, tasks, [features.path])
            without_model = set(batch)
            for task, matches in zip(tasks, matched, strict=True):
                moving = stationary.keep_mask(task.names, matches)
                found.append((task, matches[moving]))
                without_model.discard(task.names)
                advance(1)
            self.context.guided.write(
                GuidedPair(names=names, exact=NOTHING, num_inliers=0)
                for names in sorted(without_model)
            )
            advance(len(without_model))
            self._keep(found)

    def _tasks(self, pairs: Sequence[Pair]) -> list[GuidedTask]:
        """Return what is to be done for the pairs whose geometry says where matches may be."""
        tasks = []
        with self.context.graph.open_to_read() as database:
            cameras = cameras_of_images(database)
            for names in pairs:
                first = self.ids[names[0]]
                second = self.ids[names[1]]
                geometry = database.read_two_view_geometry(first, second)
                model = pair_model(
                    geometry,
                    cameras=(cameras[first], cameras[second]),
                    keypoints=(
                        database.read_keypoints(first),
                        database.read_keypoints(second),
                    ),
                )
                if not model:
                    continue
                inliers = np.asarray(geometry.inlier_matches, np.int64)
                scales = (self.scales[names[0]], self.scales[names[1]])
                tasks.append(
                    GuidedTask(
                        names=names,
                        model=model.scaled(*scales),
                        inliers=inliers.reshape(-1, 2),
                        is_calibrated=geometry.config == CALIBRATED,
                    )
                )
        return tasks

    def _keep(self, found: Sequence[tuple[GuidedTask, Indices]]) -> None:
        """Put better geometries into the database, and all pairs on record before that."""
        features = self.context.features
        geometries = dict[Pair, pycolmap.TwoViewGeometry]()
        for task, matches in found:
            if len(matches) <= len(task.inliers):
                continue
            first, second = task.names
            geometry = self.verifier.geometry(
                task.names,
                frames=(features.read_frames(first), features.read_frames(second)),
                indices=matches,
            )
            if is_better(geometry, task):
                geometries[task.names] = geometry
        pairs = []
        for task, _ in found:
            better = geometries.get(task.names)
            pairs.append(
                GuidedPair(
                    names=task.names,
                    exact=task.inliers,
                    num_inliers=len(better.inlier_matches) if better else 0,
                )
            )
        self.context.guided.write(pairs)
        self._write(geometries)

    def _write(self, geometries: Mapping[Pair, pycolmap.TwoViewGeometry]) -> None:
        if not geometries:
            return
        with self.context.graph.open_to_change(for_pairs=True) as database:
            for names, geometry in geometries.items():
                first, second = names
                database.update_two_view_geometry(
                    self.ids[first], self.ids[second], geometry
                )


def is_better(geometry: pycolmap.TwoViewGeometry, task: GuidedTask) -> bool:
    """Tell whether a geometry has more inliers, and is still that of the exact matches.

    Where structure repeats, guided matches may outvote them: exact inliers then fall out, or the
    cameras, whose focal lengths the geometry agreed with, do not fit any more.
    """
    if len(geometry.inlier_matches) <= len(task.inliers):
        return False
    uncalibrated = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    if task.is_calibrated and geometry.config == uncalibrated:
        return False
    kept = rows_in(task.inliers, np.asarray(geometry.inlier_matches, np.int64))
    return bool(kept.sum() >= MIN_SHARE_KEPT * len(task.inliers))
