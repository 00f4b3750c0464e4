"""The pairs where methods differ most, drawn with their inliers, before and after rectification."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.copies import open_copy
from colmap_affrect.comparison.results import Comparison, MethodResult, Pair
from colmap_affrect.errors import AffrectError
from colmap_affrect.report.pictures import Picture
from colmap_affrect.store import FeatureStore
from colmap_affrect.workspace import Workspace

MAX_NUM_PAIRS = 6
MAX_PAIRS_OF_IMAGE = 2
MAX_NUM_LINES = 150
FEW_INLIERS = 20

PLOT_HEIGHT, GAP = 300.0, 8.0
"""Of two photographs side by side, in units of the plot."""


@dataclass(frozen=True)
class ChosenPair:
    """A pair to draw, and the two methods that differ on it.

    Attributes:
        names: of the images.
        before: the method with fewer inliers, or the one that does not rectify.
        after: the other one.
    """

    names: Pair
    before: MethodResult
    after: MethodResult


def inliers_of(method: MethodResult, pair: Pair) -> int:
    """Return the inliers of a pair with the first seed; 0 if it is not verified."""
    return method.seeds[0].pair_inliers.get(pair, 0) if method.seeds else 0


def contrast(counts: Sequence[int]) -> float:
    """Tell how much numbers of inliers differ: by a ratio, in which few count as hardly any.

    >>> contrast([0, 200]) > contrast([1000, 2000]) > contrast([0, 10]) > contrast([7, 7])
    True
    """
    return log((max(counts) + FEW_INLIERS) / (min(counts) + FEW_INLIERS))


def choose_pairs(comparison: Comparison, rectifying: Collection[str]) -> list[ChosenPair]:
    """Return the pairs with the largest differences, each image in at most two of them.

    Where there are methods that rectify and others that do not, the best of the one kind is
    compared with the best of the other; else the best method with the worst.

    Args:
        comparison: the results.
        rectifying: names of the methods that warp photographs.
    """
    warped = [method for method in comparison.finished if method.name in rectifying]
    plain = [method for method in comparison.finished if method.name not in rectifying]
    everyone = list(comparison.finished)

    def chosen(pair: Pair) -> ChosenPair:
        def key(method: MethodResult) -> int:
            return inliers_of(method, pair)

        if warped and plain:
            return ChosenPair(pair, max(plain, key=key), max(warped, key=key))
        return ChosenPair(pair, min(everyone, key=key), max(everyone, key=key))

    def difference(item: ChosenPair) -> float:
        return contrast([inliers_of(item.before, item.names), inliers_of(item.after, item.names)])

    pairs = sorted({pair for m in everyone for seed in m.seeds[:1] for pair in seed.pair_inliers})
    ranked = sorted(map(chosen, pairs), key=lambda item: -difference(item))
    uses: dict[str, int] = {}
    found: list[ChosenPair] = []
    for item in ranked:
        fits = all(uses.get(name, 0) < MAX_PAIRS_OF_IMAGE for name in item.names)
        if fits and difference(item) > 0 and len(found) < MAX_NUM_PAIRS:
            found.append(item)
            for name in item.names:
                uses[name] = uses.get(name, 0) + 1
    return found


@dataclass(frozen=True)
class MatchPlot:
    """Inliers of one method over two photographs.

    Attributes:
        method: its name.
        num_inliers: as verified.
        num_from_warps: inliers with a feature from a warp.
        plain, warped: SVG paths of the lines of the others and of these.
        missing: why there are no lines; empty if there are, or nothing was verified.
    """

    method: str
    num_inliers: int
    num_from_warps: int = 0
    plain: str = ""
    warped: str = ""
    missing: str = ""


@dataclass(frozen=True)
class PairPlots:
    """Two photographs side by side, and what methods found there.

    Attributes:
        names: of the images.
        widths: of the two photographs; both are ``PLOT_HEIGHT`` high.
        plots: before and after.
    """

    names: Pair
    widths: tuple[float, float]
    plots: tuple[MatchPlot, ...]

    @property
    def second_left(self) -> float:
        """Left side of the second photograph."""
        return self.widths[0] + GAP

    @property
    def width(self) -> float:
        """Of the plot."""
        return self.second_left + self.widths[1]


def plot_pairs(
    chosen: Sequence[ChosenPair], pictures: dict[str, Picture], output_path: Path
) -> list[PairPlots]:
    """Draw the inliers of pairs whose photographs can be shown.

    Args:
        chosen: what to draw.
        pictures: of the photographs by name.
        output_path: folder of the comparison.
    """
    shown = [item for item in chosen if all(name in pictures for name in item.names)]
    widths = {
        item.names: tuple(
            PLOT_HEIGHT * pictures[name].width / pictures[name].height for name in item.names
        )
        for item in shown
    }
    methods = {method.name: method for item in shown for method in (item.before, item.after)}
    drawn: dict[tuple[str, Pair], MatchPlot] = {}
    for method in methods.values():
        pairs = [item.names for item in shown if method.name in (item.before.name, item.after.name)]
        for pair in pairs:
            drawn[method.name, pair] = MatchPlot(method.name, inliers_of(method, pair))
        verified = [pair for pair in pairs if inliers_of(method, pair)]
        try:
            for pair, ends, from_warps in _read_inliers(method, verified, output_path):
                drawn[method.name, pair] = _plot(method, pair, ends, from_warps, widths[pair])
        except AffrectError as error:
            for pair in verified:
                count = inliers_of(method, pair)
                drawn[method.name, pair] = MatchPlot(method.name, count, missing=str(error))
    return [
        PairPlots(
            item.names,
            (widths[item.names][0], widths[item.names][1]),
            (drawn[item.before.name, item.names], drawn[item.after.name, item.names]),
        )
        for item in shown
    ]


InlierEnds = tuple[Pair, NDArray[np.float64], NDArray[np.bool_]]


def _read_inliers(
    method: MethodResult, pairs: Sequence[Pair], output_path: Path
) -> list[InlierEnds]:
    """Read the inliers of pairs.

    Returns:
        For each pair the (M, 2, 2) ends of its inliers, (x, y) in both images as shares of their
        sides, and (M,) whether one of the two features is from a warp.
    """
    if not pairs:
        return []
    workspace = Workspace(output_path / method.folder)
    store = FeatureStore(workspace.features)
    seed_path = workspace.path / f"seed-{method.seeds[0].seed}" / "database.db"
    found = []
    with open_copy(seed_path) as database:
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
                if workspace.features.exists():
                    ids = store.read_rectification_ids(image.name)
                    from_warps |= ids[indices[:, side]] > 0
            found.append((pair, ends, from_warps))
    return found


def _plot(
    method: MethodResult,
    pair: Pair,
    ends: NDArray[np.float64],
    from_warps: NDArray[np.bool_],
    widths: Sequence[float],
) -> MatchPlot:
    points = ends * [[widths[0], PLOT_HEIGHT], [widths[1], PLOT_HEIGHT]]
    points[:, 1, 0] += widths[0] + GAP
    every = max(1, -(-len(points) // MAX_NUM_LINES))
    lines = [
        f"M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}" for (x1, y1), (x2, y2) in points[::every].tolist()
    ]
    warped = from_warps[::every].tolist()
    return MatchPlot(
        method.name,
        inliers_of(method, pair),
        int(np.count_nonzero(from_warps)),
        "".join(line for line, is_warped in zip(lines, warped, strict=True) if not is_warped),
        "".join(line for line, is_warped in zip(lines, warped, strict=True) if is_warped),
    )
