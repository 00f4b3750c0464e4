"""What may help photographs that are missing or doubtful, with commands to paste."""

import itertools
import shlex
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.errors import such_as
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.images.photographs import MaskOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.mappers.pair_graph import MAX_ERROR, MIN_NUM_MATCHES
from colmap_affrect.mappers.wrong_models import read_thrown_away
from colmap_affrect.options import EFFORT_NAMES, EffortName
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.reasons import Doubt, DoubtCode
from colmap_affrect.project.report import Advice, MatchedAgain, ModelSummary
from colmap_affrect.project.tables import as_row
from colmap_affrect.session.context import Context, Inputs

STRONGEST = "default"  # of the recipes
ENOUGH = 100  # inliers of a pair that make a model wherever it shows depth
MAX_BY_CHANCE = 0.03
"""Share of the inliers of a pair that chance alone may put on epipolar lines and off a homography
(theory: the width of their band by that of a photograph)."""
NUM_STRONGEST = 10  # pairs that are looked at for depth; resource
MIN_GAIN = 0.05  # of a probability, by more matches
CONTRADICTED: Collection[DoubtCode] = ("matches_disagree", "little_agreement")
"""Doubts of photographs whose matches are rather wrong than few."""


@dataclass(frozen=True)
class _Case:
    """What advice is about."""

    context: Context
    lost: Sequence[str]  # images with features that are not in the largest model
    num_images: int  # with features
    models: Sequence[ModelSummary]  # the largest first
    strongest: int  # inliers of a verified pair, at most
    untried: Sequence[MatchedAgain]  # what a greater effort would try
    effort: EffortName  # how much was tried

    @property
    def model(self) -> ModelSummary:
        """The largest model, an empty one where there is none."""
        return self.models[0] if self.models else ModelSummary((), 0, 0.0, 0.0)

    @property
    def doubts(self) -> list[Doubt]:
        """Why images are doubtful or were taken out."""
        of_images = [*self.model.doubtful.values(), *self.model.taken_out.values()]
        return list(itertools.chain.from_iterable(of_images))

    @property
    def moves(self) -> bool:
        """Whether something moves between the photographs of the model."""
        of_images = [*self.model.doubtful.values(), *self.model.unsure.values()]
        doubts = itertools.chain.from_iterable(of_images)
        return any(doubt.code == "something_moves" for doubt in doubts)

    @property
    def is_contradicted(self) -> bool:
        """Whether the points of the model contradict a given principal point."""
        return bool(self.model.principal_point_contradictions)

    def has_doubt(self, codes: Collection[DoubtCode]) -> bool:
        """Return whether an image is doubted for one of some reasons."""
        return any(doubt.code in codes for doubt in self.doubts)

    @property
    def inputs(self) -> Inputs | None:
        """The photographs; None for the database of another program."""
        return None if self.context.workspace.is_foreign else self.context.inputs

    @property
    def may_change_cameras(self) -> bool:
        """Whether cameras are not taken from a database or a list."""
        inputs = self.inputs
        return bool(
            inputs and not (inputs.from_database or inputs.cameras.cameras_path)
        )


def advice(
    context: Context,
    missing: Collection[str],
    models: Sequence[ModelSummary],
    strongest: int,
    untried: Sequence[MatchedAgain] = (),
    effort: EffortName = "high",
) -> tuple[Advice, ...]:
    """Say what may help when images are missing or the largest model is doubtful, best first.

    Args:
        context: folder, photographs and options on record.
        missing: names of the images that are not in the largest model.
        models: what is known of the models, the largest first.
        strongest: the largest number of inliers of a verified pair.
        untried: what a greater effort would try.
        effort: how much was tried.

    Returns:
        What may help, the most promising first.
    """
    num_keypoints = context.graph.num_keypoints
    lost = [
        n for n in missing if n in num_keypoints and n not in context.by_hand.left_out
    ]
    num_usable = sum(map(bool, num_keypoints.values()))
    case = _Case(context, lost, len(num_keypoints), models, strongest, untried, effort)
    if (missing or case.doubts) and num_usable < 2:
        return (
            Advice(
                "more photographs: two that can be read and show the same make a model"
            ),
        )
    found = _of_effort(case)
    if not models and strongest >= ENOUGH:
        return (*found, Advice(_why_no_model(context)))
    if lost or case.doubts or case.moves or case.is_contradicted:
        for rule in RULES:
            found += rule(case)
    return tuple(found)


def command_with_tie_points(context: Context) -> str:
    """Return the command of a run with tie points that were marked on its page."""
    return _again(context, "--tie-points", "tie-points.csv")


def command_with_masks(context: Context) -> str:
    """Return a command that runs anew with masks that were painted on the page of a run."""
    return _anew(context, "--mask-path", "masks")


