"""What may help photographs that are missing or doubtful, with commands to paste."""

import itertools
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.errors import such_as
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.images.photographs import MaskOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.mappers.camera_priors import FocalContradiction
from colmap_affrect.mappers.pair_graph import MAX_ERROR, MIN_NUM_MATCHES
from colmap_affrect.mappers.wrong_models import read_thrown_away
from colmap_affrect.options import EFFORT_NAMES, EffortName
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.advised import Advice, least_work_first
from colmap_affrect.project.reasons import Doubt, DoubtCode
from colmap_affrect.project.report import MatchedAgain, ModelSummary
from colmap_affrect.project.tables import as_row
from colmap_affrect.report.pair_choice import MIN_AGREEMENT
from colmap_affrect.report.pasted_commands import (
    again,
    anew,
    with_default_mapper,
    without,
)
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.stages.map import agreements

STRONGEST = "default"  # of the recipes
ENOUGH = 100  # inliers of a pair that make a model wherever it shows depth
MAX_BY_CHANCE = 0.03
"""Share of the inliers of a pair that chance alone may put on epipolar lines and off a homography
(theory: the width of their band by that of a photograph)."""
NUM_STRONGEST = 10  # pairs that are looked at for depth; resource
MIN_GAIN = 0.05  # of a probability, by more matches
CONTRADICTED: Collection[DoubtCode] = ("matches_disagree", "little_agreement")
"""Doubts of photographs whose matches are rather wrong than few."""
OF_ANOTHER_PLACE: Collection[DoubtCode] = ("other_surroundings", "two_places")
"""Doubts of photographs that were cut from a model, to which nothing else ties them."""
GIVEN_FOCAL_FLAGS: Collection[str] = (
    "--focal-length-px",
    "--focal-mm",
    "--film-width-mm",
)


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
    contradictions: Sequence[FocalContradiction]  # of focal lengths, by lines

    @property
    def model(self) -> ModelSummary:
        """The largest model, an empty one where there is none."""
        return self.models[0] if self.models else ModelSummary((), 0, 0.0, 0.0)

    @property
    def doubts(self) -> list[Doubt]:
        """Why images are doubtful, were taken out, or were in models that are no more."""
        of_images = [*self.model.doubtful.values(), *self.model.taken_out.values()]
        of_images += self.thrown_away.values()
        return list(itertools.chain.from_iterable(of_images))

    @cached_property
    def thrown_away(self) -> Mapping[str, tuple[Doubt, ...]]:
        """Why images were in models that are surely wrong."""
        return read_thrown_away(self.context.workspace.sparse).doubts

    @cached_property
    def shows_no_depth(self) -> bool:
        """Whether there is no model though a pair has enough inliers: they show no depth."""
        if self.models or self.strongest < ENOUGH:
            return False
        return not _any_shows_depth(self.context)

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

    @property
    def is_all_unsure(self) -> bool:
        """Whether no photograph of the model is sure."""
        return bool(self.model.probabilities) and not self.model.sure

    @property
    def wants_advice(self) -> bool:
        """Whether something is missing, doubtful, contradicted, or nothing is sure."""
        reasons = (self.lost, self.doubts, self.moves, self.is_contradicted)
        return any(reasons) or self.is_all_unsure

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
    contradictions: Sequence[FocalContradiction] = (),
) -> tuple[Advice, ...]:
    """Say what may help when images are missing or the largest model is doubtful, best first.

    What takes a person no work comes first, then what takes minutes, then what takes hours. Nothing
    is advised that what is known speaks against.

    Args:
        context: folder, photographs and options on record.
        missing: names of the images that are not in the largest model.
        models: what is known of the models, the largest first.
        strongest: the largest number of inliers of a verified pair.
        untried: what a greater effort would try.
        effort: how much was tried.
        contradictions: focal lengths of EXIF or of the user that straight lines contradict.

    Returns:
        What may help, the most promising first of what takes the same work.
    """
    num_keypoints = context.graph.num_keypoints
    lost = [
        n for n in missing if n in num_keypoints and n not in context.by_hand.left_out
    ]
    num_usable = sum(map(bool, num_keypoints.values()))
    case = _Case(
        context,
        lost,
        len(num_keypoints),
        models,
        strongest,
        untried,
        effort,
        contradictions,
    )
    if (missing or case.doubts) and num_usable < 2:
        why = "more photographs: two that can be read and show the same make a model"
        return (Advice("photographs", why),)
    found = list[Advice]()
    if case.wants_advice:
        for rule in RULES:
            found += rule(case)
    # Measured: what the default effort leaves out brought nothing, see docs/troubleshooting.md
    return least_work_first([*found, *_of_effort(case)])


