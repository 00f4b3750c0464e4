"""Pairs of photographs taken near to each other, or that follow each other by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.colmap.database import nearest_positions
from colmap_affrect.pairs.base import Pair, PairOptions
from colmap_affrect.pairs.lists import sequence_pairs


def pairs_by_place(names: Sequence[str], database_path: Path, options: PairOptions) -> set[Pair]:
    """Return pairs by ``gps`` (DatabaseError without positions) and ``sequence``, as asked for."""
    pairs: set[Pair] = set()
    if "sequence" in options.methods:
        pairs |= set(sequence_pairs(names, options.num_neighbors))
    if "gps" in options.methods:
        near = nearest_positions(database_path, options.num_neighbors, options.max_distance_m)
        known = set(names)
        pairs |= {pair for pair in near if known.issuperset(pair)}
    return pairs
