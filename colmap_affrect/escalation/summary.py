"""What escalation did for a set, and what it left: for reports."""

from dataclasses import dataclass

from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.escalation.policy import matched_by_level, untried_by_level
from colmap_affrect.options import EffortName
from colmap_affrect.project.report import MatchedAgain
from colmap_affrect.session.context import Context


@dataclass(frozen=True)
class EscalationSummary:
    """What escalation did for a set, and what is left."""

    effort: EffortName = "normal"  # how much was tried
    matched_again: tuple[MatchedAgain, ...] = ()  # pairs by level
    untried: tuple[MatchedAgain, ...] = ()  # what a greater effort would try


def escalation_summary(context: Context) -> EscalationSummary:
    """Return what escalation did in a workspace, and what is left for images to match again."""
    workspace = context.workspace
    if workspace.is_foreign or "escalate" not in workspace.started_stages:
        return EscalationSummary()
    escalation = Escalation(context, context.escalation)
    image_set = escalation.image_set
    models = image_set.models()
    weights = image_set.weights(models)
    if not (weights or escalation.has_begun):  # large sets take long to go through
        return EscalationSummary()
    situation = image_set.situation(weights, models)
    effort = escalation.matches.state.effort or context.effort
    return EscalationSummary(
        effort=effort,
        matched_again=tuple(matched_by_level(situation)),
        untried=tuple(untried_by_level(situation)),
    )
