"""The pairs of photographs on which methods differ most, and their inliers drawn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path

from colmap_affrect.comparison.results import MethodResult
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.match_plots import MatchPlot, SideBySide, plot_inliers
from colmap_affrect.report.pictures import Picture

MAX_NUM_PAIRS = 6
MAX_PAIRS_OF_IMAGE = 2
FEW_INLIERS = 20


def contrast(counts: Sequence[int]) -> float:
    """Tell how much numbers of inliers differ: by a ratio, in which few count as hardly any.

    >>> contrast([0, 200]) > contrast([1000, 2000]) > contrast([0, 10]) > contrast([7, 7])
    True
    """
    return log((max(counts) + FEW_INLIERS) / (min(counts) + FEW_INLIERS))


def pair_rows(methods: Sequence[MethodResult]) -> list[tuple[Pair, list[int]]]:
    """Return the verified pairs with their inliers by method, those that differ most first."""
    pairs = sorted({pair for method in methods for pair in method.pair_inliers})
    rows = [(pair, [method.pair_inliers.get(pair, 0) for method in methods]) for pair in pairs]
    return sorted(rows, key=lambda row: -contrast(row[1]))


@dataclass(frozen=True)
class ChosenPair:
    """A pair to draw, and two methods: of fewer inliers, or without rectification, and of more."""

    names: Pair
    before: MethodResult
    after: MethodResult

    @property
    def difference(self) -> float:
        """How much the two methods differ."""
        methods = (self.before, self.after)
        return contrast([method.pair_inliers.get(self.names, 0) for method in methods])


def choose_pairs(methods: Sequence[MethodResult], rectifying: Collection[str]) -> list[ChosenPair]:
    """Return the pairs with the largest differences, each image in at most two of them.

    Where some methods warp photographs (``rectifying``) and others do not, the best of the one kind
    is compared with the best of the other; else the best method with the worst.
    """
    warped = [method for method in methods if method.name in rectifying]
    plain = [method for method in methods if method.name not in rectifying]

    def chosen(pair: Pair) -> ChosenPair:
        def key(method: MethodResult) -> int:
            return method.pair_inliers.get(pair, 0)

        if warped and plain:
            return ChosenPair(pair, max(plain, key=key), max(warped, key=key))
        return ChosenPair(pair, min(methods, key=key), max(methods, key=key))

    pairs = sorted({pair for method in methods for pair in method.pair_inliers})
    uses: Counter[str] = Counter()
    found: list[ChosenPair] = []
    for item in sorted(map(chosen, pairs), key=lambda item: -item.difference):
        fits = all(uses[name] < MAX_PAIRS_OF_IMAGE for name in item.names)
        if fits and item.difference > 0 and len(found) < MAX_NUM_PAIRS:
            found.append(item)
            uses.update(item.names)
    return found


@dataclass(frozen=True)
class PairPlots:
    """Two photographs side by side, and what the methods before and after found, by name."""

    shown: SideBySide
    plots: Mapping[str, MatchPlot]


def plot_pairs(
    chosen: Sequence[ChosenPair], pictures: Mapping[str, Picture], output_path: Path
) -> list[PairPlots]:
    """Draw the inliers of pairs whose photographs are among the pictures."""
    drawable = [item for item in chosen if pictures.keys() >= set(item.names)]
    sides = {item.names: SideBySide.of(item.names, pictures) for item in drawable}
    names_of = {item.names: (item.before.name, item.after.name) for item in drawable}
    methods = {method.name: method for item in drawable for method in (item.before, item.after)}
    drawn: dict[str, dict[Pair, MatchPlot]] = {}
    for name, method in methods.items():
        workspace = Workspace(output_path / method.folder)
        drawn[name] = plot_inliers(
            [side for pair, side in sides.items() if name in names_of[pair]],
            method.pair_inliers,
            workspace.path / f"seed-{method.seeds[0].seed}" / "database.db",
            workspace.features,
        )
    return [
        PairPlots(side, {name: drawn[name][pair] for name in names_of[pair]})
        for pair, side in sides.items()
    ]
