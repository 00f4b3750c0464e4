"""Escalation on demand: more warps for the pairs of images that need them, and only those.

Images get the features that a level of the recipe adds, and pairs are matched again with them
(Mishkin, Matas, Perdoch, MODS, 2015). New matches take the place of the old ones only when their
two-view geometry has more inliers, or, where neither is verified, when more of them confirm each
other. Which pairs are matched again, and at which level, is decided anew after every step
(:mod:`colmap_affrect.escalation.policy`), by what the database holds then; the step that has
begun is on record, so that a killed run goes on in the same way.

Images are in need that the model before has not, or is not sure of. While there is none, those that
have no strong pair, or few features in tracks through three; a small set is mapped when one has.
"""

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property

from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import PairVerifier, weakly_connected_images
from colmap_affrect.errors import ImageError, such_as
from colmap_affrect.escalation import expected_gain
from colmap_affrect.escalation.expected_gain import PairState, Step
from colmap_affrect.escalation.policy import (
    Plan,
    Situation,
    learned_step,
    next_step,
    tried,
    untried,
)
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.mappers.sparse import LARGE
from colmap_affrect.options import EffortName
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.report import MatchedAgain, ModelSummary, StageReport
from colmap_affrect.project.stores import EFFORT, LEARNING, STEP, Learned, PairMatches, Worth
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.session.context import Context
from colmap_affrect.stages.extract import extract_images
from colmap_affrect.stages.match import (
    matched_at_level,
    num_confirming,
    write_batches,
)
from colmap_affrect.stages.one_image import ImageExtractor, prepare
from colmap_affrect.stages.verify import update_verified

logger = logging.getLogger(__name__)

PAIRS_AT_ONCE = 50  # matched between two looks at the clock
LIKELY = 0.25  # part of a gain that counts for images that are likely right: matches mend few


def escalate(context: Context, options: EscalateOptions | None = None) -> StageReport:
    """Go through the levels of the recipe, if any, without mapping in between.

    Args:
        context: folder, resources and options on record.
        options: which pairs are strong; by default those on record.

    Returns:
        What was done; ``num_done`` counts the pairs that were matched again now.
    """
    escalation, report = begin(context, options)
    while step := escalation.next_step():
        report = escalation.taken(step, report)
    return escalation.ended(report)


def begin(
    context: Context, options: EscalateOptions | None = None
) -> tuple["Escalation", StageReport]:
    """Bring the database up to what is stored, and return what lets pairs escalate."""
    start = time.perf_counter()
    context.resources.require_device()
    context.workspace.require("verify")
    options = options or context.escalation
    context.workspace.record_options("escalate", options.to_mapping())
    if context.matches.note(EFFORT) != context.effort:
        context.matches.keep_note(EFFORT, context.effort)
    escalation = Escalation(context, options)
    if escalation.has_stepped or escalation.matches.note(LEARNING):
        escalation.write()  # a run was killed before
    return escalation, StageReport("escalate", time.perf_counter() - start, 0)


@dataclass(frozen=True)
class Tried:
    """What escalation did for a set, and what is left."""

    effort: EffortName = "normal"  # how much was tried
    tried: tuple[MatchedAgain, ...] = ()  # pairs by level
    untried: tuple[MatchedAgain, ...] = ()  # what a greater effort would try


def matched_again(context: Context) -> Tried:
    """Return what escalation did in a workspace, and what is left for images in need."""
    workspace = context.workspace
    if workspace.is_foreign or "escalate" not in workspace.begun:
        return Tried()
    escalation = Escalation(context, context.escalation)
    models = escalation.models()
    needs = escalation.needs(models)
    has_tried = escalation.has_stepped or escalation.matches.note(LEARNING)
    if not (needs or has_tried):  # large sets take long to go through
        return Tried()
    situation = escalation.situation(needs, models)
    effort = escalation.matches.note(EFFORT) or context.effort
    return Tried(effort, tuple(tried(situation)), tuple(untried(situation)))


@dataclass(frozen=True)
class Trial:
    """Matches that were found for a pair at a level, beside what was there."""

    found: PairMatches
    worth: Worth
    before: PairState

    @property
    def is_better(self) -> bool:
        """Whether it takes the place of what is there."""
        return self.worth > self.before.worth


