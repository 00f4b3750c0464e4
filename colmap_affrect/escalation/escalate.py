"""Escalation on demand: more warps for the pairs of images that need them, and only those.

Images get the features that a level of the recipe adds, and pairs are matched again with them
(Mishkin, Matas, Perdoch, MODS, 2015). New matches take the place of the old ones only when their
two-view geometry has more inliers, or, where neither is verified, when more of them confirm each
other. Which pairs are matched again, and at which level, is decided anew after every step
(:mod:`colmap_affrect.escalation.policy`), by what is known then
(:mod:`colmap_affrect.escalation.image_set`); the step that has begun is on record, so that a killed
run goes on in the same way.

Images are matched again that are missing in the model, or that it is not sure of. While there is
no model, these are the images without a strong pair and those with few features in tracks through
three images; a small set is mapped as soon as one image has a strong pair.
"""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property

from colmap_affrect.colmap.database_verification import PairVerifier
from colmap_affrect.errors import Logged, such_as
from colmap_affrect.escalation.expected_gain import PairState, Step
from colmap_affrect.escalation.image_set import ImageSet
from colmap_affrect.escalation.policy import (
    EFFORTS,
    Plan,
    learned_step,
    next_step,
)
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.image_failures import UnusableImageError
from colmap_affrect.project.match_state import Begun, Worth
from colmap_affrect.project.match_store import Learned, PairMatches
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.recipes import EscalateOptions
from colmap_affrect.session.context import Context
from colmap_affrect.stages.extract import extract_images
from colmap_affrect.stages.match import matched_at_level, num_consistent, write_batches
from colmap_affrect.stages.one_image import ImageExtractor, prepare
from colmap_affrect.stages.verify import update_verified

logger = logging.getLogger(__name__)

PAIRS_AT_ONCE = 50  # resources: matched between two looks at the clock


def escalate(context: Context, options: EscalateOptions | None = None) -> StageReport:
    """Go through the levels of the recipe, if any, without mapping in between.

    Args:
        context: folder, resources and options on record.
        options: which pairs are strong; by default those on record.

    Returns:
        What was done; ``num_done`` counts the pairs that were matched again now.
    """
    escalation = begin(context, options)
    escalation.take_steps()
    return escalation.final_report()


def begin(context: Context, options: EscalateOptions | None = None) -> "Escalation":
    """Return what lets pairs escalate; the database is brought up to what a killed run stored."""
    start = time.perf_counter()
    context.resources.require_device()
    context.workspace.require("verify")
    options = options or context.escalation
    context.workspace.record_options("escalate", options.to_mapping())
    if context.matches.state.effort != context.effort:
        context.matches.update_state(effort=context.effort)
    escalation = Escalation(context, options)
    if escalation.has_begun:
        escalation.write()
    escalation.add_to_report(time.perf_counter() - start, num_pairs=0)
    return escalation


@dataclass(frozen=True)
class Trial:
    """Matches that were found for a pair at a level, beside what was there."""

    found: PairMatches
    worth: Worth
    before: PairState

    @property
    def is_better(self) -> bool:
        """Whether it takes the place of what is there.

        Inliers that a surely wrong model stood on count for nothing: others that
        verify the pair are tried in their place, also where they are fewer.
        """
        num_inliers, _ = self.worth
        if self.before.is_questioned:
            return num_inliers > 0
        return self.worth > self.before.worth


Keep = Callable[[Sequence[Trial], int], None]  # writes trials that were made at a level


