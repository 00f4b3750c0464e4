"""Matches of a run in HDF5, in hloc's layout (docs/formats.md).

Matches have the attributes ``level``, whose features were matched together with those of level 0,
and ``tried``, with a bit for each level that was tried. Beside them a pair may have learned matches
that are not in use (:class:`Learned`), and pairs that use learned ones have the attribute
``measured_worth``: what the best of measured frames are worth. The file is opened for one batch of
pairs and closed again; what is written in between appears as a whole
(:mod:`colmap_affrect.project.atomic_files`).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import StoreError
from colmap_affrect.geometry.arrays import Bools, Indices, Singles
from colmap_affrect.project.group_store import (
    GroupStore,
    entries_of,
    has_entry,
    read_checked,
)
from colmap_affrect.project.match_state import STATE_JSON, MatchState, Names, Worth

MAX_INT16 = 32767  # format
PAIRS_PER_WRITE = 64  # a run that is ended loses at most as many; resource
STATE = "state"  # attribute of the file of matches


@dataclass(frozen=True)
class PairMatches:
    """Raw matches of one pair."""

    names: Names  # the two image names, in the order of the columns
    indices: Indices  # (M, 2) int64, strictly rising in column 0
    scores: Singles  # (M,) float32 in [0, 1], larger is better
    num_keypoints1: int  # number of features of the first image
    # Of escalation, whose features were looked at together with those of level 0
    level: int = 0
    of_some: bool = False  # only of the features with the largest responses


@dataclass(frozen=True)
class Learned:
    """Matches of a pair by learned features, kept beside those in use, and what they are worth."""

    matches: PairMatches
    worth: Worth


def pair_key(name1: str, name2: str) -> str:
    """Return hloc's group name of a pair: '/' becomes '-', the two joined by '/'."""
    return f"{name1.replace('/', '-')}/{name2.replace('/', '-')}"


LEARNED = "learned_"  # begins the names of datasets and attributes of such matches
KEPT = ("tried", "measured_worth")  # attributes that stay when a pair has other matches


def hloc_matches(pair: PairMatches) -> dict[str, NDArray[Any]]:
    """Return the datasets that hloc has for a pair; in 32 bits where 16 do not suffice."""
    matches0 = np.full(pair.num_keypoints1, -1, np.int64)
    scores0 = np.zeros(pair.num_keypoints1, np.float16)
    matches0[pair.indices[:, 0]] = pair.indices[:, 1]
    scores0[pair.indices[:, 0]] = pair.scores
    dtype = np.int32 if matches0.max(initial=0) > MAX_INT16 else np.int16
    return {"matches0": matches0.astype(dtype), "matching_scores0": scores0}


