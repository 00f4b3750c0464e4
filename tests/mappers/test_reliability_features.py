"""What the confidence in a photograph is computed from, on pairs that are made here."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.pair_graph import Ids, VerifiedPair
from colmap_affrect.mappers.reliability_features import _agreeing_share, _cut_pairs


def pair(ids: Ids, num_inliers: int) -> VerifiedPair:
    matches = np.zeros((num_inliers, 2), np.int64)
    return VerifiedPair(ids, matches, pycolmap.TwoViewGeometry())


@pytest.mark.parametrize(("of_4_5", "of_5_6"), [(100, 20), (20, 100)])
def test_of_several_cut_pairs_that_with_fewest_inliers_counts(
    of_4_5: int, of_5_6: int
) -> None:
    """Images 5 to 8 hang on 1 to 4 by one pair, and 6 to 8 on these by another one."""
    pairs = [pair((4, 5), of_4_5), pair((5, 6), of_5_6)]
    for ids in [(1, 2), (1, 3), (2, 3), (3, 4), (2, 4), (6, 7), (6, 8), (7, 8)]:
        pairs.append(pair(ids, 50))
    agreements = {one.ids: 0.9 for one in pairs}
    context: Any = SimpleNamespace(pairs=pairs, agreements=agreements)
    found = {image_id: one.ids for image_id, one in _cut_pairs(context).items()}
    weaker = (4, 5) if of_4_5 < of_5_6 else (5, 6)
    on_both_sides = dict.fromkeys([1, 2, 3, 4], (4, 5))  # parts of four are equal
    assert found == on_both_sides | {5: (4, 5)} | dict.fromkeys([6, 7, 8], weaker)


def test_pairs_that_disagree_with_the_model_tie_nothing() -> None:
    pairs = []
    for ids in [(1, 2), (1, 3), (2, 3), (3, 4), (2, 5), (4, 5)]:
        pairs.append(pair(ids, 50))
    agreements = {one.ids: 0.9 for one in pairs} | {(2, 5): 0.4}
    context: Any = SimpleNamespace(pairs=pairs, agreements=agreements)
    assert _cut_pairs(context).keys() == {4, 5}


def test_pairs_of_an_image_count_by_their_inliers_and_those_of_one_viewpoint_do_not() -> (
    None
):
    pairs = [pair((1, 2), 300), pair((1, 3), 100), pair((1, 4), 500)]
    context: Any = SimpleNamespace(
        pairs_of={1: pairs},
        agreements={(1, 2): 0.9, (1, 3): 0.1, (1, 4): 1.0},
        is_of_one_viewpoint=lambda one: one.ids == (1, 4),
    )
    assert _agreeing_share(context, 1) == pytest.approx(0.7)
    context.is_of_one_viewpoint = lambda _: True
    assert _agreeing_share(context, 1) == 1.0
