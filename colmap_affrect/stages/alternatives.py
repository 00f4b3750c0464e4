"""Which kind of matches the models are made of: the best of each pair, or those of one kind alone.

Matches of measured frames and learned ones err in different ways: where sides of a thing look
alike, or only a flat part of a scene is tied, one kind may place photographs wrongly that the other
places right, and mixed they may not agree at all. So models of learned matches alone are made
beside those that grow step by step. The kind is chosen for which most relative poses are expected
to be right.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.progress import SILENT
from colmap_affrect.project.outputs import temporary_folder
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stores import (
    LEARNED,
    MEASURED,
    SCORES,
    Alternative,
    Kind,
    PairMatches,
)
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import Escalation
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.verify import verify_matches


def score(models: Sequence[ModelSummary]) -> float:
    """Return how many poses relative to a first image are expected to be right.

    >>> model = ModelSummary(("a", "b", "c"), 9, 2.0, 0.5, {"a": 1.0, "b": 1.0, "c": 0.5})
    >>> score([model]), score([model, model]), score([])
    (1.5, 3.0, 0.0)
    """
    expected = (sum(model.probabilities.values()) - 1.0 for model in models)
    return sum(max(0.0, number) for number in expected)


@dataclass(frozen=True)
class Scores:
    """Scores of the models by one kind of matches alone."""

    by_kind: Mapping[Kind, float] = field(default_factory=dict)
    is_sure: bool = False  # whether the models of learned matches have all images, and are sure
    chosen: str = ""  # kind that took the place of the best matches of each pair

    @classmethod
    def of(cls, context: Context) -> "Scores | None":
        """Return what is on record; None before learned matching."""
        known = context.matches.note(SCORES)
        return cls(**known) if known else None


def look_at_learned(escalation: Escalation, mapper: Mapper) -> None:
    """Map learned matches alone, once, and keep the score on record.

    Args:
        escalation: of the workspace; its models are those of the first matches.
        mapper: what makes models.
    """
    context = escalation.context
    models = read_summaries(context.workspace.sparse)
    by_kind: dict[Kind, float] = {MEASURED: score(models)}
    is_sure = False
    choice = _choice(escalation, LEARNED)
    if choice.matches:
        found = _models_of(context, mapper, choice)
        by_kind[LEARNED] = score(found)
        is_sure = bool(found) and len(found[0].sure) == len(context.features.names())
    context.matches.keep_note(SCORES, asdict(Scores(by_kind, is_sure)))


def choose_kind(escalation: Escalation, *, at_once: bool) -> bool:
    """Let the matches of one kind take the place of the others if their models are better.

    Args:
        escalation: of the workspace, with the models that are there.
        at_once: choose learned matches only if nothing is left to try with them, or nothing is
            registered without.

    Returns:
        Whether other matches were chosen, so that the models must be made again.
    """
    context = escalation.context
    scores = Scores.of(context)
    if not scores or scores.chosen:
        return False
    present = score(read_summaries(context.workspace.sparse))
    if at_once:  # as it was then, also for a run that was killed since
        present = scores.by_kind[MEASURED]
    kind = max(scores.by_kind, key=lambda name: scores.by_kind[name])
    if scores.by_kind[kind] <= present:
        return False
    if at_once and not (scores.is_sure or present == 0.0):
        return False
    choice = _choice(escalation, kind)
    if not choice.matches:
        return False
    chosen = asdict(replace(scores, chosen=kind))
    context.matches.choose(choice.matches, choice.kept, chosen)
    escalation.write()
    return True


@dataclass(frozen=True)
class Choice:
    """Matches of one kind for pairs that use others."""

    matches: Sequence[PairMatches]
    kept: Sequence[Alternative]  # measured matches that were in use


def _choice(escalation: Escalation, kind: Kind) -> Choice:
    """Return what changes if all pairs use the matches of a kind that are kept beside others."""
    states = escalation.states()
    others = escalation.matches.alternatives(list(states), kind)
    matches = list[PairMatches]()
    kept = list[Alternative]()
    for there in escalation.matches.read(list(others)):
        other = others[there.names]
        is_measured = escalation.is_measured[there.level]
        if (kind == MEASURED and is_measured) or there.level == other.matches.level:
            continue
        matches.append(other.matches)
        if is_measured:
            kept.append(Alternative(MEASURED, there, states[there.names].worth))
    return Choice(matches, kept)


def _models_of(context: Context, mapper: Mapper, choice: Choice) -> list[ModelSummary]:
    """Map a copy of the workspace in which some pairs have other matches."""
    workspace = context.workspace
    with temporary_folder(workspace.path) as folder:
        branch = workspace.branch(folder / "branch")
        branch.matches.unlink()  # a link perhaps
        shutil.copy(workspace.matches, branch.matches)
        other = replace(context, workspace=branch, progress=SILENT)
        other.matches.choose(choice.matches, choice.kept)
        verify_matches(other, context.verification)
        guide(other, context.guiding)
        return map_images(other, mapper)[1]