class Escalation:
    """Lets pairs of a workspace escalate to a level, with the options on record.

    Attributes:
        context: of the workspace.
        state: what is known of its images and pairs.
        matches: its raw matches.
        left_s: seconds that all steps to come may take, if nothing helps any more.
        report: pairs and seconds of what was done so far.
    """

    def __init__(self, context: Context, options: EscalateOptions) -> None:
        """Name the workspace.

        Args:
            context: of the workspace, whose pairs are verified.
            options: which pairs are strong.
        """
        self.context = context
        self.image_set = ImageSet(context, options)
        self.matches = context.matches
        self.left_s = 0.0
        self.report = StageReport(name="escalate", wall_s=0.0, num_done=0)

    @cached_property
    def extractor(self) -> ImageExtractor:
        """The recipe, prepared for all images when it is needed first."""
        context = self.context
        names = context.features.names()
        return prepare(
            options=context.extraction,
            resources=context.resources,
            image_names=names,
            progress=context.progress,
        )

    @property
    def has_stepped(self) -> bool:
        """Whether a step has begun, or was taken."""
        return self.matches.state.has_stepped

    @property
    def has_begun(self) -> bool:
        """Whether learned matching or a step has begun, perhaps in a run that was killed."""
        state = self.matches.state
        return state.has_stepped or state.learned_matching is not None

    @property
    def is_over_time(self) -> bool:
        """Whether the time that the user gave is over."""
        return time.monotonic() > self.context.deadline_s

    def next_step(self, *, may_cost: bool = True) -> Step | None:
        """Return a level, and the pairs to match at it now; None when nothing is left to do.

        No pairs are left where a killed run has matched all of a step, but for the database.

        Args:
            may_cost: otherwise only matches that are there already are used.
        """
        if self.is_over_time:
            return None
        begun = self.matches.state.step
        if begun:
            return Step(begun.level, self._left_of(begun))
        plan = self._plan(may_cost=may_cost)
        self.left_s = plan.left_s / available_cores()
        self.context.progress.expect(self.left_s)
        return plan.step if plan.step.pairs else None

    def _left_of(self, begun: Begun) -> list[Pair]:
        """Return the pairs of a step that has begun for which its level was not tried yet."""
        tried_levels = self.matches.levels(self.image_set.pairs, "tried")
        left = list[Pair]()
        for pair in self._allowed(begun.pairs):
            was_tried = tried_levels.get(pair, -1) >> begun.level & 1
            if not was_tried:
                left.append(pair)
        return left

    def _plan(self, *, may_cost: bool) -> Plan:
        models = self.image_set.models()
        weights = self.image_set.weights(models)
        if not weights:
            return Plan()
        situation = self.image_set.situation(weights, models)
        return next_step(situation, self.context.effort, may_cost=may_cost)

    def take_steps(
        self, before_each: Callable[[], None] = lambda: None, *, may_cost: bool = True
    ) -> None:
        """Take steps until none is left.

        Args:
            before_each: called before each step.
            may_cost: otherwise only matches that are there already are used.
        """
        step = self.next_step(may_cost=may_cost)
        while step:
            before_each()
            start = time.perf_counter()
            self.match_at(step.pairs, step.level)
            self.add_to_report(time.perf_counter() - start, len(step.pairs))
            step = self.next_step(may_cost=may_cost)

    def add_to_report(self, seconds: float, num_pairs: int) -> None:
        """Count what was done.

        Args:
            seconds: that it took.
            num_pairs: pairs that were matched again.
        """
        self.report = StageReport(
            name="escalate",
            wall_s=self.report.wall_s + seconds,
            num_done=self.report.num_done + num_pairs,
        )

    def final_report(self) -> StageReport:
        """Return the report with what could not be tried, which is logged, too."""
        warned = self._missing_weights()
        if self.is_over_time:
            warned.append(StageWarning("time_over", "time"))
        for warning in warned:
            logger.warning("%s", Logged(warning.line))
        return StageReport(
            name="escalate",
            wall_s=self.report.wall_s,
            num_done=self.report.num_done,
            warned=tuple(warned),
        )

    def _missing_weights(self) -> list[StageWarning]:
        """Warn of images for which levels that lack weights would be tried."""
        resources = self.context.resources
        commands = resources.commands_to_complete(self.context.extraction)
        if not commands:
            return []
        left = sorted(self.image_set.weights(self.image_set.models()))
        if not left:
            return []
        values: dict[str, int | str] = {
            "num": len(left),
            "examples": such_as(left),
            "how": ", or ".join(commands),
        }
        return [StageWarning("no_weights", "learned matching", values)]

    def match_at(self, pairs: Sequence[Pair], level: int) -> None:
        """Match pairs with the features of a level and keep what has more inliers.

        What is to be done is on record meanwhile, so that an interrupted run can resume.

        Args:
            pairs: of image names.
            level: number of the level in the recipe.
        """
        if pairs and not self.matches.state.step:
            self._begin_step(level, pairs)
        known = self._use_learned_matches(pairs, level)
        unknown = [pair for pair in pairs if pair not in known]
        self._match_with(unknown, level, self._keep)
        self.write()
        self._end_step()

    def _begin_step(self, level: int, pairs: Sequence[Pair]) -> None:
        """Put a step on record, and that learned matching was left out before it, if it was."""
        state = self.matches.state
        step = Begun(level, tuple(pairs), follows_mapping=self.image_set.is_mapped())
        unlearned_set = state.unlearned_set
        if state.learned_matching is None and self.image_set.has_learned_level():
            unlearned_set = self.context.set_digest()
        self.matches.update_state(
            step=step, has_stepped=True, unlearned_set=unlearned_set
        )

    def _end_step(self) -> None:
        """Put on record that a step has ended, and whether mapping follows it."""
        step = self.matches.state.step
        rounds = self.matches.state.rounds
        if step and step.follows_mapping and not self.image_set.is_mapped():
            rounds = (*rounds, step.level)
        self.matches.update_state(step=None, rounds=rounds)

    def _use_learned_matches(self, pairs: Sequence[Pair], level: int) -> set[Pair]:
        """Use the learned matches of a level that are there already, where they are better.

        Args:
            pairs: of image names.
            level: number of the level in the recipe.

        Returns:
            The pairs that have such matches.
        """
        learned = list[Learned]()
        for one in self.matches.learned(pairs).values():
            if one.matches.level == level:
                learned.append(one)
        if not learned:
            return set()
        states = self.image_set.states()
        trials = list[Trial]()
        for one in learned:
            trials.append(
                Trial(
                    found=one.matches, worth=one.worth, before=states[one.matches.names]
                )
            )
        self._keep(trials, level)
        return {one.matches.names for one in learned}

    def plan_learned_matching(self) -> bool:
        """Put on record which pairs are to be matched by a learned level, beside what is there.

        An interrupted run resumes with these: images that get features change the database.

        Returns:
            Whether there are any; none of sets that are large or need nothing, where no learned
            level can be used, and where the same set was gone on with without it before.
        """
        if self.matches.state.learned_matching:
            return True
        effort = self.context.effort
        present = self.context.set_digest()
        was_left_out = self.matches.state.unlearned_set == present
        if was_left_out and EFFORTS[effort].gives_up:
            return False
        models = self.image_set.models()
        weights = self.image_set.weights(models)
        if not weights:
            return False
        situation = self.image_set.situation(weights, models)
        if not situation.is_small or situation.learned_level is None:
            return False
        step = learned_step(situation, effort)
        if not step.pairs:
            self.matches.update_state(unlearned_set=present)
            return False
        after = next_step(situation, effort)
        self.context.progress.expect(after.left_s / available_cores())
        planned = Begun(step.level, tuple(step.pairs))
        self.matches.update_state(learned_matching=planned)
        return True

    def match_learned(self, *, only_verified: bool = False) -> int:
        """Match the pairs of :meth:`plan_learned_matching` that have no learned matches yet.

        Args:
            only_verified: leave those that are not verified.

        Returns:
            How many were matched; some may be left where the time that the user gave is over.
        """
        planned = self.matches.state.learned_matching or Begun(0, ())
        pairs = self._allowed(planned.pairs)
        if only_verified:
            pairs = [*self._verified_of(pairs)]
        done = self.matches.learned_levels(pairs)
        todo = [pair for pair in pairs if done[pair] < 0]
        num_matched = 0
        for begin in range(0, len(todo), PAIRS_AT_ONCE):
            if self.is_over_time:
                break
            batch = todo[begin : begin + PAIRS_AT_ONCE]
            self._match_with(batch, planned.level, self._keep_learned)
            num_matched += len(batch)
        self.write()  # the features are keypoints of the database, too
        return num_matched

    @property
    def ties_verified_pairs_no_better(self) -> bool:
        """Whether learned matches have more inliers for no more than half of the verified pairs.

        Of those that :meth:`plan_learned_matching` has, unless they use learned matches already. It
        is not known before all of these have learned matches.
        """
        planned = self.matches.state.learned_matching or Begun(0, ())
        verified = self._verified_of(self._allowed(planned.pairs))
        levels = self.matches.levels([*verified])
        verified = {
            pair: num_inliers
            for pair, num_inliers in verified.items()
            if levels[pair] != planned.level
        }
        learned = self.matches.learned([*verified])
        if not verified or len(learned) < len(verified):
            return False
        num_better = 0
        for pair, one in learned.items():
            num_better += one.worth[0] > verified[pair]
        return 2 * num_better <= len(verified)

    def _verified_of(self, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """Return those of some pairs that are verified, with their inliers."""
        num_inliers = self.image_set.num_inliers()
        return {pair: num_inliers[pair] for pair in pairs if num_inliers.get(pair)}

    @property
    def has_all_learned_matches(self) -> bool:
        """Whether :meth:`plan_learned_matching` has pairs, and all have learned matches."""
        planned = self.matches.state.learned_matching
        pairs = self._allowed(planned.pairs) if planned else []
        levels = self.matches.learned_levels(pairs)
        return min(levels.values(), default=-1) >= 0

    def _allowed(self, pairs: Sequence[Pair]) -> list[Pair]:
        """Return those of some pairs that nobody has rejected since they were planned."""
        return [pair for pair in pairs if self.context.by_hand.allows(*pair)]

    def write(self) -> None:
        """Bring the database up to what is stored, and verify what is new."""
        update_verified(self.context, self.image_set.pairs, replaces=True)

    def _match_with(self, pairs: Sequence[Pair], level: int, keep: Keep) -> None:
        """Give images the features of a level that they lack, and match pairs with these."""
        missing = self._missing_features(pairs, level)
        part = self.context.extraction.levels[level].name
        num_steps = len(missing) + len(pairs)
        stage = self.context.progress.stage
        with stage("escalate", num_steps, "steps", part) as advance:
            self._extend(missing, advance)
            if pairs:
                self._match_again(pairs, level, keep, advance)

    def _missing_features(
        self, pairs: Sequence[Pair], level: int
    ) -> list[tuple[str, int]]:
        """Return the images without features of a level or its base, each with the level."""
        names = set[str]()
        for pair in pairs:
            names.update(pair)
        wanted = sorted({self.context.extraction.levels[level].base, level})
        missing = list[tuple[str, int]]()
        for name in sorted(names):
            there = self.context.features.level_ranges(name)
            for number in wanted:
                if number not in there:
                    missing.append((name, number))
        return missing

    def _extend(
        self, missing: Sequence[tuple[str, int]], advance: Callable[[int], None]
    ) -> None:
        """Add to images the features of levels that they lack."""
        if not missing:
            return
        images = extract_images(
            self.context, self.context.inputs, self.extractor, missing
        )
        with closing(images) as found_images:
            for (name, level), found in zip(missing, found_images, strict=True):
                if isinstance(found, UnusableImageError):
                    raise found
                self.context.features.extend(name, found.features, level)
                advance(1)

    def _match_again(
        self,
        pairs: Sequence[Pair],
        level: int,
        keep: Keep,
        advance: Callable[[int], None],
    ) -> None:
        """Match pairs with the features of a level, and keep the trials batch by batch."""
        context = self.context
        size_px = context.extraction.levels[level].max_image_size_px
        graph = context.graph
        verifier = PairVerifier(
            ids=graph.ids,
            cameras=graph.cameras,
            options=context.verification,
            extracted_px=size_px,
        )
        states = self.image_set.states()

        def trial_of(found: PairMatches) -> Trial:
            return Trial(
                found=found,
                worth=self._worth(found, verifier),
                before=states[found.names],
            )

        def write(batch: Sequence[Trial]) -> None:
            keep(batch, level)

        matched = matched_at_level(context, pairs, context.matching, level)
        with closing(matched) as found_pairs:
            write_batches(map(trial_of, found_pairs), write, advance)

    def _worth(self, found: PairMatches, verifier: PairVerifier) -> Worth:
        """Return the inliers of a pair, or without any how many matches confirm each other."""
        features = self.context.features
        first, second = found.names
        frames = (features.read_frames(first), features.read_frames(second))
        num_inliers = len(verifier.inliers(found.names, frames, found.indices))
        if num_inliers:
            return num_inliers, 0
        return 0, num_consistent(features, found.names, found.indices)

    def _keep(self, batch: Sequence[Trial], level: int) -> None:
        """Write the better matches of some trials, and that all were made; all or nothing."""
        better = [trial.found for trial in batch if trial.is_better]
        tried_pairs = [trial.found.names for trial in batch]
        self.matches.write(better, tried_pairs, level, self._measured_worths(batch))

    def _keep_learned(self, batch: Sequence[Trial], _: int) -> None:
        """Write learned matches beside those in use."""
        learned = [Learned(trial.found, trial.worth) for trial in batch]
        self.matches.write_learned(learned)

    def _measured_worths(self, batch: Sequence[Trial]) -> dict[Pair, Worth]:
        """Return what the best measured matches are worth of pairs that use learned ones."""
        worths = dict[Pair, Worth]()
        for trial in batch:
            was_measured = self.image_set.is_measured[trial.before.level]
            is_measured = self.image_set.is_measured[trial.found.level]
            if was_measured and not is_measured and trial.is_better:
                worths[trial.found.names] = trial.before.worth
            elif is_measured and not was_measured:
                worths[trial.found.names] = max(
                    trial.worth, trial.before.measured_worth
                )
        return worths