class MatchStore(GroupStore):
    """Raw matches by pair of image names."""

    format = "colmap_affrect/matches"
    stage = "match"

    def __init__(self, path: Path, num_levels: int | None = None) -> None:
        """Take the file, and how many levels the recipe has, beyond which none can be."""
        super().__init__(path)
        self.num_levels = num_levels

    @property
    def state(self) -> MatchState:
        """How far matching and escalation of the whole set have come."""
        if not self.path.exists():
            return MatchState()
        with self._open("r") as file:
            state = _read_state(file)
            for begun in (state.step, state.learned_matching):
                self._require_level(begun.level if begun else 0)
        return state

    def update_state(self, **changes: Any) -> None:
        """Change fields of the state."""
        with self._open("a") as file:
            _change_state(file, changes)

    def write(
        self,
        pairs: Iterable[PairMatches],
        tried: Iterable[Names] = (),
        tried_level: int = 0,
        measured_worths: Mapping[Names, Worth] | None = None,
    ) -> None:
        """Write a batch of pairs.

        Args:
            pairs: matches that take the place of what is there.
            tried: pairs for which a level was tried, with success or without.
            tried_level: that level.
            measured_worths: what the best measured matches are worth, by pair.
        """
        with self._open("a") as file:
            for pair in pairs:
                self._write_pair(file, pair)
            for names in tried:
                file[pair_key(*names)].attrs["tried"] |= 1 << tried_level
            for names, worth in (measured_worths or {}).items():
                file[pair_key(*names)].attrs["measured_worth"] = worth

    def _write_pair(self, file: h5py.File, pair: PairMatches) -> None:
        """Write matches; what is known of the pair besides stays."""
        key = pair_key(*pair.names)
        known: dict[str, Any] = {"tried": 0}
        learned = None
        if has_entry(file, key):
            attributes = file[key].attrs
            known = {name: attributes[name] for name in KEPT if name in attributes}
            learned = _read_learned(file[key], pair.names)
        known["tried"] |= 1 << pair.level
        known |= {"level": pair.level, "of_some": pair.of_some}
        self._write(file, key, hloc_matches(pair), **known)
        if learned:
            self._write_learned(file, learned)

    def _write_learned(self, file: h5py.File, learned: Learned) -> None:
        group = file[pair_key(*learned.matches.names)]
        for name, values in hloc_matches(learned.matches).items():
            self._write_dataset(group, name=LEARNED + name, values=values)
        group.attrs[LEARNED + "level"] = learned.matches.level
        group.attrs[LEARNED + "worth"] = learned.worth

    def write_learned(self, found: Iterable[Learned]) -> None:
        """Write learned matches beside those in use."""
        with self._open("a") as file:
            for learned in found:
                self._write_learned(file, learned)

    def learned(self, pairs: Sequence[Names]) -> dict[Names, Learned]:
        """Return the learned matches that are kept beside those in use, where there are any."""
        found = dict[Names, Learned]()
        with self._open("r") as file:
            for names in pairs:
                learned = _read_learned(file[pair_key(*names)], names)
                if learned:
                    found[names] = learned
        return found

    def learned_levels(self, pairs: Iterable[Names]) -> dict[Names, int]:
        """Return the level of these by pair, without reading them; -1 where there are none."""
        levels = dict[Names, int]()
        with self._open("r") as file:
            for names in pairs:
                attributes = file[pair_key(*names)].attrs
                levels[names] = int(attributes.get(LEARNED + "level", -1))
            highest = max(levels.values(), default=0)
            self._require_level(max(highest, 0))  # -1 is none
        return levels

    def measured_worths(self, pairs: Iterable[Names]) -> dict[Names, Worth]:
        """Return what the best measured matches of pairs are worth that use others."""
        worths = dict[Names, Worth]()
        with self._open("r") as file:
            for names in pairs:
                attributes = file[pair_key(*names)].attrs
                inliers, consistent = attributes.get("measured_worth", (0, 0))
                worths[names] = (int(inliers), int(consistent))
        return worths

    def choose(
        self,
        chosen: Iterable[PairMatches],
        measured_worths: Mapping[Names, Worth],
        **changes: Any,
    ) -> None:
        """Let other matches take the place of those of their pairs, all or none.

        Args:
            chosen: matches that are used from now on.
            measured_worths: what the measured matches were worth that were used, by pair.
            changes: of the state.
        """
        with self._open("a") as file:
            _change_state(file, changes)
            for pair in chosen:
                self._write_pair(file, pair)
            for names, worth in measured_worths.items():
                file[pair_key(*names)].attrs["measured_worth"] = worth

    def remove(self, images: Iterable[str] = (), pairs: Iterable[Names] = ()) -> None:
        """Remove the matches of pairs, of all pairs of some images, and of all escalated ones.

        Which pairs are escalated depends on all others.

        Args:
            images: names of images.
            pairs: of image names.
        """
        if not self.path.exists():
            return
        gone = set(images)
        image_keys = {pair_key(name, "")[:-1] for name in gone}
        pair_keys = {pair_key(*pair) for pair in pairs}
        with self._open("a") as file:
            _write_state(file, _read_state(file).without_pairs(gone))
            for key, group in list(entries_of(file)):
                is_of_image = not image_keys.isdisjoint(key.split("/"))
                has_learned = LEARNED + "level" in group.attrs
                is_escalated = has_learned or group.attrs["tried"] > 1
                if key in pair_keys or is_of_image or is_escalated:
                    del file[key]

    def has(self, pairs: Sequence[Names]) -> Bools:
        """Return, as (N,) bools, which of N pairs are there."""
        if not self.path.exists():
            return np.zeros(len(pairs), np.bool_)
        with self._open("r") as file:
            there = (has_entry(file, pair_key(*pair)) for pair in pairs)
            return np.fromiter(there, np.bool_, len(pairs))

    def nums_of_some(self, pairs: Iterable[Names]) -> dict[Names, int]:
        """Return the number of matches of the pairs for which some features were matched."""
        found = dict[Names, int]()
        with self._open("r") as file:
            for pair in pairs:
                group = file[pair_key(*pair)]
                if group.attrs["of_some"]:
                    found[pair] = int(
                        np.count_nonzero(read_checked(group, "matches0") >= 0)
                    )
        return found

    def num_pairs(self) -> int:
        """Return the number of pairs that are there, without a look at each."""
        with self._open("r") as file:
            return sum(len(group) for group in file.values())

    def levels(
        self, pairs: Iterable[Names], attribute: str = "level"
    ) -> dict[Names, int]:
        """Return the level that the matches of each pair are from, or its ``tried`` ones.

        Args:
            pairs: of image names.
            attribute: ``level``, or ``tried``.

        Returns:
            By pair a level, or a number with a bit for each level that was tried.
        """
        found = dict[Names, int]()
        with self._open("r") as file:
            for pair in pairs:
                found[pair] = int(file[pair_key(*pair)].attrs[attribute])
            highest = max(found.values(), default=0)
            if attribute == "tried":
                highest = max(highest.bit_length() - 1, 0)
            self._require_level(highest)
            lowest = min(found.values(), default=0)
            self._require_level(min(lowest, 0))
        return found

    def _require_level(self, level: int) -> None:
        """Refuse a level that the recipe has not; ValueError."""
        if level < 0 or (self.num_levels is not None and level >= self.num_levels):
            raise ValueError(f"matches are of level {level}, which the recipe has not")

    def levels_of_stored(self, pairs: Iterable[Names]) -> dict[Names, int]:
        """Return the level that the matches of each pair are from, of those that are stored."""
        levels = dict[Names, int]()
        with self._open("r") as file:
            for pair in pairs:
                key = pair_key(*pair)
                if has_entry(file, key):
                    levels[pair] = int(file[key].attrs["level"])
        return levels

    def read(self, pairs: Sequence[Names]) -> Iterator[PairMatches]:
        """Yield the matches of each pair; StoreError at a pair without matches."""
        with self._open("r") as file:
            for name1, name2 in pairs:
                key = pair_key(name1, name2)
                if not has_entry(file, key):
                    raise StoreError(
                        f"no matches of {name1}, {name2}",
                        where=self.path,
                        advice="run match",
                    )
                yield _read_matches(file[key], (name1, name2))


