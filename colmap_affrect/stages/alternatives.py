"""Which kind of matches the models are made of: the best of each pair, or those of one kind alone.

Matches of measured frames and learned ones err in different ways: where sides of a thing look
alike, or only a flat part of a scene is tied, one kind may place photographs wrongly that the other
places right, and mixed they may not agree at all. So where both were tried, models of each kind
alone are made beside those of the best matches of each pair. Those count for which most relative
poses are expected to be right.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace

from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.progress import SILENT
from colmap_affrect.project.outputs import temporary_folder
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stores import COMPARED, SCORE_BEFORE, Alternative, PairMatches
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import LEARNED_ONLY, MEASURED_ONLY, Escalation
from colmap_affrect.stages.escalation_policy import SMALL
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.verify import verify_matches

Choice = dict[Pair, tuple[PairMatches, Alternative]]


def score(models: Sequence[ModelSummary]) -> float:
    """Return how many relative poses to a first photograph are expected to be right.

    >>> model = ModelSummary(("a", "b", "c"), 9, 2.0, 0.5, {"a": 1.0, "b": 1.0, "c": 0.5})
    >>> score([model]), score([model, model]), score([])
    (1.5, 3.0, 0.0)
    """
    expected = (sum(model.probabilities.values()) - 1.0 for model in models)
    return sum(max(0.0, number) for number in expected)


def remember_score(context: Context) -> None:
    """Keep the score of the models that were there before learned matching."""
    if context.matches.note(SCORE_BEFORE) is None:
        context.matches.keep_note(SCORE_BEFORE, score(read_summaries(context.workspace.sparse)))


def choose_kind(escalation: Escalation, mapper: Mapper) -> bool:
    """Look at models of one kind of matches alone, where learned matching has been tried.

    Args:
        escalation: of the workspace; its models are those of the best matches of each pair.
        mapper: what makes models.

    Returns:
        Whether other matches were chosen, so that the models must be made again.
    """
    context = escalation.context
    matches = context.matches
    num_tried = _num_tried(escalation)
    num_compared, chosen = matches.note(COMPARED) or (0, "")
    if chosen or num_tried == num_compared or len(context.features.names()) > SMALL:
        return False
    best_score = score(read_summaries(context.workspace.sparse))
    best: tuple[str, Choice] = ("", {})
    if escalation.needs(escalation.models()):
        for kind in (LEARNED_ONLY, MEASURED_ONLY):
            before = matches.note(SCORE_BEFORE) or 0.0
            if kind == MEASURED_ONLY and before <= best_score:
                continue
            choice = _choice(escalation, kind)
            if not choice:
                continue
            found = score(_models_of(context, mapper, choice))
            if found > best_score:
                best_score = found
                best = kind, choice
    kind, choice = best
    compared = [num_tried, kind]
    if not choice:
        matches.keep_note(COMPARED, compared)
        return False
    matches.choose(choice, compared)
    escalation.write()
    return True


def _num_tried(escalation: Escalation) -> int:
    """Return for how many pairs a learned level has been tried."""
    bits = sum(1 << k for k, measured in enumerate(escalation.is_measured) if not measured)
    tried = escalation.matches.levels(escalation.num_inliers(), "tried")
    return sum(bool(levels & bits) for levels in tried.values())


def _choice(escalation: Escalation, kind: str) -> Choice:
    """Return the pairs that have other matches of a kind, with these and those that are there."""
    wanted = kind == MEASURED_ONLY
    states = escalation.states()
    others = escalation.matches.alternatives(list(states))
    changed = [
        pair
        for pair, other in others.items()
        if escalation.is_measured[other.matches.level] == wanted
        and escalation.is_measured[states[pair].level] != wanted
    ]
    found = Choice()
    for there in escalation.matches.read(changed):
        other = others[there.names]
        found[there.names] = other.matches, Alternative(there, states[there.names].worth)
    return found


def _models_of(context: Context, mapper: Mapper, choice: Choice) -> list[ModelSummary]:
    """Map a copy of the workspace in which some pairs have other matches."""
    workspace = context.workspace
    with temporary_folder(workspace.path) as folder:
        branch = workspace.branch(folder / "branch")
        branch.matches.unlink()  # a link perhaps
        shutil.copy(workspace.matches, branch.matches)
        other = replace(context, workspace=branch, progress=SILENT)
        other.matches.choose(choice)
        verify_matches(other, context.verification)
        guide(other, context.guiding)
        return map_images(other, mapper)[1]
