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
from colmap_affrect.mappers.reliability_features import ReliabilityFeatures, features_of

# Shapes of the terms, judged where the share of right photographs no longer changes.
LOG_RATIO_SCALE = 3.0  # log-likelihood ratio, from which on more counts by its logarithm only
MAX_THREE_VIEW_POINTS = 300  # more points make no photograph surer
USUAL_ROTATION_RATIO = 0.5  # share of matches that a rotation may explain from any two positions
MAX_LOG_SPREAD = 0.5  # of focal lengths: farther apart they are no surer parts of others
# A bridge edge between two components may be of two scenes, found by chance among all pairs.
CHANCE_INLIERS = 35.0  # of an edge that is as likely of two scenes as of one (judged)
CHANCE_SCALE = 10.0  # inliers more that make the former less likely by a factor of e (judged)
MIN_SHARE_OF_AXIS = 1e-6  # whose logarithm is taken
MIN_LOSS = 0.7  # of the log odds: what takes less, half of the odds, is no reason to doubt
NUM_REASONS = 2  # that are said of a photograph

FOCAL_CONTRADICTED = "the given focal length does not fit"
FOCAL_UNKNOWN = "any focal length fits"
AXIS_UNKNOWN = "its optical axis may be elsewhere: a crop, or a view camera"
CONTRADICTIONS = (
    "most of its matches disagree with this position",
    "of the matches of its pairs agree with the model",
)
COEFFICIENTS = Path(__file__).with_suffix(".json")


@dataclass(frozen=True)
class Term:
    """A term of the regression."""

    value: Callable[[ReliabilityFeatures], float]  # the larger the surer
    reason: Callable[[ReliabilityFeatures], str]  # what to say where it is small


def _log_ratio(features: ReliabilityFeatures) -> float:
    """Return the log-likelihood ratio, in a logarithmic scale of its own."""
    log_ratio = features.log_likelihood_ratio
    return math.copysign(math.log1p(abs(log_ratio) / LOG_RATIO_SCALE), log_ratio)


def _log_ratio_reason(features: ReliabilityFeatures) -> str:
    if features.log_likelihood_ratio < 0.0:
        return CONTRADICTIONS[0]
    return "few matches support its position"


def _agreement(features: ReliabilityFeatures) -> float:
    return features.agreement


def _agreement_reason(features: ReliabilityFeatures) -> str:
    percent = math.floor(100.0 * features.agreement)
    return f"only {percent}% {CONTRADICTIONS[1]}"


def _three_view_points(features: ReliabilityFeatures) -> float:
    return math.log1p(min(features.num_three_view_points, MAX_THREE_VIEW_POINTS))


def _three_view_points_reason(features: ReliabilityFeatures) -> str:
    num = features.num_three_view_points
    if not num:
        return "none of its points is seen by two other photographs"
    return f"only {num} of its points are seen by two other photographs"


def _focal_observability(features: ReliabilityFeatures) -> float:
    return math.log(min(max(features.focal_growth, MIN_GROWTH), MAX_GROWTH))


def _focal_observability_reason(_: ReliabilityFeatures) -> str:
    return f"{FOCAL_UNKNOWN}, and the position of the camera depends on that"


def _given_focal(features: ReliabilityFeatures) -> float:
    return -float(features.fitting_focal_px > 0.0)


def _given_focal_reason(features: ReliabilityFeatures) -> str:
    given_px = features.focal_px
    return f"{FOCAL_CONTRADICTED}, {given_px:.0f} px: {features.fitting_focal_px:.0f} px does"


def _parallax(features: ReliabilityFeatures) -> float:
    return -max(features.pure_rotation_ratio, USUAL_ROTATION_RATIO)


def _parallax_reason(features: ReliabilityFeatures) -> str:
    ratio = features.pure_rotation_ratio
    return f"a camera that only turned explains {ratio:.0%} of the matches: no parallax"


def _mirrored_copy(features: ReliabilityFeatures) -> float:
    return -float(bool(features.mirrored_original))


def _mirrored_copy_reason(features: ReliabilityFeatures) -> str:
    return f"may be a mirrored copy of {features.mirrored_original}"


def _focal_spread(features: ReliabilityFeatures) -> float:
    return -min(math.log(features.focal_spread), MAX_LOG_SPREAD)


def _focal_spread_reason(features: ReliabilityFeatures) -> str:
    return (
        "focal lengths of photographs of its size are up to "
        f"{features.focal_spread:.2f} times apart: some may be parts of others"
    )


TERMS: Mapping[str, Term] = {  # by their names in the file of coefficients
    "log-likelihood ratio": Term(_log_ratio, _log_ratio_reason),
    "agreement": Term(_agreement, _agreement_reason),
    "three-view points": Term(_three_view_points, _three_view_points_reason),
    "focal observability": Term(_focal_observability, _focal_observability_reason),
    "given focal length": Term(_given_focal, _given_focal_reason),
    "parallax": Term(_parallax, _parallax_reason),
    "mirrored copy": Term(_mirrored_copy, _mirrored_copy_reason),
    "focal spread": Term(_focal_spread, _focal_spread_reason),
}
OF_MATCHES = {"log-likelihood ratio", "agreement", "three-view points"}  # which more may mend


@dataclass(frozen=True)
class Confidence:
    """How sure a model is of a photograph."""

    probability: float  # that its pose is right
    reason: str  # what speaks most against that, empty if nothing does
    gain: float = 0.0  # what more matches may add to the probability


@dataclass(frozen=True, order=True)
class _Loss:
    """What something takes from the log odds."""

    log_odds: float
    reason: str


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
    odds_of_two_scenes = _odds_of_two_scenes(features)
    edge = f"the {features.num_bridge_inliers} inliers of {features.bridge_edge}"
    losses = [
        _Loss(-features.tie_point_log_odds, "its tie points disagree"),
        _Loss(math.log1p(odds_of_two_scenes), f"with others it hangs on {edge} alone"),
        _Loss(-math.log(max(1.0 - features.axis_doubt, MIN_SHARE_OF_AXIS)), AXIS_UNKNOWN),
    ]
    mendable = 0.0
    for name, fitted in coefficients.terms.items():
        value = TERMS[name].value(features)
        log_odds += fitted.weight * value
        loss = _Loss(fitted.weight * (fitted.usual - value), TERMS[name].reason(features))
        losses.append(loss)
        if name in OF_MATCHES:
            mendable += max(0.0, loss.log_odds)
    probability = _probability(log_odds) / (1.0 + odds_of_two_scenes) * (1.0 - features.axis_doubt)
    return Confidence(
        probability, _main_reasons(losses), _probability(log_odds + mendable) - probability
    )


def _odds_of_two_scenes(features: ReliabilityFeatures) -> float:
    """Return the odds that a bridge edge connects two scenes, 0 where there is none."""
    if not features.bridge_edge:
        return 0.0
    return math.exp((CHANCE_INLIERS - features.num_bridge_inliers) / CHANCE_SCALE)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _main_reasons(losses: list[_Loss]) -> str:
    """Return the reasons of the largest losses, of one where none is large."""
    worst = sorted((loss for loss in losses if loss.log_odds >= MIN_LOSS), reverse=True)
    shown = worst[:NUM_REASONS] or [max(losses)]
    return "; ".join(loss.reason for loss in shown)
