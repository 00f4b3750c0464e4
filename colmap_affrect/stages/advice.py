"""What may help photographs that are missing or doubtful, with commands to paste."""

import itertools
import re
import shlex
from collections.abc import Collection, Sequence
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.errors import such_as
from colmap_affrect.images.photographs import MaskOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.mappers.reliability import CONTRADICTIONS, FOCAL_CONTRADICTED, FOCAL_UNKNOWN
from colmap_affrect.project.report import Advice, ModelSummary
from colmap_affrect.project.tables import as_row
from colmap_affrect.stages.context import Context

STRONGEST = "default"  # of the recipes
ENOUGH = 100  # inliers of a pair that make a model wherever it shows depth
MIN_GAIN = 0.05  # of a probability, by more matches
FITTING_PX = re.compile(rf"{FOCAL_CONTRADICTED}, .*?(\d+) px does")


def advice(
    context: Context, missing: Collection[str], models: Sequence[ModelSummary], strongest: int
) -> tuple[Advice, ...]:
    """Say what may help when images are missing or the largest model is doubtful, best first.

    ``strongest`` is the largest number of inliers of a verified pair.
    """
    num_keypoints = colmap_database.keypoint_counts(context.workspace.database)
    lost = [n for n in missing if n in num_keypoints and n not in context.by_hand.left_out]
    model = models[0] if models else ModelSummary((), 0, 0.0, 0.0)
    doubts = "; ".join([*model.doubtful.values(), *model.taken_out.values()])
    if (missing or doubts) and sum(map(bool, num_keypoints.values())) < 2:
        return (Advice("more photographs: two that can be read and show the same make a model"),)
    if not models and strongest >= ENOUGH:
        return (Advice("more photographs, from other places: the matches of these show no depth"),)
    if not (lost or doubts):
        return ()
    found, inputs = list[Advice](), None if context.workspace.is_foreign else context.inputs
    may_change = inputs and not (inputs.from_database or inputs.cameras.cameras_path)
    if may_change and (fitting := FITTING_PX.search(doubts)):
        why = f"{FOCAL_CONTRADICTED}, {fitting[1]} px does"
        found.append(Advice(why, _anew(context, "--focal-length-px", fitting[1])))
    if helped := lost or [n for n in model.doubtful if model.gains.get(n, 0.0) >= MIN_GAIN]:
        found += _of_recipe(context, such_as(helped))
    if lost and len(model.likely) > 1 and context.mapping.name == MAPPERS.default:
        table, why = context.by_hand.tie_points_path, f"mark six points or more of {such_as(lost)}"
        why += " in two photographs of the model too, at Tie points by hand in report.html"
        if len(models) > 1:
            why += "; seven, each in two photographs of both, join two models"
        if table and not any(m.tie_points for m in models):
            why = f"no point of {table.name} is seen by two photographs of one model: {why}"
        words = ("--tie-points", str(table or "tie-points.csv"))
        found.append(Advice(why, _again(context, *words)))
    for name, bridge in model.bridges.items():
        if name in model.doubtful:
            why = f"if the matches of {name} and {bridge.by} are wrong by eye, leave them out"
            found.append(Advice(why, _again(context, "--reject-pair", as_row([name, bridge.by]))))
    if may_change and FOCAL_UNKNOWN in doubts:
        why = "give lens and film, plate or sensor; if you do not know them, try a normal lens"
        found.append(Advice(why, _anew(context, "--focal-mm", "50", "--film-width-mm", "36")))
    if inputs and inputs.masks == MaskOptions() and any(t in doubts for t in CONTRADICTIONS):
        why = "mask what moves, repeats or is written on photographs (black, in a folder masks)"
        found.append(Advice(why, _anew(context, "--mask-path", "masks")))
    if lost:
        found.append(Advice(f"more photographs, between {such_as(lost)} and the others"))
    return tuple(found)


def _of_recipe(context: Context, names: str) -> list[Advice]:
    workspace = context.workspace
    if workspace.is_foreign:
        command = _anew(context, "--from-database", str(workspace.database))
        return [Advice("make new features for its images", command)]
    if workspace.recipe() != STRONGEST:
        why = f"recipe {STRONGEST} tries more for {names}"
        return [Advice(why, _anew(context, "--recipe", STRONGEST))]
    how = context.resources.how_to_complete(context.extraction).partition(", or ")[0]
    why = f"learned matching, where light or age differ, may tie {names}"
    return [Advice(why, f"{how} && {_again(context)}")] if how else []


def _again(context: Context, *words: str) -> str:
    base = context.command or (
        "colmap-affrect",
        "map",
        "--output-path",
        str(context.workspace.path),
    )
    return shlex.join([*base, *(() if {*words} <= {*base} else words)])


def _anew(context: Context, *words: str) -> str:
    """Return a command for other options, which take the place of those that were given."""
    path, photos = context.workspace.path, context.workspace.photographs() or Path("photos")
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    new = (*words, "--output-path", str(next(place for place in numbered if not place.exists())))
    usual = ("colmap-affrect", "run", "--image-path", str(photos))
    base = context.command if context.command[1:2] == ("run",) else usual
    kept = [w for last, w in zip(("", *base), base, strict=False) if not {last, w} & {*new[::2]}]
    return shlex.join([*kept, *new])