def _why_no_model(context: Context) -> str:
    """Return what photographs lack whose pairs make no model, though one has enough inliers."""
    if not _any_shows_depth(context):
        return "more photographs, from other places: the matches of these show no depth"
    thrown_away = read_thrown_away(context.workspace.sparse)
    doubts = itertools.chain.from_iterable(thrown_away.doubts.values())
    codes = {doubt.code for doubt in doubts}
    why = "contradict each other"
    if codes and codes.isdisjoint(CONTRADICTED):
        why = "too few agree on one model"
    return f"more photographs between these: matches show depth, but {why}"


def _any_shows_depth(context: Context) -> bool:
    """Tell whether the inliers of one of the strongest pairs show depth."""
    inliers = context.graph.inliers(ENOUGH)
    strongest = sorted(inliers, key=lambda pair: -len(inliers[pair]))
    for names in strongest[:NUM_STRONGEST]:
        if _pair_shows_depth(context, names, inliers[names]):
            return True
    return False


def _pair_shows_depth(context: Context, names: Pair, inliers: Indices) -> bool:
    """Tell whether the inliers of a pair show depth.

    Args:
        context: Of the workspace.
        names: Of both photographs.
        inliers: (M, 2) keypoints.
    """
    points = []
    sides = []
    with context.graph.open_to_read() as database:
        for side, name in enumerate(names):
            keypoints = database.read_keypoints(context.graph.ids[name])
            rows = inliers[:, side]
            points.append(np.asarray(keypoints, np.float64)[rows, :2])
            camera = context.graph.cameras[name]
            sides += [camera.width, camera.height]
    return shows_depth(points[0], points[1], MAX_ERROR * max(sides))


def shows_depth(points1: Array, points2: Array, max_error_px: float) -> bool:
    """Tell whether inliers of a pair show depth, beyond their noise.

    A homography explains those of a plane, and of a camera that turned, whatever its focal length
    and its optical axis. Depth is shown by as many others as would make a pair by themselves, and
    more than chance leaves.

    Args:
        points1: (N, 2) px of inliers in one photograph.
        points2: (N, 2) px in the other one.
        max_error_px: Largest error of what a homography explains.

    Returns:
        Whether they do.
    """
    _, is_explained = cv2.findHomography(points1, points2, cv2.RANSAC, max_error_px)
    num_explained = 0 if is_explained is None else int(np.sum(is_explained))
    num_others = len(points1) - num_explained
    return num_others >= max(MIN_NUM_MATCHES, MAX_BY_CHANCE * len(points1))


def _of_fitting_focal(case: _Case) -> list[Advice]:
    contradicted = [
        doubt for doubt in case.doubts if doubt.code == "focal_contradicted"
    ]
    if not (case.may_change_cameras and contradicted):
        return []
    fitting_px = f"{contradicted[0].values['fitting_px']:.0f}"
    why = f"the given focal length does not fit, {fitting_px} px does"
    return [Advice(why, _anew(case.context, "--focal-length-px", fitting_px))]


def _of_principal_point(case: _Case) -> list[Advice]:
    """Return the command without given principal points that the points contradict."""
    contradictions = case.model.principal_point_contradictions
    inputs = case.inputs
    if not (inputs and contradictions):
        return []
    context = case.context
    fitting_px = ",".join(f"{part:.0f}" for part in contradictions[0].fitting_px)
    why = f"the given principal point does not fit, about {fitting_px} px does"
    cameras = inputs.cameras
    if inputs.from_database:
        return [Advice(f"{why}: correct it in {inputs.from_database}", _anew(context))]
    if cameras.cameras_path:
        return [Advice(f"{why}: correct it in {cameras.cameras_path}", _anew(context))]
    if not cameras.params:
        free = _anew(context, without=["--principal-point"])
        return [Advice(f"{why}; without it mapping finds it", free)]
    # Parameters say all of a camera; what they say of the focal length may be right.
    focal_px = read_given_cameras(cameras)[""].mean_focal_px
    focal = ["--focal-length-px", f"{focal_px:g}"]
    free = _anew(context, *focal, without=["--camera-params"])
    return [Advice(f"{why}; with the focal length alone mapping finds it", free)]


def _of_other_recipe(case: _Case) -> list[Advice]:
    model = case.model
    helped = case.lost or [
        n for n in model.doubtful if model.gains.get(n, 0.0) >= MIN_GAIN
    ]
    return _of_recipe(case.context, such_as(helped)) if helped else []


def _of_tie_points(case: _Case) -> list[Advice]:
    context = case.context
    is_ours = context.mapping.name == MAPPERS.default
    if not (case.lost and len(case.model.likely) > 1 and is_ours):
        return []
    table = context.by_hand.tie_points_path
    why = f"mark six points or more of {such_as(case.lost)}"
    why += " in two photographs of the model too, at Tie points by hand in report.html"
    if len(case.models) > 1:
        why += "; seven, each in two photographs of both, join two models"
    if table and not any(model.tie_points for model in case.models):
        why = f"no point of {table.name} is seen by two photographs of one model: {why}"
    return [
        Advice(why, _again(context, "--tie-points", str(table or "tie-points.csv")))
    ]


