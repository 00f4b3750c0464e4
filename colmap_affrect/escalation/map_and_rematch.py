"""Map, match again what lost and doubtful photographs need, and map on, until nothing helps.

The first model says what is needed: where it is sure of all photographs, nothing more is done.
Later models begin with those before. Models of learned matches are looked at as well, and the
best ones so far are gone back to in the end (:mod:`colmap_affrect.escalation.alternatives`).
"""

import time
from functools import partial

from colmap_affrect.escalation.alternatives import (
    adopt_chosen_models,
    choose_learned,
    give_up_learned_models,
    has_become_worse,
    has_models_to_go_on_from,
    keep_best,
    map_learned_matches,
    needs_learned_models,
    remove_alternatives,
    restore_best,
    update_keypoints_of_models,
)
from colmap_affrect.escalation.escalate import Escalation, begin
from colmap_affrect.escalation.policy import EFFORTS
from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import model_folders
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.recipes import Recipe
from colmap_affrect.session.context import Context
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images


def map_and_rematch(
    context: Context, mapper: Mapper, recipe: Recipe
) -> list[StageReport]:
    """Map, and match again, until nothing helps; ``sparse/`` has the best models found.

    A killed run goes on: once pairs are matched again, the first model is not made anew.

    Args:
        context: folder, resources and options on record.
        mapper: what makes models.
        recipe: its levels, and what guided matching does.

    Returns:
        What each step did.
    """
    escalation = begin(context, recipe.escalate)
    adopt_chosen_models(escalation)
    reports = _map_first(context, mapper, recipe)
    _try_learned_matches(escalation, mapper)
    is_chosen = choose_learned(escalation, at_once=True)
    is_untouched = not is_chosen and not escalation.has_stepped
    if is_untouched and context.matches.state.learned_matching:
        update_keypoints_of_models(context)
    is_unfinished = True
    while is_unfinished:
        # What made models worse has cost enough.
        escalation.take_steps(
            partial(keep_best, context), may_cost=not has_become_worse(context)
        )
        before = context.workspace.model_inputs()
        reports += _map_on(context, mapper, recipe)
        # Nothing changes where no pair makes a model, or all are mapped.
        has_mapped = context.workspace.model_inputs() != before
        is_unfinished = (
            has_mapped
            or restore_best(escalation)
            or choose_learned(escalation, at_once=False)
        )
    remove_alternatives(context)
    return [*reports, escalation.final_report()]


def _try_learned_matches(escalation: Escalation, mapper: Mapper) -> None:
    """Match pairs of a small set by learned matching, once, and map with these matches alone.

    The pairs that measured frames verify come first where there is something to go on from: models
    of learned matches are not likely to be better unless these tie most of them better. If not,
    learned matching is a level as any other, where the effort has time for such.
    """
    context = escalation.context
    if not needs_learned_models(context) or not escalation.plan_learned_matching():
        return
    start = time.perf_counter()
    num_matched = 0
    has_time_for_levels = not EFFORTS[context.effort].ends_after_learned_matching
    may_be_in_vain = has_time_for_levels and has_models_to_go_on_from(context)
    if may_be_in_vain:
        num_matched += escalation.match_learned(only_verified=True)
    if may_be_in_vain and escalation.ties_verified_pairs_no_better:
        give_up_learned_models(context)
    else:
        num_matched += escalation.match_learned()
        if escalation.has_all_learned_matches:
            map_learned_matches(escalation, mapper)
    escalation.add_to_report(time.perf_counter() - start, num_matched)


def _map_first(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Map for the first time, unless a run before has gone on from there."""
    matches = context.matches
    state = matches.state
    if state.modelled == state.listed and model_folders(context.workspace.sparse):
        return []
    remove_alternatives(context)  # of other pairs
    reports = [guide(context, recipe.guided), map_images(context, mapper)[0]]
    matches.update_state(modelled=state.listed, rounds=())
    return reports


def _map_on(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Map what has changed, from the models that are there."""
    guided = guide(context, recipe.guided)
    return [guided, map_images(context, mapper, begins_with_models=True)[0]]