def _read_state(file: h5py.File) -> MatchState:
    return STATE_JSON.validate_json(file.attrs.get(STATE, "{}"))


def _change_state(file: h5py.File, changes: Mapping[str, Any]) -> None:
    _write_state(file, replace(_read_state(file), **changes))


def _write_state(file: h5py.File, state: MatchState) -> None:
    file.attrs[STATE] = STATE_JSON.dump_json(state).decode()


def _read_matches(group: h5py.Group, names: Names, prefix: str = "") -> PairMatches:
    """Read the matches of a pair, or those whose datasets begin with a prefix."""
    matches0 = read_checked(group, f"{prefix}matches0").astype(np.int64)
    rows = np.flatnonzero(matches0 >= 0)
    scores = read_checked(group, f"{prefix}matching_scores0")
    return PairMatches(
        names=names,
        indices=np.stack([rows, matches0[rows]], axis=1),
        scores=scores[rows].astype(np.float32),
        num_keypoints1=len(matches0),
        level=int(group.attrs[f"{prefix}level"]),
    )


def _read_learned(group: h5py.Group, names: Names) -> Learned | None:
    if LEARNED + "level" not in group.attrs:
        return None
    num_inliers, num_consistent = group.attrs[LEARNED + "worth"].tolist()
    return Learned(
        _read_matches(group, names, prefix=LEARNED), (num_inliers, num_consistent)
    )
