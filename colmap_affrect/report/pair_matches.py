"""The matches of a pair of photographs, and what a run knows of each of them."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import require_known
from colmap_affrect.errors import OptionError, StoreError
from colmap_affrect.geometry.arrays import Array, Indices, rows_in
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.pair_choice import backed_pairs
from colmap_affrect.session.context import Context
from colmap_affrect.session.view_graph import ViewGraph
from colmap_affrect.stages.map import agreements

# Photographs whose features are kept in memory, 0.2 MB each: pairs go back to all that a
# photograph is verified with; resource
NUM_KEPT = 1_000


class MatchKind(IntEnum):
    """Where a match is from; of its two features the one with the higher kind decides."""

    OWN = 0  # an inlier of features that were detected in the photographs themselves
    WARPED = 1  # an inlier with a feature of a warp
    LEARNED = 2  # an inlier with a feature that has no affine shape
    GUIDED = 3  # an inlier that is no raw match: guided matching found it
    BY_HAND = 4  # a tie point
    FOREIGN = 5  # an inlier of features that are not those of the run
    REJECTED = 6  # a raw match that is no inlier


@dataclass(frozen=True)
class MatchedPair:
    """The matches of two photographs."""

    sizes: list[tuple[int, int]]  # (width, height) of the photographs in px
    points: list[Array]  # (N, 2) px from the upper left corner of each photograph
    kinds: Indices  # (N,) values of MatchKind
    text: str  # how many there are, of which level, and how many agree with the model
    is_backed: bool = False  # by the rest of the model


class PairReader:
    """Reads pairs of a database, with what the stores and the model of a run know."""

    def __init__(
        self, graph: ViewGraph, context: Context, models: ModelReader | None = None
    ) -> None:
        """Read the model of a run, and how its pairs agree with it.

        Args:
            graph: of the database.
            context: of the run; its folder need not have anything.
            models: reads the models of the run.
        """
        workspace = context.workspace
        models = models or ModelReader(workspace.sparse)
        has_stores = "match" in workspace.started_stages and not workspace.is_changed
        self.graph = graph
        self.run = context if has_stores else None
        has_model = models.path(0).exists()
        self.model = models.model(0) if has_model else pycolmap.Reconstruction()
        # Share of inliers, by verified pair
        self.agreement = agreements(self.graph, self.model)
        self._backed = backed_pairs(self.agreement)
        self._stored_kinds = lru_cache(NUM_KEPT)(self._read_stored_kinds)
        self._keypoints = lru_cache(NUM_KEPT)(self._read_keypoints)
        # Of pairs whose matches are stored, those that were looked up
        self._levels = dict[Pair, int]()

    @cached_property
    def _recipe_levels(self) -> list[tuple[str, bool]]:
        """Name of each level of the recipe on record, and whether its features have shapes."""
        levels = self.run.extraction.levels if self.run else ()
        return [(level.name, level.features.has_shapes) for level in levels]

    def read(self, names: Pair) -> MatchedPair:
        """Read a pair; OptionError for photographs that are not there or were never matched."""
        sizes = []
        keypoints = []
        ids = self.graph.ids
        for name in names:
            require_known(name, ids)
            camera = self.graph.cameras[name]
            sizes.append((camera.width, camera.height))
            keypoints.append(self._keypoints(name))
        pair_ids = (ids[names[0]], ids[names[1]])
        with self.graph.open_to_read() as database:
            raw = np.asarray(database.read_matches(*pair_ids), np.int64).reshape(-1, 2)
            geometry = database.read_two_view_geometry(*pair_ids)
            is_matched = database.exists_matches(*pair_ids)
        inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        tie_points = self._tie_points(names, keypoints)
        num_tie_points = len(tie_points[0])
        if not is_matched and not len(inliers) and not num_tie_points:
            raise OptionError(
                "never matched",
                where=f"{names[0]}, {names[1]}",
                advice="give another pair",
            )
        kinds = self._feature_kinds(names, keypoints, inliers)
        kinds[(kinds != MatchKind.FOREIGN) & ~rows_in(inliers, raw)] = MatchKind.GUIDED
        rejected = raw[~rows_in(raw, inliers)]
        matches = np.concatenate([inliers, rejected])
        return MatchedPair(
            sizes,
            [
                np.concatenate([keypoints[k][matches[:, k]], tie_points[k]])
                for k in (0, 1)
            ],
            np.concatenate(
                [
                    kinds,
                    np.full(len(rejected), MatchKind.REJECTED),
                    np.full(num_tie_points, MatchKind.BY_HAND),
                ]
            ),
            self._text(names, len(raw), len(inliers)),
            (min(names), max(names)) in self._backed,
        )

    def look_up_levels(self, pairs: Iterable[Pair]) -> None:
        """Read the levels of many pairs together; for each alone a file would be opened.

        There are none of pairs that another program has matched, nor of a store that is damaged.
        """
        ordered = [(min(pair), max(pair)) for pair in pairs]
        if self.run:
            with suppress(StoreError):
                self._levels |= self.run.matches.levels_of_stored(ordered)

    def _feature_kinds(
        self, names: Pair, keypoints: list[Array], matches: Indices
    ) -> Indices:
        """Return the kinds of matches by their features: foreign if these are not of the run.

        Args:
            names: of the photographs.
            keypoints: (N, 2) of the database, by photograph.
            matches: (M, 2) features.
        """
        kinds = np.full(len(matches), MatchKind.OWN)
        for side, name in enumerate(names):
            stored = self._stored_kinds(name)
            if len(stored) != len(keypoints[side]):  # another program changed it
                return np.full(len(matches), MatchKind.FOREIGN)
            kinds = np.maximum(kinds, stored[matches[:, side]])
        return kinds

    def _read_keypoints(self, name: str) -> Array:
        """Return (N, 2) px from the upper left corner of a photograph."""
        with self.graph.open_to_read() as database:
            rows = database.read_keypoints(self.graph.ids[name])
        return np.asarray(rows[:, :2], np.float64)

    def _read_stored_kinds(self, name: str) -> Indices:
        """Return the kinds of the features of a photograph; none where the run has none."""
        if not self.run:
            return np.empty(0, dtype=np.int64)
        ids = self.run.features.read_rectification_ids(name)
        kinds = np.where(ids, MatchKind.WARPED, MatchKind.OWN)
        for level, rows in self.run.features.level_ranges(name).items():
            _, has_shapes = self._recipe_levels[level]
            if not has_shapes:
                kinds[rows.start : rows.stop] = MatchKind.LEARNED
        return kinds

    def _tie_points(self, names: Pair, keypoints: list[Array]) -> list[Array]:
        """Return the tie points of a pair, (T, 2) px from the upper left corner by photograph.

        The model has them as keypoints behind those of the database (``colmap/by_hand``).
        """
        marks: list[dict[int, Array]] = [{}, {}]  # by the id of their 3D point
        for side, name in enumerate(names):
            image = self.model.find_image_with_name(name)
            for point in image.points2D[len(keypoints[side]) :] if image else ():
                if point.has_point3D():
                    marks[side][point.point3D_id] = point.xy
        points: list[list[Array]] = [[], []]
        for point_id in marks[0]:
            if point_id in marks[1]:
                points[0].append(marks[0][point_id])
                points[1].append(marks[1][point_id])
        return [np.array(points[0]).reshape(-1, 2), np.array(points[1]).reshape(-1, 2)]

    def _text(self, names: Pair, num_raw: int, num_inliers: int) -> str:
        """Return how many matches a pair has, how they came, and what the model says."""
        text = f"{num_raw} matches"
        if self.run:
            pair = (min(names), max(names))
            if pair not in self._levels:
                self.look_up_levels([pair])
            level = self._levels.get(pair)
            if level is not None:
                name, _ = self._recipe_levels[level]
                text += f" by {name}"
        text += f", {num_inliers} inliers"
        share = self.agreement.get(names, self.agreement.get(names[::-1]))
        if share is not None:
            text += f", {share:.0%} of them agree with the model"
        return text