def command_with_tie_points(context: Context) -> str:
    """Return the command of a run with tie points that were marked on its page."""
    if context.mapping.name != MAPPERS.default:  # others take none
        return with_default_mapper(context, "--tie-points", "tie-points.csv")
    return again(context, "--tie-points", "tie-points.csv")


def command_with_masks(context: Context) -> str:
    """Return a command that runs anew with masks that were painted on the page of a run."""
    return anew(context, "--mask-path", "masks")


def _why_no_model(case: _Case) -> str:
    """Return what photographs lack whose pairs make no model, though one has enough inliers."""
    if case.shows_no_depth:
        return "more photographs, from other places: the matches of these show no depth"
    doubts = itertools.chain.from_iterable(case.thrown_away.values())
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
    command = anew(case.context, "--focal-length-px", fitting_px)
    return [Advice("focal_length", why, command)]


def _of_lines(case: _Case) -> list[Advice]:
    """Return the command without focal lengths that straight lines contradict."""
    if not (case.may_change_cameras and case.contradictions):
        return []
    names = [name for one in case.contradictions for name in one.names]
    why = f"straight lines of {such_as(names)} contradict the focal length"
    if all(one.source == "given" for one in case.contradictions):
        command = anew(case.context, leave_out=GIVEN_FOCAL_FLAGS)
        return [Advice("lines_contradict", f"{why} that was given", command)]
    if any(one.source == "given" for one in case.contradictions):
        return []
    command = anew(case.context, "--ignore-exif")
    return [Advice("lines_contradict", f"{why} of EXIF", command)]


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
    table = inputs.from_database or cameras.cameras_path
    if table:
        why += f": correct it in {table}"
        return [Advice("principal_point", why, anew(context))]
    if not cameras.params:
        why += "; without it mapping finds it"
        free = anew(context, leave_out=["--principal-point"])
        return [Advice("principal_point", why, free)]
    # Parameters say all of a camera; what they say of the focal length may be right.
    focal_px = read_given_cameras(cameras)[""].mean_focal_px
    focal = ["--focal-length-px", f"{focal_px:g}"]
    why += "; with the focal length alone mapping finds it"
    free = anew(context, *focal, leave_out=["--camera-params"])
    return [Advice("principal_point", why, free)]


def _of_mapper(case: _Case) -> list[Advice]:
    """Return the command that maps with the default mapper, which is made for few photographs."""
    name = case.context.mapping.name
    if name == MAPPERS.default or not (case.lost or case.doubts):
        return []
    why = (
        f"the default mapper, {MAPPERS.default}, may do with fewer matches than {name}"
    )
    return [Advice("mapper", why, with_default_mapper(case.context))]


def _of_other_features(case: _Case) -> list[Advice]:
    """Return the command that makes features or matches which may be better."""
    model = case.model
    helped = case.lost or [
        name for name in model.doubtful if model.gains.get(name, 0.0) >= MIN_GAIN
    ]
    context = case.context
    if not helped or case.shows_no_depth:
        return []
    workspace = context.workspace
    if workspace.is_foreign:
        command = anew(context, "--from-database", str(workspace.database))
        why = "make new features for its images"
        if not workspace.photographs():
            why += ", which are in a folder photos"
        return [Advice("features", why, command)]
    names = such_as(helped)
    if workspace.recipe() != STRONGEST:
        why = f"recipe {STRONGEST} tries more for {names}"
        return [Advice("recipe", why, anew(context, "--recipe", STRONGEST))]
    commands = context.resources.commands_to_complete(context.extraction)
    if not commands:
        return []
    why = f"learned matching, where light or age differ, may tie {names}"
    return [Advice("weights", why, f"{commands[0]} && {again(context)}")]


