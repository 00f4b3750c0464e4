"""Escalation on demand: more warps for the pairs of images that need them, and only those.

Images get the features that a level of the recipe adds, and pairs are matched again with them
(Mishkin, Matas, Perdoch, MODS, 2015). New matches take the place of the old ones only when their
two-view geometry has more inliers, or, where neither is verified, when more of them confirm each
other. Which pairs are matched again, and at which level, is decided anew after every step
(:mod:`colmap_affrect.stages.expected_gain`), by what the database holds then; the step that has
begun is on record, so that a killed run goes on in the same way.

Images are in need that the model before has not, or is not sure of. While there is none, or pairs
have changed since, only those that have no strong pair, or few features in tracks through three
images: the next model tells of the others.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.colmap.verification import PairVerifier, connected_parts
from colmap_affrect.errors import ImageError, such_as
from colmap_affrect.geometry.arrays import Bools, Indices, Singles
from colmap_affrect.geometry.neighbors import num_consistent_matches
from colmap_affrect.mappers.mapping import model_folders, read_summary
from colmap_affrect.mappers.pair_graph import MIN_SHARE
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.project.stores import STEP, PairMatches
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.expected_gain import (
    ExpectedGain,
    PairState,
    insecure_images,
    weakly_connected_images,
)
from colmap_affrect.stages.extract import extract_images
from colmap_affrect.stages.guide import restore_exact
from colmap_affrect.stages.match import match_pairs, matched_at_level, write_batches, write_matches
from colmap_affrect.stages.one_image import ImageExtractor, prepare
from colmap_affrect.stages.pairs import listed_pairs
from colmap_affrect.stages.verify import num_verified_inliers, verified_inliers, verify_new

logger = logging.getLogger(__name__)

MIN_SHARE_KEPT = 0.9
"""Of the inliers of measured frames in one geometry with others. Right ones keep 95 per cent and
more; wrong matches of a similar side bend the geometry, which then loses a quarter of them."""

MIN_NUM_TELLING = 30
"""So many inliers of measured frames decide alone which other matches are right. Wrong ones of a
similar side may keep nine tenths of 76, and turn their geometry from 2.5 to 30 degrees off."""

OUTNUMBERED = 4
"""So many inliers of other frames to one of measured frames decide, where they agree with half of
these: of what changes, such as a sitter, few gradients match, and their geometry is off."""

LIKELY = 0.25
"""Part of what more matches add to the probability of an image that is likely right: they tell more
often that it is right than that they put it right."""


def escalate(
    context: Context, options: EscalateOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Go through the levels of the recipe; nothing happens when it has none.

    ``options`` are by default those on record; ``overwrite`` brings all pairs back to level 0
    first, features that are there are kept. ``num_done`` counts the pairs that were matched again
    now.
    """
    start = time.perf_counter()
    context.resources.require_device()
    context.workspace.require("verify")
    options = options or context.escalation
    if overwrite:
        restore_exact(context)
    context.workspace.record_options("escalate", options.to_mapping(), overwrite=overwrite)
    escalation = Escalation(context, options)
    if overwrite:
        escalation.undo()
    escalation.write()  # it may have been killed before
    escalated: set[Pair] = set()
    while work := escalation.next_work():
        if time.monotonic() > context.deadline_s:
            break
        level, todo = work
        escalation.match_at(todo, level)
        escalated |= set(todo)
    warnings = escalation.waiting()
    if work:
        warnings["time"] = "it is over; the same command without --max-minutes tries more"
        logger.warning("time: %s", warnings["time"])
    wall_s = time.perf_counter() - start
    return StageReport("escalate", wall_s, len(escalated), warnings=warnings)


def measured_inliers(context: Context) -> dict[Pair, Indices]:
    """Return the (M, 2) inliers that verified pairs have as measured frames have it, if others.

    M is 0 where measured ones are too few for a verified pair.
    """
    escalation = Escalation(context, EscalateOptions())
    if not escalation.has_both_kinds:
        return {}
    found, inliers = {}, verified_inliers(context)
    for pair, indices in inliers.items():
        measured = indices[escalation.measured(pair, indices)]
        num_others = len(indices) - len(measured)
        if len(measured) < escalation.verification.min_num_inliers:
            found[pair] = measured[:0]
        elif 0 < num_others < OUTNUMBERED * len(measured):
            found[pair] = measured
    kept = [pair for pair in inliers if pair not in found or len(found[pair])]
    num_tied, num_kept = (
        max(map(len, connected_parts(pairs)), default=0) for pairs in (inliers, kept)
    )
    return found if num_kept >= MIN_SHARE * num_tied else {}