def _of_bridges(case: _Case) -> list[Advice]:
    found = list[Advice]()
    for name, bridge in case.model.bridges.items():
        codes = {doubt.code for doubt in case.model.doubtful.get(name, ())}
        if not codes.isdisjoint(CONTRADICTED):
            why = f"if the matches of {name} and {bridge.by} are wrong by eye, leave them out"
            command = _again(case.context, "--reject-pair", as_row([name, bridge.by]))
            found.append(Advice(why, command))
    return found


def _of_unknown_focal(case: _Case) -> list[Advice]:
    if not (case.may_change_cameras and case.has_doubt(["focal_unknown"])):
        return []
    why = "give lens and film, plate or sensor if you know them: a guess misleads"
    return [
        Advice(why, _anew(case.context, "--focal-mm", "50", "--film-width-mm", "36"))
    ]


def _of_masks(case: _Case) -> list[Advice]:
    inputs = case.inputs
    if not (inputs and inputs.masks == MaskOptions()):
        return []
    if not (case.moves or case.has_doubt(CONTRADICTED)):
        return []
    why = "mask what moves, repeats or is written on photographs (black, in a folder masks)"
    return [Advice(why, _anew(case.context, "--mask-path", "masks"))]


def _of_more_photographs(case: _Case) -> list[Advice]:
    if not case.lost:
        return []
    if len(case.lost) == case.num_images:
        return [Advice("more photographs, from places between those of these")]
    return [Advice(f"more photographs, between {such_as(case.lost)} and the others")]


RULES: Sequence[Callable[[_Case], list[Advice]]] = (
    _of_fitting_focal,
    _of_principal_point,
    _of_other_recipe,
    _of_tie_points,
    _of_bridges,
    _of_unknown_focal,
    _of_masks,
    _of_more_photographs,
)


def _of_effort(case: _Case) -> list[Advice]:
    """Return the command that tries what the effort did not allow."""
    context = case.context
    if not case.untried or case.effort == EFFORT_NAMES[-1]:
        return []
    minutes = sum(one.core_s for one in case.untried) / available_cores() / 60
    levels = ", ".join(one.text() for one in case.untried)
    why = f"more matching, at most about {max(1, round(minutes))} min: {levels}"
    greater = EFFORT_NAMES[EFFORT_NAMES.index(case.effort) + 1]
    if context.command[1:2] != ("run",):
        return [
            Advice(f"{why}; give the command of the run again, with --effort {greater}")
        ]
    command = _without(context.command, ["--max-time"])
    if len(command) == len(context.command):  # the effort was used up
        command = [*_without(command, ["--effort"]), "--effort", greater]
    return [Advice(why, shlex.join(command))]


def _of_recipe(context: Context, names: str) -> list[Advice]:
    workspace = context.workspace
    if workspace.is_foreign:
        command = _anew(context, "--from-database", str(workspace.database))
        return [Advice("make new features for its images", command)]
    if workspace.recipe() != STRONGEST:
        why = f"recipe {STRONGEST} tries more for {names}"
        return [Advice(why, _anew(context, "--recipe", STRONGEST))]
    commands = context.resources.commands_to_complete(context.extraction)
    if not commands:
        return []
    why = f"learned matching, where light or age differ, may tie {names}"
    return [Advice(why, f"{commands[0]} && {_again(context)}")]


def _again(context: Context, *words: str) -> str:
    """Return the same command with more words, if it does not have them."""
    path = str(context.workspace.path)
    base = context.command or ("colmap-affrect", "map", "--output-path", path)
    more = [] if {*words} <= {*base} else words
    return shlex.join([*base, *more])


def _without(command: Sequence[str], flags: Collection[str]) -> list[str]:
    """Leave out flags and their values."""
    kept = list[str]()
    before = ""
    for word in command:
        if not {before, word.partition("=")[0]} & {*flags}:
            kept.append(word)
        before = word
    return kept


def _anew(context: Context, *words: str, without: Collection[str] = ()) -> str:
    """Return a command for other options, which take the place of those that were given.

    Args:
        context: has the command that was given.
        words: flags with their values.
        without: flags that are left out with their values.

    Returns:
        The command, with a new output folder.
    """
    path = context.workspace.path
    numbered = (
        path.with_name(f"{path.name}-{number}") for number in itertools.count(2)
    )
    new = (
        *words,
        "--output-path",
        str(next(place for place in numbered if not place.exists())),
    )
    kept = _without(_run_command(context), [*new[::2], *without])
    return shlex.join([*kept, *new])


def _run_command(context: Context) -> Sequence[str]:
    """Return the words of the command that ran all stages, or the usual ones."""
    if context.command[1:2] == ("run",):
        return context.command
    workspace = context.workspace
    photos = str(workspace.photographs() or Path("photos"))
    output = str(workspace.path)
    return ("colmap-affrect", "run", "--image-path", photos, "--output-path", output)