def _of_tie_points(case: _Case) -> list[Advice]:
    context = case.context
    is_ours = context.mapping.name == MAPPERS.default
    lost = [name for name in case.lost if not _is_of_another_place(case, name)]
    if not (lost and is_ours) or case.shows_no_depth:
        return []
    table = context.by_hand.tie_points_path
    place = "at Tie points by hand in report.html"
    if len(case.model.likely) > 1:
        why = f"mark six points or more of {such_as(lost)}"
        why += f" in two photographs of the model too, {place}"
        if len(case.models) > 1:
            why += "; seven, each in two photographs of both, join two models"
    else:
        why = "mark seven points or more in two photographs, which begin a model, and six of these "
        why += f"in others, {place}"
    if table and not any(model.tie_points for model in case.models):
        why = f"no point of {table.name} is seen by two photographs of one model: {why}"
    command = again(context, "--tie-points", str(table or "tie-points.csv"))
    return [Advice("tie_points", why, command)]


def _is_of_another_place(case: _Case, name: str) -> bool:
    """Tell whether a photograph was found to show another place than the largest model."""
    doubts = case.model.taken_out.get(name, ())
    return any(doubt.code in OF_ANOTHER_PLACE for doubt in doubts)


def _of_unknown_focal(case: _Case) -> list[Advice]:
    """Return advice without a command: a focal length that stands in one would be a guess."""
    if not (case.may_change_cameras and case.has_doubt(["focal_unknown"])):
        return []
    why = (
        "give lens and film, plate or sensor if you know them, by --focal-mm and "
        "--film-width-mm: a guess misleads"
    )
    return [Advice("lens", why)]


def _of_masks(case: _Case) -> list[Advice]:
    inputs = case.inputs
    if not (inputs and inputs.masks == MaskOptions()):
        return []
    if not (case.moves or case.has_doubt(CONTRADICTED)):
        return []
    why = "mask what moves, repeats or is written on photographs (black, in a folder masks)"
    return [Advice("masks", why, command_with_masks(case.context))]


def _of_bridges(case: _Case) -> list[Advice]:
    """Return commands without pairs that brought doubtful images in and that disagree now."""
    bridged = list[Pair]()
    for name, bridge in case.model.bridges.items():
        codes = {doubt.code for doubt in case.model.doubtful.get(name, ())}
        if not codes.isdisjoint(CONTRADICTED):
            bridged.append((name, bridge.by))
    if not bridged:
        return []
    context = case.context
    model = pycolmap.Reconstruction(context.workspace.sparse / "0")
    agreement = agreements(context.graph, model)
    found = list[Advice]()
    for name, other in bridged:
        share = agreement.get((name, other), agreement.get((other, name), 1.0))
        if share < MIN_AGREEMENT:
            why = (
                f"if the matches of {name} and {other} are wrong by eye, leave them out"
            )
            command = again(context, "--reject-pair", as_row([name, other]))
            found.append(Advice("reject_pair", why, command))
    return found


def _of_more_photographs(case: _Case) -> list[Advice]:
    """Return what helps photographs that are lost or doubtful, and models that are unsure."""
    needing = case.lost or [*case.model.doubtful]
    if not (needing or case.is_all_unsure):
        return []
    why = f"more photographs, between {such_as(needing)} and the others"
    if len(needing) in (0, case.num_images):
        why = "more photographs, from places between those of these"
    is_ours = case.context.mapping.name == MAPPERS.default  # others do not tell
    if not case.models and case.strongest >= ENOUGH and is_ours:
        why = _why_no_model(case)
    return [Advice("photographs", why)]


RULES: Sequence[Callable[[_Case], list[Advice]]] = (
    _of_fitting_focal,
    _of_lines,
    _of_principal_point,
    _of_mapper,
    _of_other_features,
    _of_tie_points,
    _of_unknown_focal,
    _of_masks,
    _of_bridges,
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
        why += f"; give the command of the run again, with --effort {greater}"
        return [Advice("effort", why)]
    command = without(context.command, ["--max-time"])
    if len(command) == len(context.command):  # the effort was used up
        command = [*without(command, ["--effort"]), "--effort", greater]
    return [Advice("effort", why, shlex.join(command))]
