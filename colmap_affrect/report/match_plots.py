"""Verified pairs drawn with their inliers, the two photographs side by side, as parts of a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Array, Bools
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.report.pictures import Picture

MAX_NUM_LINES = 100

PLOT_HEIGHT, GAP = 300.0, 8.0  # of two photographs side by side, in units of the plot


@dataclass(frozen=True)
class SideBySide:
    """Two photographs of given widths side by side, both ``PLOT_HEIGHT`` high."""

    names: Pair
    widths: tuple[float, float]

    @classmethod
    def of(cls, names: Pair, pictures: Mapping[str, Picture]) -> Self:
        """Put the pictures of a pair side by side."""
        first, second = (PLOT_HEIGHT * pictures[n].width / pictures[n].height for n in names)
        return cls(names, (first, second))

    @property
    def second_left(self) -> float:
        """Left side of the second photograph."""
        return self.widths[0] + GAP

    @property
    def width(self) -> float:
        """Of the plot."""
        return self.second_left + self.widths[1]


@dataclass(frozen=True)
class MatchPlot:
    """The inliers of a pair, to be drawn over its photographs."""

    num_inliers: int
    num_from_warps: int = 0  # inliers with a feature from a warp
    plain: str = ""  # SVG path of the lines of the others
    warped: str = ""  # and of these
    missing: str = ""  # why there are no lines; empty if there are, or nothing was verified


def plot_inliers(
    shown: Sequence[SideBySide],
    pair_inliers: Mapping[Pair, int],
    database_path: Path,
    features_path: Path,
) -> dict[Pair, MatchPlot]:
    """Draw the inliers of pairs; ``database_path`` has keypoints and two-view geometries.

    The feature store, if it exists, tells which features are from warps.
    """
    counts = {item.names: pair_inliers.get(item.names, 0) for item in shown}
    plots = {names: MatchPlot(count) for names, count in counts.items()}
    verified = [item for item in shown if counts[item.names]]
    try:
        found = _read_inliers([item.names for item in verified], database_path, features_path)
    except AffrectError as error:
        return plots | {n: MatchPlot(c, missing=str(error)) for n, c in counts.items() if c}
    for item, (ends, from_warps) in zip(verified, found, strict=True):
        plots[item.names] = _plot(counts[item.names], item, ends, from_warps)
    return plots


def _read_inliers(
    pairs: Sequence[Pair], database_path: Path, features_path: Path
) -> list[tuple[Array, Bools]]:
    """Read the inliers of pairs.

    For each pair: (M, 2, 2) ends of its inliers, (x, y) in both images as shares of their sides,
    and (M,) whether one of the two features is from a warp.
    """
    if not pairs:
        return []
    store = FeatureStore(features_path) if features_path.exists() else None
    found = []
    with open_copy(database_path) as database:
        images = {image.name: image for image in database.read_all_images()}
        for pair in pairs:
            one, two = (images[name] for name in pair)
            geometry = database.read_two_view_geometry(one.image_id, two.image_id)
            indices = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
            ends = np.zeros((len(indices), 2, 2))
            from_warps = np.zeros(len(indices), dtype=bool)
            for side, image in enumerate((one, two)):
                camera = database.read_camera(image.camera_id)
                points = database.read_keypoints(image.image_id)[indices[:, side], :2]
                ends[:, side] = points / [camera.width, camera.height]
                if store:
                    from_warps |= store.read_rectification_ids(image.name)[indices[:, side]] > 0
            found.append((ends, from_warps))
    return found


def _plot(num_inliers: int, shown: SideBySide, ends: Array, from_warps: Bools) -> MatchPlot:
    points = ends * [[shown.widths[0], PLOT_HEIGHT], [shown.widths[1], PLOT_HEIGHT]]
    points[:, 1, 0] += shown.second_left
    every = max(1, -(-len(points) // MAX_NUM_LINES))
    paths = {False: "", True: ""}
    for line, warped in zip(points[::every].tolist(), from_warps[::every].tolist(), strict=True):
        (x1, y1), (x2, y2) = line
        paths[warped] += f"M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"
    return MatchPlot(num_inliers, int(np.count_nonzero(from_warps)), paths[False], paths[True])
