"""What a pair is, and the options of how pairs are chosen."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from colmap_affrect.options import Options, within

Pair = tuple[str, str]
"""Names of two photographs, in order."""


class PairOptions(Options):
    """Which images are matched: the pairs of several methods together."""

    methods: Annotated[
        tuple[Literal["exhaustive", "retrieval", "low-resolution", "gps", "sequence"], ...],
        Field(strict=False, min_length=1),
    ] = ("exhaustive",)
    """``exhaustive``: all pairs. ``retrieval``: images whose descriptors are alike as a whole.
    ``low-resolution``: images of which the strongest features match. ``gps``: images taken near to
    each other. ``sequence``: images that follow each other by name."""
    num_neighbors: Annotated[int, within(1, 1_000_000)] = 20
    """Of each image: on average, by retrieval and low-resolution, and half as many at least; at
    most, by gps; before and after it, in a sequence."""
    max_distance_m: Annotated[float, within(0.0, 1e9)] = 100.0
    """Between positions of ``gps``; in their own unit where they are not longitude and latitude."""
    match_list_path: str = ""
    """List of pairs, two names per line; takes the place of ``exhaustive``."""