class Escalation:
    """Lets pairs of a workspace escalate to a level, with the options on record."""

    def __init__(self, context: Context, options: EscalateOptions) -> None:
        self.context, self.options = context, options
        self.extraction, self.matching = context.extraction, context.matching
        self.verification = context.verification
        self.pairs = context.listed_pairs()
        self.features, self.matches = context.features, context.matches
        self.path = context.workspace.database
        self.is_measured = [level.features.has_shapes for level in self.extraction.levels]
        self.left_s = 0.0  # nominal, if nothing helps any more
        self._consistent: dict[Pair, tuple[bytes, int]] = {}

    @cached_property
    def extractor(self) -> ImageExtractor:
        """The recipe, prepared for all images when it is needed first."""
        names, context = self.features.names(), self.context
        return prepare(self.extraction, context.resources, names, context.progress)

    @property
    def has_stepped(self) -> bool:
        """Whether a step has begun, or was taken."""
        return self.matches.note(STEP) is not None

    @property
    def is_over_time(self) -> bool:
        """Whether the time that the user gave is over."""
        return time.monotonic() > self.context.deadline_s

    def num_inliers(self) -> dict[Pair, int]:
        """Return the inliers of pairs in the database that may be used, 0 of unverified ones."""
        ids = self.context.graph.ids
        verified = self.context.num_verified_inliers()
        return {
            (first, second): verified.get((first, second)) or verified.get((second, first), 0)
            for first, second in self.pairs
            if first in ids and second in ids and self.context.by_hand.allows(first, second)
        }

    def models(self) -> list[ModelSummary]:
        """Return what is known of the models before, that of an empty one where there are none."""
        return read_summaries(self.context.workspace.sparse) or [ModelSummary((), 0, 0.0, 0.0)]

    def needs(self, models: Sequence[ModelSummary]) -> dict[str, float]:
        """Return what more matches may be worth to images: 1 to those that no model has.

        To doubtful ones of the first what they may add to the probability that these are right,
        and a quarter of all that to those which are likely right in the model that they are in.
        """
        workspace = self.context.workspace
        names = set(self.features.names()).difference(self.context.by_hand.left_out)
        lost = names - set(models[0].sure)
        if workspace.made_from("map") != self.context.verified_digest():
            strong, counts = self.options.strong_num_inliers, self.num_inliers()
            insecure = lost & expected_gain.insecure_images(counts, strong, self._loose())
            # The next model tells of what has been tied since.
            maps_next = insecure != lost and workspace.sparse.exists() and len(names) < LARGE
            lost = set() if maps_next else insecure
        likely = frozenset[str]().union(*(model.likely for model in models))
        worth = {name: LIKELY if name in likely else 1.0 for name in sorted(lost)}
        return {name: share * models[0].gains.get(name, 1.0) for name, share in worth.items()}

    def _held(self, model: ModelSummary, states: Mapping[Pair, PairState]) -> set[str]:
        """Return the images of a model that measured frames tie to one that is likely right."""
        held = set[str]()
        for pair, state in states.items():
            is_tied = state.num_inliers and self.is_measured[state.level]
            if is_tied and not model.likely.isdisjoint(pair):
                held.update(pair)
        return held.intersection(model.registered_names)

    def _loose(self) -> set[str]:
        """Return the images with few features in tracks through three, where there are three."""
        if len(self.features.names()) < 3:
            return set()
        limit = self.context.guiding.min_num_tracks
        return weakly_connected_images(self.context.verified_inliers(), limit)

    def states(self) -> dict[Pair, PairState]:
        """Return what is known of the pairs that are in the database."""
        num_inliers = self.num_inliers()
        failed = [pair for pair, count in num_inliers.items() if not count]
        num_consistent, levels = self._num_consistent(failed), self.matches.levels
        reached, tried = levels(num_inliers), levels(num_inliers, "tried")
        measured = self.matches.measured_worths(num_inliers)
        learned = self.matches.learned_levels(num_inliers)
        return {
            pair: PairState(
                count,
                num_consistent.get(pair, 0),
                reached[pair],
                tried[pair],
                measured_worth=measured[pair],
                learned_level=learned[pair],
            )
            for pair, count in num_inliers.items()
        }

    def _num_consistent(self, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """Return how many raw matches of pairs confirm each other."""
        if not pairs:
            return {}
        ids = self.context.graph.ids
        with open_database(self.path) as database:
            matches = {(a, b): database.read_matches(ids[a], ids[b]) for a, b in pairs}
        known = self._consistent
        for pair, indices in matches.items():
            key = indices.tobytes()
            if pair not in known or known[pair][0] != key:
                known[pair] = key, num_confirming(self.features, pair, indices)
        return {pair: known[pair][1] for pair in pairs}

    def situation(self, needs: Mapping[str, float], models: Sequence[ModelSummary]) -> Situation:
        """Return what the policy decides by.

        Args:
            needs: what saving images is worth, by name.
            models: the models that are there, the largest first.

        Returns:
            The state of all pairs and images.
        """
        states = self.states()
        sizes = self.features.image_sizes()
        ranges = {name: self.features.level_ranges(name) for name in sizes}
        levels = self.extraction.levels
        return Situation(
            levels=levels,
            usable=self.context.resources.usable_levels(self.extraction)[1:],
            states=states,
            needs=needs,
            loose=self._loose(),
            held=self._held(models[0], states),
            megapixels=[
                {name: _megapixels(size, level.max_image_size_px) for name, size in sizes.items()}
                for level in levels
            ],
            lacking=[
                {name for name in sizes if number not in ranges[name]}
                for number in range(len(levels))
            ],
            registered=models[0].registered_names,
            strong_num_inliers=self.options.strong_num_inliers,
        )

    def next_step(self) -> Step | None:
        """Return a level, and the pairs to match at it now; None when nothing is left to do.

        No pairs are left where a killed run has matched all of a step, but for the database.
        """
        if self.is_over_time:
            return None
        if begun := self.matches.note(STEP):
            level, pairs = begun
            tried = self.matches.levels(self.pairs, "tried")
            left = [pair for pair in map(tuple, pairs) if not tried.get(pair, -1) >> level & 1]
            return Step(level, [pair for pair in left if self.context.by_hand.allows(*pair)])
        plan = self._plan()
        self.left_s = plan.left_s / available_cores()
        return plan.step if plan.step.pairs else None

    def _plan(self) -> Plan:
        models = self.models()
        needs = self.needs(models)
        if not needs:
            return Plan()
        return next_step(self.situation(needs, models), self.context.effort)

    def taken(self, step: Step, report: StageReport) -> StageReport:
        """Take a step, and return the report with its pairs and seconds."""
        start = time.perf_counter()
        self.match_at(step.pairs, step.level)
        wall_s = report.wall_s + time.perf_counter() - start
        return StageReport("escalate", wall_s, report.num_done + len(step.pairs))

    def ended(self, report: StageReport) -> StageReport:
        """Return the report with what could not be tried, which is logged, too."""
        warnings = self.waiting()
        if self.is_over_time:
            warnings["time"] = "it is over; the same command without --max-time tries more"
        for what, text in warnings.items():
            logger.warning("%s: %s", what, text)
        return StageReport("escalate", report.wall_s, report.num_done, warnings=warnings)

    def match_at(self, pairs: Sequence[Pair], level: int) -> None:
        """Match pairs with the features of a level and keep what has more inliers.

        What is to be done is on record meanwhile: a killed run could not tell it else.
        """
        if pairs:
            self.matches.keep_note(STEP, [level, list(pairs)])
        known = {
            p: one for p, one in self.matches.learned(pairs).items() if one.matches.level == level
        }
        unknown = [pair for pair in pairs if pair not in known]
        if known:
            states = self.states()
            trials = [Trial(one.matches, one.worth, states[pair]) for pair, one in known.items()]
            self._keep(trials, level)
        self._match_with(unknown, level, self._keep)
        self.write()
        self.matches.keep_note(STEP, [])

    def plan_learning(self) -> bool:
        """Put on record which pairs are to be matched by a learned level, beside what is there.

        A killed run could not tell it else: images that get features change the database.

        Returns:
            Whether there are any; none of sets that are large or need nothing, nor where no learned
            level can be used.
        """
        if self.matches.note(LEARNING):
            return True
        models = self.models()
        needs = self.needs(models)
        if not needs:
            return False
        situation = self.situation(needs, models)
        step = learned_step(situation) if situation.is_small else Step()
        if step.pairs:
            self.matches.keep_note(LEARNING, [step.level, list(step.pairs)])
        return bool(step.pairs)

    def learn(self) -> int:
        """Match the pairs of :meth:`plan_learning` that have no learned matches yet.

        Returns:
            How many were matched; some may be left where the time that the user gave is over.
        """
        level, planned = self.matches.note(LEARNING)
        pairs = [(first, second) for first, second in planned]
        done = self.matches.learned_levels(pairs)
        todo = [pair for pair in pairs if done[pair] < 0]
        num_matched = 0
        for begin in range(0, len(todo), PAIRS_AT_ONCE):
            if self.is_over_time:
                break
            batch = todo[begin : begin + PAIRS_AT_ONCE]
            self._learn(Step(level, batch))
            num_matched += len(batch)
        self.write()  # the features are keypoints of the database, too
        return num_matched

    @property
    def is_learned(self) -> bool:
        """Whether all pairs of :meth:`plan_learning` have learned matches."""
        _, planned = self.matches.note(LEARNING)
        return min(self.matches.learned_levels(map(tuple, planned)).values()) >= 0

    def _learn(self, step: Step) -> None:

        def keep(batch: Sequence[Trial], _: int) -> None:
            self.matches.keep_learned([Learned(trial.found, trial.worth) for trial in batch])

        self._match_with(step.pairs, step.level, keep)

    def _match_with(
        self, pairs: Sequence[Pair], level: int, keep: Callable[[Sequence["Trial"], int], None]
    ) -> None:
        """Give images the features of a level that they lack, and match pairs with these."""
        images = sorted({name for pair in pairs for name in pair})
        needed = sorted({self.extraction.levels[level].base, level})
        there = {name: self.features.level_ranges(name) for name in images}
        missing = [(name, k) for name in images for k in needed if k not in there[name]]
        left = f" (at most about {self.left_s / 60:.0f} min)" if self.left_s >= 60 else ""
        title = f"escalate, {self.extraction.levels[level].name}{left}"
        with self.context.progress.stage(title, len(missing) + len(pairs), "steps") as advance:
            self._extend(missing, advance)
            if pairs:
                self._match_again(pairs, level, keep, advance)

    def waiting(self) -> dict[str, str]:
        """Say what levels that lack weights may tie, if anything is left to tie."""
        how = self.context.resources.how_to_complete(self.extraction)
        if not how or not (left := sorted(self.needs(self.models()))):
            return {}
        text = f"its weights are not here; it may tie {such_as(left)}: {how}; then run this again"
        return {"learned matching": text}

    def write(self) -> None:
        """Bring the database up to what is stored."""
        update_verified(self.context, self.pairs, replaces=True)

    def _extend(self, missing: Sequence[tuple[str, int]], advance: Callable[[int], None]) -> None:
        """Add to images the features of levels that they lack."""
        if not missing:
            return
        images = extract_images(self.context, self.context.inputs, self.extractor, missing)
        with closing(images) as found_images:
            for (name, level), found in zip(missing, found_images, strict=True):
                if isinstance(found, ImageError):
                    raise found
                self.features.extend(name, found.features, level)
                advance(1)

    def _match_again(
        self,
        pairs: Sequence[Pair],
        level: int,
        keep: Callable[[Sequence[Trial], int], None],
        advance: Callable[[int], None],
    ) -> None:
        size_px = self.extraction.levels[level].max_image_size_px
        graph = self.context.graph
        verifier = PairVerifier(graph.ids, graph.cameras, self.verification, size_px)
        states = self.states()

        def judged(found: PairMatches) -> Trial:
            names = found.names
            return Trial(found, self._worth(found, verifier), states[names])

        def write(batch: Sequence[Trial]) -> None:
            keep(batch, level)

        with closing(matched_at_level(self.context, pairs, self.matching, level)) as found_pairs:
            write_batches(map(judged, found_pairs), write, advance)

    def _keep(self, batch: Sequence[Trial], level: int) -> None:
        """Write the better matches of some trials, and that all were made; all or nothing."""
        better = [trial.found for trial in batch if trial.is_better]
        tried = [trial.found.names for trial in batch]
        self.matches.write(better, tried, level, self._measured_worths(batch))

    def _measured_worths(self, batch: Sequence[Trial]) -> dict[Pair, Worth]:
        """Return what the best measured matches are worth of pairs that use learned ones."""
        worths = dict[Pair, Worth]()
        for trial in batch:
            was_measured = self.is_measured[trial.before.level]
            is_measured = self.is_measured[trial.found.level]
            if was_measured and not is_measured and trial.is_better:
                worths[trial.found.names] = trial.before.worth
            elif is_measured and not was_measured:
                worths[trial.found.names] = max(trial.worth, trial.before.measured_worth)
        return worths

    def _worth(self, found: PairMatches, verifier: PairVerifier) -> Worth:
        """Return the inliers of a pair, or without any how many matches confirm each other."""
        names, (first, second) = found.names, map(self.features.read_frames, found.names)
        if count := len(verifier.inliers(names, (first, second), found.indices)):
            return count, 0
        return 0, num_confirming(self.features, names, found.indices)


def _megapixels(size: tuple[int, int], limit_px: int) -> float:
    return math.prod(size) * min(1.0, limit_px / max(size)) ** 2 / 1e6
