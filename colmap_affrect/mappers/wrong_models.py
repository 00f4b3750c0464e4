"""Models of which nothing is left: why, what they stood on, and what is mapped instead.

Where all photographs of a model are surely wrong, the pairs that agree with it are false, or say
too little. Two hypotheses are left for its photographs. The other pairs among them may be right:
they are mapped without those that the model stood on. Or other matches of the same pairs may be:
escalation takes these, also where they are fewer. The evidence decides: photographs of all models
are scored by all pairs, also by those that were left out.
"""

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import TypeAdapter

from colmap_affrect.errors import DAMAGE
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    CameraById,
    Ids,
    PairGraph,
    PoseById,
)
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.regular_files import read_regular

THROWN_AWAY = "thrown_away.json"  # beside the models that are kept
WITHOUT_FALSE_PAIRS = (
    "without the pairs of a model that was wrong"  # in the words of a report
)
NUM_OTHER_HYPOTHESES = 2
"""Times that photographs of wrong models are mapped without what these stood on; resource."""


@dataclass(frozen=True)
class StoodOn:
    """A pair that agreed with a model that was surely wrong."""

    first: str
    second: str
    num_inliers: int  # of the matches that agreed


@dataclass(frozen=True)
class ThrownAway:
    """What is known of photographs that are in no model, since theirs was surely wrong."""

    doubts: Mapping[str, tuple[Doubt, ...]] = field(default_factory=dict)
    """Why they were surely wrong, by image name."""
    stood_on: tuple[StoodOn, ...] = ()
    """Pairs that agreed with their models."""

    def num_inliers(self) -> dict[tuple[str, str], int]:
        """Return the inliers of the pairs that models stood on, by both orders of the names."""
        found = dict[tuple[str, str], int]()
        for one in self.stood_on:
            found[one.first, one.second] = one.num_inliers
            found[one.second, one.first] = one.num_inliers
        return found


_FILE = TypeAdapter(ThrownAway)


def write_thrown_away(thrown_away: ThrownAway, sparse_path: Path) -> None:
    """Keep what is known of models that were thrown away beside those that are kept."""
    if thrown_away.doubts:
        content = _FILE.dump_json(thrown_away, indent=2).decode()
        replace_text(sparse_path / THROWN_AWAY, content)


def read_thrown_away(sparse_path: Path) -> ThrownAway:
    """Return what is known of models that were thrown away; nothing where there are none."""
    path = sparse_path / THROWN_AWAY
    if not path.exists():
        return ThrownAway()
    try:
        return _FILE.validate_json(read_regular(path))
    except DAMAGE:  # it only says more; mapping again makes it again
        return ThrownAway()


def copy_thrown_away(sparse_path: Path, target: Path) -> None:
    """Copy what is known of models that were thrown away to a folder of other models."""
    path = sparse_path / THROWN_AWAY
    if path.exists():
        shutil.copy(path, target / THROWN_AWAY)


def pairs_stood_on(graph: PairGraph, poses: PoseById, cameras: CameraById) -> set[Ids]:
    """Return the pairs that a model stands on: most of their inliers agree with its poses.

    A model that none of its pairs agrees with stands on all of them.

    Args:
        graph: All pairs.
        poses: cam_from_world of the images of the model, by image id.
        cameras: Of these images, by image id.
    """
    inside = [pair for pair in graph.verified if poses.keys() >= {*pair.ids}]
    found = set[Ids]()
    for pair in inside:
        if graph.agreement(pair, poses, cameras) >= MIN_SHARE:
            found.add(pair.ids)
    return found or {pair.ids for pair in inside}


def pairs_to_leave_out(
    graph: PairGraph, image_ids: Collection[int], stood_on: Collection[Ids]
) -> frozenset[Ids]:
    """Return the pairs that are left out when photographs of wrong models are mapped once more.

    Args:
        graph: All pairs.
        image_ids: Images that no model has, also those of the wrong ones.
        stood_on: Pairs that these models stood on.

    Returns:
        All pairs but those among these images that no wrong model stood on; none where nothing is
        left to map.
    """
    inside = set(image_ids)
    left_out = set[Ids]()
    left = list[Ids]()
    for pair in graph.verified:
        is_inside = inside.issuperset(pair.ids)
        if is_inside and pair.ids not in stood_on:
            left.append(pair.ids)
        else:
            left_out.add(pair.ids)
    return frozenset(left_out) if left else frozenset()


def thrown_away_of(
    graph: PairGraph,
    doubts: Mapping[str, tuple[Doubt, ...]],
    stood_on: Collection[Ids],
) -> ThrownAway:
    """Return what is known of photographs that no model has, since theirs were thrown away.

    Args:
        graph: All pairs.
        doubts: Why these photographs were surely wrong, by name.
        stood_on: Pairs that models which were thrown away stood on.

    Returns:
        The same, with the pairs of these photographs alone.
    """
    pairs = list[StoodOn]()
    for pair in graph.verified:
        first, second = (graph.names[image_id] for image_id in pair.ids)
        is_of_them = first in doubts or second in doubts
        if pair.ids in stood_on and is_of_them:
            pairs.append(StoodOn(first, second, len(pair.matches)))
    return ThrownAway(dict(doubts), tuple(pairs))
