"""The confidence of a model in each of its photographs.

A logistic regression makes the probability that the pose of a photograph is right of a few features
(:mod:`colmap_affrect.mappers.reliability_features`): within 5 degrees, in rotation and in direction
to at least half of the others. ``tests/benchmarks/reliability.py`` fits it on photographs whose
poses are known.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.focal_observability import MAX_GROWTH, MIN_GROWTH
from colmap_affrect.mappers.other_cameras import OtherPose, probability_of
from colmap_affrect.mappers.reliability_features import ReliabilityFeatures, features_of
from colmap_affrect.project.reasons import Doubt

# Shapes of the terms, judged where the share of right photographs no longer changes.
# Log-likelihood ratio, from which on more counts by its logarithm only
LOG_RATIO_SCALE = 3.0
MAX_THREE_VIEW_POINTS = 300  # more points make no photograph surer; judged
# Share of matches that a rotation may explain from any two positions; judged
USUAL_ROTATION_RATIO = 0.5
# Of focal lengths: farther apart they are no surer parts of others; judged
MAX_LOG_SPREAD = 0.5
# A pair that alone connects two components (a bridge of the graph) may be of two scenes, found
# by chance among all pairs.
CHANCE_INLIERS = 35.0  # of an edge that is as likely of two scenes as of one (judged)
# Inliers more that make the former less likely by a factor of e (judged)
CHANCE_SCALE = 10.0
MAX_ERROR_DEG = 5.0  # of poses that count as right, in BENCHMARKS and in the fit; paper
TINY_SHARE = 1e-9  # of a probability, whose logarithm is taken; numeric
MIN_SIGMA_DEG = 1e-3  # of directions; they are divided by; numeric
# Of the log odds: what takes less, half of the odds, is no reason to doubt; theory
MIN_LOSS = 0.7
NUM_REASONS = 2  # that are said of a photograph; display

COEFFICIENTS = Path(__file__).with_suffix(".json")


@dataclass(frozen=True)
class Term:
    """A term of the regression."""

    value: Callable[[ReliabilityFeatures], float]  # the larger the surer
    reason: Callable[[ReliabilityFeatures], Doubt]  # what to doubt where it is small


def _log_ratio(features: ReliabilityFeatures) -> float:
    """Return the log-likelihood ratio, in a logarithmic scale of its own."""
    log_ratio = features.log_likelihood_ratio
    return math.copysign(math.log1p(abs(log_ratio) / LOG_RATIO_SCALE), log_ratio)


def _log_ratio_reason(features: ReliabilityFeatures) -> Doubt:
    if features.log_likelihood_ratio < 0.0:
        return Doubt("matches_disagree")
    return Doubt("few_matches")


def _agreement_value(features: ReliabilityFeatures) -> float:
    return features.agreement


def _agreement_reason(features: ReliabilityFeatures) -> Doubt:
    return Doubt(
        "little_agreement", {"percent": math.floor(100.0 * features.agreement)}
    )


def _three_view_points(features: ReliabilityFeatures) -> float:
    return math.log1p(min(features.num_three_view_points, MAX_THREE_VIEW_POINTS))


def _three_view_points_reason(features: ReliabilityFeatures) -> Doubt:
    num = features.num_three_view_points
    if not num:
        return Doubt("no_three_view_points")
    return Doubt("few_three_view_points", {"num": num})


def _focal_observability(features: ReliabilityFeatures) -> float:
    return math.log(min(max(features.focal_growth, MIN_GROWTH), MAX_GROWTH))


def _focal_observability_reason(_: ReliabilityFeatures) -> Doubt:
    return Doubt("focal_unknown")


def _parallax(features: ReliabilityFeatures) -> float:
    return -max(features.pure_rotation_ratio, USUAL_ROTATION_RATIO)


def _parallax_reason(features: ReliabilityFeatures) -> Doubt:
    return Doubt("no_parallax", {"share": features.pure_rotation_ratio})


def _mirrored_copy(features: ReliabilityFeatures) -> float:
    return -float(bool(features.mirrored_original))


def _mirrored_copy_reason(features: ReliabilityFeatures) -> Doubt:
    return Doubt("mirrored_copy", {"original": features.mirrored_original})


def _focal_spread(features: ReliabilityFeatures) -> float:
    return -min(math.log(features.focal_spread), MAX_LOG_SPREAD)


def _focal_spread_reason(features: ReliabilityFeatures) -> Doubt:
    return Doubt("focal_spread", {"ratio": features.focal_spread})


TERMS: Mapping[str, Term] = {  # by their names in the file of coefficients
    "log-likelihood ratio": Term(_log_ratio, _log_ratio_reason),
    "agreement": Term(_agreement_value, _agreement_reason),
    "three-view points": Term(_three_view_points, _three_view_points_reason),
    "focal observability": Term(_focal_observability, _focal_observability_reason),
    "parallax": Term(_parallax, _parallax_reason),
    "mirrored copy": Term(_mirrored_copy, _mirrored_copy_reason),
    "focal spread": Term(_focal_spread, _focal_spread_reason),
}
# Which more may mend
OF_MATCHES = {"log-likelihood ratio", "agreement", "three-view points"}


@dataclass(frozen=True)
class Confidence:
    """How sure a model is of a photograph."""

    probability: float  # that its pose is right
    reasons: tuple[Doubt, ...]  # what speaks most against that
    gain: float = 0.0  # what more matches may add to the probability
    precision_factor: float = 1.0
    """Factor of the probability for what noise leaves open, which is no sign of a wrong pose."""

    @property
    def of_evidence(self) -> float:
        """Probability by what speaks for and against the pose alone."""
        return self.probability / self.precision_factor


@dataclass(frozen=True)
class _Loss:
    """What something takes from the log odds."""

    log_odds: float
    reason: Doubt


@dataclass(frozen=True)
class _FittedTerm:
    """Coefficients of a term."""

    weight: float
    usual: float  # mean value of right photographs


@dataclass(frozen=True)
class _Coefficients:
    """Coefficients of the regression."""

    constant: float
    terms: Mapping[str, _FittedTerm]


@cache
def _coefficients() -> _Coefficients:
    content = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    terms = {name: _FittedTerm(**fitted) for name, fitted in content["terms"].items()}
    return _Coefficients(content["constant"], terms)


def score_images(
    mapped: MappedModel, task: MappingTask, growths: Mapping[int, float] | None = None
) -> dict[str, Confidence]:
    """Return how sure a model is of each of its photographs.

    Args:
        mapped: The model.
        task: What it was made from.
        growths: As :func:`colmap_affrect.mappers.reliability_features.features_of` takes them.

    Returns:
        The confidence by image name.
    """
    features = features_of(mapped, task, growths)
    return {name: confidence(of_image) for name, of_image in features.items()}


def confidence(features: ReliabilityFeatures) -> Confidence:
    """Return the probability that a pose is right, and what takes most from it."""
    coefficients = _coefficients()
    log_odds = coefficients.constant + features.tie_point_log_odds
    factor = unfitted_factor(features)
    losses = _other_losses(features)
    mendable = 0.0
    for name, fitted in coefficients.terms.items():
        value = TERMS[name].value(features)
        log_odds += fitted.weight * value
        loss = _Loss(
            fitted.weight * (fitted.usual - value), TERMS[name].reason(features)
        )
        losses.append(loss)
        if name in OF_MATCHES:
            mendable += max(0.0, loss.log_odds)
    probability = probability_of(log_odds) * factor
    precision_factor = _precision_factor(features)
    with_matches = probability_of(log_odds + mendable) * precision_factor
    gain = with_matches - probability
    return Confidence(
        probability=probability,
        reasons=_main_reasons(losses),
        gain=gain,
        precision_factor=precision_factor,
    )


def unfitted_factor(features: ReliabilityFeatures) -> float:
    """Return the factor of the probability by what the regression is not fitted to.

    That is the pair which a photograph hangs on, other cameras, and what noise leaves open.
    """
    factor = _precision_factor(features) / (1.0 + _odds_of_two_scenes(features))
    factor *= _share_with_other_cameras(features.with_free_focals)
    return factor * _share_with_other_cameras(features.with_other_cameras)


def _other_losses(features: ReliabilityFeatures) -> list[_Loss]:
    """Return what is taken beside the terms of the regression."""
    losses = [_Loss(-features.tie_point_log_odds, Doubt("tie_points_disagree"))]
    if features.cut_pair:
        odds = _odds_of_two_scenes(features)
        num_inliers = features.num_cut_pair_inliers
        edge = Doubt(
            "tied_by_one_pair", {"num_inliers": num_inliers, "pair": features.cut_pair}
        )
        losses.append(_Loss(math.log1p(odds), edge))
    losses += _losses_by_other_cameras(features)
    if features.direction_sigma_deg:
        share = share_within_limit(features.direction_sigma_deg)
        near = Doubt("near_others", {"sigma_deg": features.direction_sigma_deg})
        losses.append(_Loss(-math.log(share), near))
    if features.axis_turn_deg:
        share = share_within_limit(features.axis_turn_deg)
        unclear = Doubt("principal_point_open", {"turn_deg": features.axis_turn_deg})
        losses.append(_Loss(-math.log(share), unclear))
    return losses


def _losses_by_other_cameras(features: ReliabilityFeatures) -> list[_Loss]:
    """Return what is taken as other cameras may be right."""
    doubt = Doubt("focal_unknown")
    if features.fitting_focal_px:
        given_px = features.focal_px
        values = {"given_px": given_px, "fitting_px": features.fitting_focal_px}
        doubt = Doubt("focal_contradicted", {**values})
    by_focals = _share_with_other_cameras(features.with_free_focals)
    by_others = _share_with_other_cameras(features.with_other_cameras)
    other = features.with_other_cameras
    turn = {"turn_deg": other.turn_deg}
    assumed = Doubt("cameras_differ" if other.is_shared else "camera_shared", {**turn})
    return [_Loss(-math.log(by_focals), doubt), _Loss(-math.log(by_others), assumed)]


def _share_with_other_cameras(other: OtherPose) -> float:
    """Return the probability that a pose is within the limit, by other cameras or not."""
    is_near = share_within_limit(other.turn_deg)
    return max(1.0 - other.probability * (1.0 - is_near), TINY_SHARE)


def _odds_of_two_scenes(features: ReliabilityFeatures) -> float:
    """Return the odds that the cut pair of an image is of two scenes, 0 where it has none."""
    if not features.cut_pair:
        return 0.0
    return math.exp((CHANCE_INLIERS - features.num_cut_pair_inliers) / CHANCE_SCALE)


def _precision_factor(features: ReliabilityFeatures) -> float:
    """Return the probability that what is left open moves a pose by less than the limit."""
    sigma_deg = math.hypot(features.direction_sigma_deg, features.axis_turn_deg)
    return share_within_limit(sigma_deg)


def share_within_limit(sigma_deg: float) -> float:
    """Return the probability of an error below the limit of right poses.

    Both angles of a direction are normal, with half of the variance each.
    """
    sigma_deg = max(sigma_deg, MIN_SIGMA_DEG)
    return -math.expm1(-((MAX_ERROR_DEG / sigma_deg) ** 2))


def _main_reasons(losses: list[_Loss]) -> tuple[Doubt, ...]:
    """Return the reasons of the largest losses, of one where none is large."""
    ranked = sorted(losses, key=lambda loss: -loss.log_odds)
    worst = [loss for loss in ranked[:NUM_REASONS] if loss.log_odds >= MIN_LOSS]
    return tuple(loss.reason for loss in worst or ranked[:1])
