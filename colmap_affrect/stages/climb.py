"""Climb: map, match again what lost and doubtful photographs need, and map on, until nothing helps.

The first model says what is needed: where it is sure of all photographs, nothing more is done.
Later models begin with those before, and so are not worse, by the evidence.
"""

from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import model_folders
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import CLIMBING, FINISHED
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images


def climb(context: Context, mapper: Mapper, recipe: Recipe) -> list[StageReport]:
    """Return what each step did; ``sparse/`` has the last model.

    A killed run goes on: once pairs are matched again, the first model is not made anew.
    """
    reports, matches = list[StageReport](), context.matches
    listed = matches.note(FINISHED)
    if matches.note(CLIMBING) != listed or not model_folders(context.workspace.sparse):
        reports += [guide(context, recipe.guided), map_images(context, mapper)[0]]
        matches.keep_note(CLIMBING, listed)
    while True:
        reports += [escalate(context, recipe.escalate), guide(context, recipe.guided)]
        mapped, _ = map_images(context, mapper, goes_on=True)
        reports.append(mapped)
        if not mapped.num_done:
            return reports