class Escalation:
    """Lets pairs of a workspace escalate to a level, with the options on record."""

    def __init__(self, context: Context, options: EscalateOptions) -> None:
        self.context, self.options = context, options
        self.extraction = context.extraction
        self.matching = context.matching
        self.verification = context.verification
        self.pairs = listed_pairs(context)
        self.features, self.matches = context.features, context.matches
        self.path = context.workspace.database
        self.levels = context.resources.usable_levels(self.extraction)[1:]
        self._is_measured = [level.features.has_shapes for level in self.extraction.levels]
        self._consistent: dict[Pair, tuple[bytes, int]] = {}

    @property
    def has_both_kinds(self) -> bool:
        """Whether frames of some levels are measured and those of others are not."""
        return len(set(self._is_measured)) > 1

    @cached_property
    def extractor(self) -> ImageExtractor:
        """The recipe, prepared for all images when it is needed first."""
        names, context = self.features.names(), self.context
        return prepare(self.extraction, context.resources, names, context.progress)

    def num_inliers(self) -> dict[Pair, int]:
        """Return the inliers of each pair that is in the database, 0 where it is not verified."""
        ids = colmap_database.image_ids(self.path)
        verified = num_verified_inliers(self.context)
        return {
            (first, second): verified.get((first, second)) or verified.get((second, first), 0)
            for first, second in self.pairs
            if first in ids and second in ids
        }

    def needs(self) -> dict[str, float]:
        """Return what more matches may be worth to images: 1 to those that a model has not.

        To doubtful ones what they may add to the probability that these are right, and a quarter
        of that to others, which are likely right as they are.
        """
        workspace, names = self.context.workspace, self.features.names()
        folders = model_folders(workspace.sparse)
        model = read_summary(folders[0]) if folders else ModelSummary((), 0, 0.0, 0.0)
        is_current = workspace.made_from("map") == rows_digest(self.path)
        lost = set(names) - set(model.sure)
        if not is_current:  # what has been tied since waits for the next model
            lost &= self._insecure()
        likely = set(model.registered_names) - model.doubtful.keys()
        worth = {name: LIKELY if name in likely else 1.0 for name in sorted(lost)}
        return {name: share * model.gains.get(name, 1.0) for name, share in worth.items()}

    def _insecure(self) -> set[str]:
        """Return the images that mapping may well lose, by the pairs as they are."""
        limit = self.options.strong_num_inliers
        return insecure_images(self.num_inliers(), limit, self._loose())

    def _loose(self) -> set[str]:
        """Return the images with few features in tracks through three, where there are three."""
        if len(self.features.names()) < 3:
            return set()
        return weakly_connected_images(verified_inliers(self.context), self.options.min_num_tracks)

    def states(self) -> dict[Pair, PairState]:
        """Return what is known of the pairs that are in the database."""
        num_inliers = self.num_inliers()
        failed = [pair for pair, count in num_inliers.items() if not count]
        num_consistent, levels = self._num_consistent(failed), self.matches.levels
        reached, tried = levels(num_inliers), levels(num_inliers, "tried")
        return {
            pair: PairState(count, num_consistent.get(pair, 0), reached[pair], tried[pair])
            for pair, count in num_inliers.items()
        }

    def _num_consistent(self, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """Return how many raw matches of pairs confirm each other."""
        ids = colmap_database.image_ids(self.path)
        with colmap_database.open_database(self.path) as database:
            matches = {(a, b): database.read_matches(ids[a], ids[b]) for a, b in pairs}
        known = self._consistent
        for pair, indices in matches.items():
            key = indices.tobytes()
            if pair not in known or known[pair][0] != key:
                known[pair] = key, num_consistent_matches(*self._frames(pair, indices))
        return {pair: known[pair][1] for pair in pairs}

    def _frames(self, pair: Pair, indices: NDArray[np.integer]) -> tuple[Singles, Singles]:
        first, second = self._all_frames(pair)
        return first[indices[:, 0]], second[indices[:, 1]]

    def next_work(self) -> tuple[int, list[Pair]] | None:
        """Return a level, and the pairs to match at it now; None when nothing is left to do.

        There are no pairs where a killed run has matched all of a step, and only the database lacks
        them.
        """
        if step := self.matches.note(STEP):
            level, pairs = step
            tried = self.matches.levels(self.pairs, "tried")
            return level, [p for p in map(tuple, pairs) if not tried.get(p, -1) >> level & 1]
        needs, sizes = self.needs(), self.features.image_sizes()
        if not needs:
            return None
        states, loose, best = self.states(), self._loose(), (0.0, 0, list[Pair]())
        ranges = {name: self.features.level_ranges(name) for name in sizes}
        for number in self.levels:
            level = self.extraction.levels[number]
            is_blind = self.has_both_kinds and not self._is_measured[number]
            gain = ExpectedGain(
                states,
                loose,
                # They take like for same: only for images that nothing else holds.
                {name: need for name, need in needs.items() if need > 0.5 or not is_blind},
                {name: _megapixels(size, level.max_image_size_px) for name, size in sizes.items()},
                [k for k, is_measured in enumerate(self._is_measured) if not is_measured],
                {name for name in sizes if number not in ranges[name]},
            )
            rate, pairs = gain.best_pairs(number, level, self._at_least(number), self.options)
            best = max(best, (rate, number, pairs), key=lambda found: found[0])
        return best[1:] if best[0] else None

    def _at_least(self, level: int) -> int:
        """Return the bits of the levels from one on that have frames of its kind."""
        kinds = self._is_measured
        return sum(1 << k for k in range(level, len(kinds)) if kinds[k] == kinds[level])

    def match_at(self, pairs: Sequence[Pair], level: int) -> None:
        """Match pairs with the features of a level and keep what has more inliers.

        What is to be done is on record meanwhile: a killed run could not tell it else.
        """
        if pairs:
            self.matches.keep_note(STEP, [level, list(pairs)])
        images = sorted({name for pair in pairs for name in pair})
        needed = sorted({self.extraction.levels[level].base, level})
        missing = [(name, k) for name in images for k in self._lacking(name, needed)]
        title, total = f"escalate, {self.extraction.levels[level].name}", len(missing) + len(pairs)
        with self.context.progress.stage(title, total, "steps") as advance:
            self._extend(missing, advance)
            if pairs:
                self._match_again(pairs, level, advance)
        self.write()
        self.matches.keep_note(STEP, None)

    def waiting(self) -> dict[str, str]:
        """Say what levels that lack weights may tie, if anything is left to tie."""
        how = self.context.resources.how_to_complete(self.extraction)
        left = sorted(self.needs()) if how else []
        if not left:
            return {}
        text = f"its weights are not here; it may tie {such_as(left)}: {how}; then run this again"
        logger.warning("learned matching: %s", text)
        return {"learned matching": text}

    def write(self) -> None:
        """Bring the database up to what is stored."""
        write_matches(self.context, self.pairs, replaces=True)
        verify_new(self.context)

    def undo(self) -> None:
        """Bring all pairs back to level 0."""
        levels = self.matches.levels(self.pairs)
        higher = [pair for pair in self.pairs if levels[pair]]
        with self.context.progress.stage("match", len(higher), "pairs") as advance:
            match_pairs(self.context, higher, self.matching, advance)
        self.matches.forget_tried()
        self.matches.keep_note(STEP, None)

    def _lacking(self, name: str, levels: Sequence[int]) -> list[int]:
        there = self.features.level_ranges(name)
        return [level for level in levels if level not in there]

    def _extend(self, missing: Sequence[tuple[str, int]], advance: Callable[[int], None]) -> None:
        """Add to images the features of levels that they lack."""
        if not missing:
            return
        inputs = self.context.inputs
        images = extract_images(self.context, inputs, self.extractor, missing)
        with closing(images) as found_images:
            for (name, level), found in zip(missing, found_images, strict=True):
                if isinstance(found, ImageError):
                    raise found
                self.features.extend(name, found.features, level)
                advance(1)

    def measured(self, pair: Pair, indices: NDArray[np.integer]) -> Bools:
        """Return which of the (M, 2) matches of a pair are of frames that were measured singly."""
        found = np.ones(len(indices), bool)
        for name, rows in zip(pair, indices.T, strict=True):
            ranges = self.features.level_ranges(name)
            part = np.searchsorted([k.stop for k in ranges.values()], rows, side="right")
            found &= np.array(self._is_measured)[list(ranges)][part]
        return found

    def _match_again(
        self, pairs: Sequence[Pair], level: int, advance: Callable[[int], None]
    ) -> None:
        size_px = self.extraction.levels[level].max_image_size_px
        verifier, states = PairVerifier(self.path, self.verification, size_px), self.states()
        others = self._inliers_of_other_kind(pairs, level)

        def judged(found: PairMatches) -> tuple[Pair, PairMatches | None]:
            chosen, worth = self._judged(found, others.get(found.names), verifier)
            return found.names, chosen if worth > states[found.names].worth else None

        def write(batch: Sequence[tuple[Pair, PairMatches | None]]) -> None:
            better = [chosen for _, chosen in batch if chosen]
            tried = [names for names, _ in batch]
            self.matches.write(better, tried, level)  # both or neither, if it is killed here

        with closing(matched_at_level(self.context, pairs, self.matching, level)) as found_pairs:
            write_batches(map(judged, found_pairs), write, advance)

    def _judged(
        self, found: PairMatches, others: Indices | None, verifier: PairVerifier
    ) -> tuple[PairMatches, tuple[float, int]]:
        """Return what a pair may have at a level, and what that is worth beside what it has.

        That is its inliers, or without any how many matches confirm each other. Inliers that the
        pair has of the other kind of frames are added where both agree, but for those that many
        measured ones contradict; else those decide that were measured one by one: they tell right
        matches from wrong, while of others there may be more where two sides look the same. Only
        where these are many times more, and agree with half of the measured ones, they decide.
        """
        inliers = self._inliers(found, verifier)
        if not len(inliers):
            return found, (0, num_consistent_matches(*self._frames(found.names, found.indices)))
        if others is None:
            return found, (len(inliers), 0)
        indices = np.concatenate([found.indices, others])
        scores = np.concatenate([found.scores, np.ones(len(others), np.float32)])
        order = np.argsort(indices[:, 0])
        united = replace(found, indices=indices[order], scores=scores[order])
        explained = self._inliers(united, verifier)
        is_measured = bool(self.measured(found.names, inliers).all())
        measured, unmeasured = (inliers, others) if is_measured else (others, inliers)
        num_kept = self.measured(found.names, explained).sum()
        do_agree = num_kept >= MIN_SHARE_KEPT * len(measured)
        is_outnumbered = len(unmeasured) >= OUTNUMBERED * len(measured)
        if not do_agree and not (is_outnumbered and num_kept >= MIN_SHARE * len(measured)):
            return found, (math.inf if is_measured else 0, 0)
        if do_agree and len(measured) >= MIN_NUM_TELLING:
            united = self._agreeing(united, measured, verifier)
            explained = self._inliers(united, verifier)
            if is_measured:  # others that it contradicts may have been more
                return united, (math.inf, 0)
        return united, (len(explained), 0)

    def _agreeing(
        self, united: PairMatches, measured: Indices, verifier: PairVerifier
    ) -> PairMatches:
        """Return matches without those of other frames that measured ones, (M, 2), contradict."""
        names, frames = united.names, self._all_frames(united.names)
        kept = self.measured(names, united.indices)
        kept |= verifier.are_explained(names, frames, united.indices, measured)
        return replace(united, indices=united.indices[kept], scores=united.scores[kept])

    def _inliers(self, found: PairMatches, verifier: PairVerifier) -> Indices:
        return verifier.inliers(found.names, self._all_frames(found.names), found.indices)

    def _all_frames(self, pair: Pair) -> tuple[Singles, Singles]:
        first, second = (self.features.read_frames(name) for name in pair)
        return first, second

    def _inliers_of_other_kind(self, pairs: Sequence[Pair], level: int) -> dict[Pair, Indices]:
        """Return the (M, 2) inliers, of frames measured or not, that a level does not look for."""
        is_measured, todo = self._is_measured[level], set(pairs)
        found = {}
        for (one, two), inliers in verified_inliers(self.context).items():
            pair, indices = (
                ((one, two), inliers) if (one, two) in todo else ((two, one), inliers[:, ::-1])
            )
            if pair in todo:
                others = indices[self.measured(pair, indices) != is_measured]
                if len(others):
                    found[pair] = others
        return found


def _megapixels(size: tuple[int, int], limit_px: int) -> float:
    return math.prod(size) * min(1.0, limit_px / max(size)) ** 2 / 1e6
