"""Climb: map, match again what lost and doubtful photographs need, and map on, until nothing helps.

The first model says what is needed: where it is sure of all photographs, nothing more is done.
Later models begin with those before, and so are not worse, by the evidence. Where learned matching
was tried, models of its matches alone, and of others alone, are looked at as well
(:mod:`colmap_affrect.stages.alternatives`).
"""

from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import model_folders
from colmap_affrect.mappers.sparse import LARGE
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import CLIMBING, FINISHED
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.alternatives import choose_kind, remember_score
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import begin
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images


def climb(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Map, and match again, until nothing helps; ``sparse/`` has the last model.

    A killed run goes on: once pairs are matched again, the first model is not made anew.

    Args:
        context: folder, resources and options on record.
        mapper: what makes models.
        recipe: its levels, and what guided matching does.

    Returns:
        What each step did.
    """
    escalation, escalated = begin(context, recipe.escalate)
    reports = _mapped_anew(context, mapper, recipe)
    reports += _mapped_on(context, mapper, recipe)  # a run may have been killed before
    if choose_kind(escalation, mapper):
        reports += _mapped_anew(context, mapper, recipe)
    is_small = len(context.features.names()) < LARGE
    while step := escalation.next_step():
        remember_score(context)
        escalated = escalation.taken(step, escalated)
        while not is_small and (step := escalation.next_step()):
            escalated = escalation.taken(step, escalated)
        reports += _mapped_on(context, mapper, recipe)
        if choose_kind(escalation, mapper):
            reports += _mapped_anew(context, mapper, recipe)
    return [*reports, escalation.ended(escalated)]


def _mapped_anew(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Map for the first time, or after other matches were chosen for many pairs."""
    matches = context.matches
    listed = matches.note(FINISHED)
    if matches.note(CLIMBING) == listed and model_folders(context.workspace.sparse):
        return []
    reports = [guide(context, recipe.guided), map_images(context, mapper)[0]]
    matches.keep_note(CLIMBING, listed)
    return reports


def _mapped_on(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Map what has changed, from the models that are there."""
    guided = guide(context, recipe.guided)
    return [guided, map_images(context, mapper, goes_on=True)[0]]
