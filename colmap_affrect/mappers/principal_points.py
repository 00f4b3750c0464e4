"""Models whose principal points are not in the middle of their images.

Prints are cut off centre, and view cameras shift their lens. A model with constant principal points
makes up for that by wrong rotations, focal lengths and above all distortion, which keeps it where
it is once the principal points are free. So lenses are taken for straight at first. Made-up prints
with known cameras are within 0.2 to 3 degrees then, where freeing the principal points alone
leaves them off by 4 to 8 (``tests/benchmarks/prints.py``).
"""

import math
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers.adjustment import MEDIUM
from colmap_affrect.mappers.camera_priors import (
    CameraPrior,
    PrincipalPointPrior,
    has_free_center,
    shifted_principal_point,
    usual_principal_point,
)
from colmap_affrect.mappers.distortion import straighten
from colmap_affrect.mappers.focal_observability import with_fewer_points
from colmap_affrect.mappers.other_cameras import median_changes
from colmap_affrect.mappers.pair_graph import PairGraph, used_cameras
from colmap_affrect.mappers.search import Search


def with_free_principal_points(
    search: Search, records: Mapping[int, CameraRecord]
) -> Search | None:
    """Return a search in which principal points that nobody knows are free.

    Of cameras that several images share they stay in the middle: these are not prints, or not all
    of them are cut in the same way.

    Args:
        search: The same with principal points that are constant.
        records: What is on record of the cameras, by camera id.

    Returns:
        The search, None where all principal points are known.
    """
    cameras = search.graph.cameras.values()
    num_images = Counter(camera.camera_id for camera in cameras)
    priors = dict(search.adjuster.priors)
    for camera in cameras:
        key = camera.camera_id
        is_own = num_images[key] == 1
        is_constant = priors[key].principal_point is None
        is_unknown = not priors[key].has_prior_focal_length and has_free_center(
            camera, records.get(key)
        )
        if is_own and is_constant and is_unknown:
            principal_point = shifted_principal_point(camera)
            priors[key] = replace(priors[key], principal_point=principal_point)
    if priors == search.adjuster.priors:
        return None
    return _with_priors(search, priors)


@dataclass(frozen=True)
class FreedomGains:
    """How much lower the cost of a model is with free principal points, in nats.

    What it is compared with is the cost with principal points as near to the middle as those of
    whole photographs are: hardly one is exactly there. View cameras shift up and down, which is one
    parameter each, crops have two.
    """

    by_shifts: float
    by_crops: float
    num_freed: int  # principal points
    num_observations: int

    @property
    def contradict_constant(self) -> bool:
        """Whether the points say that constant principal points are wrong.

        The gain is more than free parameters are worth (BIC: Schwarz, Estimating the dimension of a
        model, 1978), half the logarithm of the number of observations each. Of made-up prints the
        cost is lower by 65 to 115, more than twice what is needed, of whole photographs by 0 to 9,
        at most a third of it; held in the very middle these would cost up to 62 more than free.
        """
        return self._exceed(0.5 * math.log(max(self.num_observations, 1)))

    @property
    def leave_constant_open(self) -> bool:
        """Whether the points do not say that constant principal points are right.

        Free ones predict better (AIC: Akaike, A new look at the statistical model identification,
        1974): the gain is more than one nat a parameter. Of whole photographs of facades it is
        less; of statues and toys, which hold cameras loosely, crops and whole ones have more.
        """
        return self._exceed(1.0)

    def _exceed(self, per_parameter: float) -> bool:
        """Tell whether one of the gains is more than its parameters cost."""
        per_shift = per_parameter * self.num_freed
        return self.by_shifts > per_shift or self.by_crops > 2.0 * per_shift


def gains_of_freedom(
    model: pycolmap.Reconstruction, constant: Search, free: Search
) -> FreedomGains:
    """Return how much the cost of a model falls with free principal points.

    A lens that distortion has trapped is no sign: all adjustments also begin with a straight one.

    Args:
        model: With constant principal points; it stays as it is.
        constant: The search that made it.
        free: The search with free principal points.
    """
    num_observations = with_fewer_points(model).compute_num_observations()
    freed = _freed(model, constant, free).keys()
    if not num_observations or not freed:
        return FreedomGains(0.0, 0.0, 0, 0)
    whole_cost = min(_near_the_middle(free, freed).costs_of_starts(model))
    by_crops = whole_cost - min(free.costs_of_starts(model))
    by_shifts = by_crops  # crops are shifted by no less, so that this is its limit
    if by_crops > len(freed):  # else neither says anything
        shifts = _only_up_and_down(free, freed)
        by_shifts = whole_cost - min(shifts.costs_of_starts(model))
    return FreedomGains(
        by_shifts=by_shifts,
        by_crops=by_crops,
        num_freed=len(freed),
        num_observations=num_observations,
    )


def _near_the_middle(free: Search, freed: Set[int]) -> Search:
    """Return a search in which some principal points are as near to the middle as usual.

    Args:
        free: The search with free principal points.
        freed: Ids of the cameras that are taken for those of whole photographs.
    """
    priors = dict(free.adjuster.priors)
    for camera in free.graph.cameras.values():
        key = camera.camera_id
        if key in freed:
            whole = usual_principal_point(camera)
            priors[key] = replace(priors[key], principal_point=whole)
    return _with_priors(free, priors)


def _only_up_and_down(free: Search, freed: Set[int]) -> Search:
    """Return a search in which some principal points are as near to the middle across as usual.

    Args:
        free: The search with free principal points.
        freed: Ids of the cameras that are taken for view cameras.
    """
    priors = dict(free.adjuster.priors)
    for camera in free.graph.cameras.values():
        key = camera.camera_id
        if key in freed:
            across_px, _ = usual_principal_point(camera).sigmas_px
            crop = shifted_principal_point(camera)
            _, down_px = crop.sigmas_px
            shift = replace(crop, sigmas_px=(across_px, down_px))
            priors[key] = replace(priors[key], principal_point=shift)
    return _with_priors(free, priors)


def with_shifted_axes(
    model: pycolmap.Reconstruction, free: Search, graph: PairGraph
) -> pycolmap.Reconstruction:
    """Return a model with free principal points, whose lenses bend where that scores higher.

    Args:
        model: With constant principal points; it stays as it is.
        free: The search with free principal points.
        graph: Pairs that the model is made from.
    """
    priors = dict[int, CameraPrior]()
    for key, prior in free.adjuster.priors.items():
        has_distortion = prior.has_distortion and prior.has_prior_focal_length
        priors[key] = replace(prior, has_distortion=has_distortion)
    straight = _with_priors(free, priors)
    begun = pycolmap.Reconstruction(model)
    straighten(begun, free.adjuster.priors)
    changed = straight.grower(graph).remake(begun, MEDIUM)
    bent = free.grower(graph).remake(changed)
    return max(changed, bent, key=free.scorer.score)


def axis_turns_deg(
    model: pycolmap.Reconstruction, free: Search, graph: PairGraph
) -> dict[str, float]:
    """Return how far rotations change where principal points are freed in a model as it is.

    Args:
        model: With constant principal points; it stays as it is.
        free: The search with free principal points.
        graph: Pairs that the model is made from.

    Returns:
        By image name the median change of its rotations to the others, in degrees.
    """
    return median_turns_deg(model, free.grower(graph).remake(model))


def median_turns_deg(
    model: pycolmap.Reconstruction, changed: pycolmap.Reconstruction
) -> dict[str, float]:
    """Return by how much the rotations of a model differ from those of a changed one.

    Args:
        model: The model.
        changed: The same images, with other cameras.

    Returns:
        By image name the median change of its rotations to the others, in degrees.
    """
    before = _rotations(model)
    after = _rotations(changed)

    def turn_deg(first: int, second: int) -> float:
        old = before[second] * before[first].inverse()
        new = after[second] * after[first].inverse()
        return math.degrees((new * old.inverse()).angle())

    return median_changes(model, before.keys() & after.keys(), turn_deg)


def _rotations(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Rotation3d]:
    """Return cam_from_world of the registered images, by image id."""
    found = {}
    for image_id in model.reg_image_ids():
        found[image_id] = model.images[image_id].cam_from_world().rotation
    return found


def freed_principal_point_cost(
    model: pycolmap.Reconstruction, constant: Search, free: Search
) -> float:
    """Return how much those principal points cost that were freed, in nats.

    Args:
        model: With free principal points.
        constant: The search in which they were constant.
        free: The search that made the model.
    """
    total = 0.0
    cameras = used_cameras(model)
    for key, prior in _freed(model, constant, free).items():
        camera = cameras[key]
        total += prior.cost(camera.principal_point_x, camera.principal_point_y)
    return total


def _freed(
    model: pycolmap.Reconstruction, constant: Search, free: Search
) -> dict[int, PrincipalPointPrior]:
    """Return the priors of the principal points that one search holds and the other frees."""
    found = dict[int, PrincipalPointPrior]()
    for key in used_cameras(model):
        prior = free.adjuster.priors[key].principal_point
        was_constant = constant.adjuster.priors[key].principal_point is None
        if prior is not None and was_constant:
            found[key] = prior
    return found


def _with_priors(search: Search, priors: Mapping[int, CameraPrior]) -> Search:
    """Return a search that adjusts and scores with other priors of cameras."""
    return replace(
        search,
        adjuster=replace(search.adjuster, priors=priors),
        scorer=replace(search.scorer, priors=priors),
    )
