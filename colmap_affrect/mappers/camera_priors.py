"""What is known of cameras before mapping: focal length, principal point, distortion.

The logarithm of a focal length is normal, and so is the principal point. What the user gives is
constant. EXIF, the straight lines of photographs (:mod:`colmap_affrect.geometry.lines`) and lenses
as they usually are say the rest, each as a distribution; their product is the prior. Adjustments
(:mod:`colmap_affrect.mappers.adjustment`) and scores (:mod:`colmap_affrect.mappers.model_score`)
use the same one.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import EXIF_SOURCES, TRUSTED, CameraRecord
from colmap_affrect.geometry import lines as line_model
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.lines import (
    KNOWN_SIGMA,
    MIDDLE_SIGMA,
    SHIFTED_SIGMA,
    LineCamera,
)

# The usual focal length and its deviation are those of lenses of 25 to 70 mm on 35 mm film; the
# deviation by EXIF covers rounding and the distance of focus.
USUAL_FOCAL = 1.15  # longer sides of the image, the median; theory
USUAL_SIGMA = 0.4  # of the logarithm of an uncalibrated focal length; theory
EXIF_SIGMA = 0.08  # of the logarithm of a focal length by EXIF; theory
LINES_SIGMA = 0.1
"""Least deviation of the logarithm of a focal length by lines: pairs know it better, and lines of
one building err together (judged)."""
LYING_LINES = 0.1  # share of photographs whose lines say something else than they seem to (judged)
CROP_SIGMA = 0.2
"""Of the logarithm of the focal length of a crop, around that of the whole photograph in px: some
crops were enlarged or shrunk, too (judged)."""
# Of each distortion coefficient, judged on lenses that are no fisheyes
DISTORTION_SIGMA = 0.07
SHIFTED_SHARE = 0.2  # of the photographs of which nothing is known (judged)
NO_SHARE = 1e-9  # of measurements that are false; numeric
# Of the logarithm of a focal length of which nothing is expected; theory
WIDE_SIGMA = 1.0
# Of that of usual lenses, below which lines say nothing: so much is lost by their grid; numeric
NO_PRECISION = 0.05
MIN_FOCAL_PX = 1e-9  # whose logarithm is taken, or which is divided by; numeric
SAME_PX = 1e-3  # to which two principal points are the same; numeric
# By which EXIF and lines may differ before they contradict each other; theory
MAX_DEVIATIONS = 2.5
ZOOMS = 1.0, 1.4, 0.7, 2.0
"""Factors of the usual focal length near which unknown ones begin (theory): all lenses from wide to
long are within a fifth of one of them. Where lines tell more, starts are nearer to each other."""
LOG_FOCALS: Array = np.linspace(math.log(0.05), math.log(50.0), 1401)
"""Grid of the logarithms of focal lengths in longer sides, on which distributions are combined;
numeric."""


@dataclass(frozen=True)
class LogNormal:
    """A distribution of focal lengths."""

    focal: float  # median, longer sides or px
    sigma: float  # standard deviation of the logarithm

    def log_densities(self, log_focals: Array) -> Array:
        """Return the logarithms of the densities of logarithms of focal lengths."""
        deviations = (log_focals - math.log(self.focal)) / self.sigma
        return np.asarray(-0.5 * deviations**2 - math.log(self.sigma))

    def log_density(self, focal: float) -> float:
        """Return the same of one focal length."""
        return float(self.log_densities(np.log(focal)))


@dataclass(frozen=True)
class Normal:
    """A distribution of the distance of a principal point from the middle, longer sides."""

    mean: float
    sigma: float

    def likelihood(self, sigma: float) -> float:
        """Return how likely this was measured of something near 0, but for a constant."""
        variance = self.sigma**2 + sigma**2
        return math.exp(-0.5 * self.mean**2 / variance) / math.sqrt(variance)


USUAL = LogNormal(USUAL_FOCAL, USUAL_SIGMA)


@dataclass(frozen=True)
class Measurement:
    """What something says of a focal length, and how likely it says something false."""

    focal: LogNormal  # longer sides
    false_share: float


@dataclass(frozen=True)
class PrincipalPointPrior:
    """What is known of a principal point that is not constant."""

    center_px: tuple[float, float]
    sigmas_px: tuple[float, float]

    def cost(self, x_px: float, y_px: float) -> float:
        """Return how much a principal point costs, in nats."""
        across = (x_px - self.center_px[0]) / self.sigmas_px[0]
        down = (y_px - self.center_px[1]) / self.sigmas_px[1]
        return 0.5 * (across**2 + down**2)


@dataclass(frozen=True)
class CameraPrior:
    """What is known of the intrinsics of a camera."""

    focal_px: float  # median of the focal length
    sigma: float  # standard deviation of its logarithm; 0 where it is constant
    principal_point: PrincipalPointPrior | None = None  # None where it is constant
    has_distortion: bool = True  # whether distortion is refined; else it stays as it is
    given_starts_px: tuple[float, ...] = field(default=(), compare=False)
    """Focal lengths near which models begin, the likeliest first; the median alone where empty."""

    @property
    def starts_px(self) -> tuple[float, ...]:
        """Focal lengths near which models begin, the likeliest first; one at least."""
        return self.given_starts_px or (self.focal_px,)

    @property
    def has_prior_focal_length(self) -> bool:
        """Whether the user or EXIF tells the focal length, as COLMAP says of cameras."""
        return self.sigma <= EXIF_SIGMA

    def cost(self, focal_px: float) -> float:
        """Return how much a focal length costs, in nats."""
        if not self.sigma:
            return 0.0
        log_ratio = math.log(max(focal_px, MIN_FOCAL_PX) / self.focal_px)
        return 0.5 * (log_ratio / self.sigma) ** 2

    def cost_of(self, camera: pycolmap.Camera) -> float:
        """Return how much focal length and principal point of a camera cost, in nats."""
        cost = self.cost(camera.mean_focal_length())
        if self.principal_point:
            cost += self.principal_point.cost(
                camera.principal_point_x, camera.principal_point_y
            )
        return cost


def with_distortion_of(
    priors: Mapping[int, CameraPrior], cameras: Iterable[pycolmap.Camera]
) -> dict[int, CameraPrior]:
    """Return the priors of the cameras of a model, whose distortion is constant where that was.

    Args:
        priors: By camera id.
        cameras: Of the model.
    """
    undistorted = {camera.camera_id for camera in cameras if camera.is_undistorted()}
    found = {}
    for key, prior in priors.items():
        has_distortion = prior.has_prior_focal_length or key not in undistorted
        found[key] = replace(prior, has_distortion=has_distortion)
    return found


@dataclass(frozen=True)
class FocalContradiction:
    """A focal length of the user or of EXIF that the lines of photographs contradict."""

    names: tuple[str, ...]  # of the images
    source: str  # who says it, as in CameraRecord
    said_px: float
    lines_px: float
    lines_sigma: float  # of the logarithm


def combined(usual: LogNormal, measurements: Iterable[Measurement]) -> LogNormal:
    """Combine what is usual with measurements, each of which may be false.

    A false measurement says nothing: its likelihood is then what is usual.

    Args:
        usual: The distribution before anything was measured, longer sides.
        measurements: Independent ones.

    Returns:
        The distribution with mean and deviation of the product.
    """
    logs = usual.log_densities(LOG_FOCALS)
    for measured in measurements:
        densities = measured.focal.log_densities(LOG_FOCALS)
        if_right = math.log(1.0 - measured.false_share) + densities
        if_false = math.log(measured.false_share) + USUAL.log_densities(LOG_FOCALS)
        logs = logs + np.logaddexp(if_right, if_false)
    chances = np.exp(logs - logs.max())
    chances /= chances.sum()
    mean = float(chances @ LOG_FOCALS)
    variance = float(chances @ (LOG_FOCALS - mean) ** 2)
    return LogNormal(math.exp(mean), math.sqrt(variance))


def measurement_of_lines(camera: LineCamera) -> Measurement | None:
    """Return what lines alone say of a focal length, None where that is nothing.

    A :class:`LineCamera` has been multiplied with what is usual, which is divided out here.
    """
    usual_precision = line_model.USUAL_FOCAL_SIGMA**-2
    precision = camera.focal_sigma**-2 - usual_precision
    if precision <= NO_PRECISION * usual_precision:
        return None
    weighted = math.log(camera.focal) * camera.focal_sigma**-2
    weighted -= math.log(line_model.USUAL_FOCAL) * usual_precision
    focal = LogNormal(math.exp(weighted / precision), precision**-0.5)
    return Measurement(focal, LYING_LINES)


def _measurements_of_lines(lines: Iterable[LineCamera]) -> list[Measurement]:
    """Return what lines of several images say of a focal length, without those that say nothing."""
    found = list[Measurement]()
    for camera in lines:
        measured = measurement_of_lines(camera)
        if measured:
            found.append(measured)
    return found


def camera_prior(
    camera: pycolmap.Camera,
    record: CameraRecord | None,
    lines: Sequence[LineCamera] = (),
) -> CameraPrior:
    """Return what is known of a camera of a database.

    Args:
        camera: The camera.
        record: What is on record of it, if anything.
        lines: What the lines of its images say.
    """
    focal_px = float(camera.mean_focal_length())
    if record and "focal" in record.given:
        return CameraPrior(focal_px, 0.0)
    is_trusted = camera.has_prior_focal_length
    if record:
        is_trusted = record.source in TRUSTED
    longer_px = max(camera.width, camera.height)
    if is_trusted:
        told = LogNormal(focal_px / longer_px, EXIF_SIGMA)
        if record and record.source in EXIF_SOURCES:
            told = _with_lines(told, lines)
        return CameraPrior(told.focal * longer_px, told.sigma)
    measurements = _measurements_of_lines(lines)
    usual = USUAL
    if record and record.uncropped_px:
        usual = LogNormal(record.uncropped_px / longer_px, CROP_SIGMA)
    focal = combined(usual, measurements) if measurements else usual
    focal = LogNormal(focal.focal * longer_px, max(focal.sigma, LINES_SIGMA))
    return CameraPrior(
        focal_px=focal.focal,
        sigma=focal.sigma,
        principal_point=_principal_point(camera, record, lines),
        given_starts_px=_starts(focal),
    )


def _with_lines(by_exif: LogNormal, lines: Sequence[LineCamera]) -> LogNormal:
    """Combine the focal length by EXIF with what lines measure, where these do not contradict it.

    A tenth of all lines mislead, the likelier the further they are from EXIF: then EXIF alone
    counts. The result has the mean and deviation of both cases together.

    Args:
        by_exif: In longer sides.
        lines: What the lines of the images of a camera say.
    """
    by_lines = _focal_by_lines(lines)
    if by_lines is None or _contradict(by_exif, by_lines):
        return by_exif
    lines_variance = max(by_lines.sigma, LINES_SIGMA) ** 2
    exif_variance = by_exif.sigma**2
    both_sigma = math.sqrt(exif_variance + lines_variance)
    told = LogNormal(by_exif.focal, both_sigma).log_density(by_lines.focal)
    usual_sigma = math.sqrt(USUAL_SIGMA**2 + lines_variance)
    by_chance = LogNormal(USUAL_FOCAL, usual_sigma).log_density(by_lines.focal)
    odds = (1.0 - LYING_LINES) / LYING_LINES * math.exp(told - by_chance)
    right = odds / (1.0 + odds)
    weight = exif_variance / (exif_variance + lines_variance)
    moved = weight * math.log(by_lines.focal / by_exif.focal)  # if lines are right
    variance = exif_variance * (1.0 - right * weight)
    variance += right * (1.0 - right) * moved**2
    # Lines that are in doubt make nobody less sure of EXIF.
    sigma = min(math.sqrt(variance), by_exif.sigma)
    return LogNormal(by_exif.focal * math.exp(right * moved), sigma)


def _contradict(by_exif: LogNormal, by_lines: LogNormal) -> bool:
    """Tell whether lines that know a focal length differ by more than both may be wrong."""
    difference = math.log(by_exif.focal / by_lines.focal)
    tolerated = MAX_DEVIATIONS * math.hypot(by_lines.sigma, by_exif.sigma)
    return by_lines.sigma < KNOWN_SIGMA and abs(difference) > tolerated


def _starts(focal_px: LogNormal) -> tuple[float, ...]:
    """Return the focal lengths near which models begin, the likeliest first."""
    zooms = ZOOMS if focal_px.sigma > KNOWN_SIGMA else ZOOMS[:1]
    narrower = focal_px.sigma / USUAL_SIGMA
    return tuple(focal_px.focal * zoom**narrower for zoom in zooms)


def _principal_point(
    camera: pycolmap.Camera, record: CameraRecord | None, lines: Sequence[LineCamera]
) -> PrincipalPointPrior | None:
    """Return what is known of a principal point, None where it is constant.

    It is free in crops, where lines tell that it is not in the middle, and where mapping has found
    that (:mod:`colmap_affrect.mappers.principal_points`).
    """
    if record is None or not has_free_center(camera, record):
        return None
    longer_px = max(camera.width, camera.height)
    is_crop = bool(record.uncropped_px)
    across_sigma = SHIFTED_SIGMA if is_crop else MIDDLE_SIGMA
    down = _shift(lines)
    if down is None and not is_crop:
        return shifted_principal_point(camera) if is_off_center(camera) else None
    if down is None:
        down = Normal(0.0, SHIFTED_SIGMA)
    return PrincipalPointPrior(
        (camera.width / 2.0, camera.height / 2.0 + down.mean * longer_px),
        (across_sigma * longer_px, down.sigma * longer_px),
    )


def has_free_center(camera: pycolmap.Camera, record: CameraRecord | None) -> bool:
    """Tell whether a camera has a principal point that the user has not given.

    Args:
        camera: The camera.
        record: What is on record of it; of cameras without one nobody knows what was given.
    """
    if record is None or "principal-point" in record.given:
        return False
    return len(camera.principal_point_idxs()) > 0


def is_off_center(camera: pycolmap.Camera) -> bool:
    """Tell whether a principal point is not in the middle of the image, where all begin."""
    return (
        abs(camera.principal_point_x - camera.width / 2.0) > SAME_PX
        or abs(camera.principal_point_y - camera.height / 2.0) > SAME_PX
    )


def shifted_principal_point(camera: pycolmap.Camera) -> PrincipalPointPrior:
    """Return what is known of the principal point of a print, or of a view camera."""
    return _around_middle(camera, SHIFTED_SIGMA)


def usual_principal_point(camera: pycolmap.Camera) -> PrincipalPointPrior:
    """Return what is known of the principal point of a whole photograph."""
    return _around_middle(camera, MIDDLE_SIGMA)


def _around_middle(camera: pycolmap.Camera, sigma: float) -> PrincipalPointPrior:
    """Return the prior of a principal point with a deviation in longer sides."""
    middle_px = (camera.width / 2.0, camera.height / 2.0)
    sigma_px = sigma * max(camera.width, camera.height)
    return PrincipalPointPrior(middle_px, (sigma_px, sigma_px))


def _shift(lines: Iterable[LineCamera]) -> Normal | None:
    """Return how far a principal point is below the middle by lines, None where it is not clear.

    It is in the middle, or that of a view camera or a crop. A :class:`LineCamera` has been
    multiplied with the prior of the latter, which is divided out here.
    """
    precision = 0.0
    weighted = 0.0
    for camera in lines:
        own_precision = camera.shift_sigma**-2 - SHIFTED_SIGMA**-2
        if own_precision > 0.0:
            precision += own_precision
            weighted += camera.shift * camera.shift_sigma**-2
    if not precision:
        return None
    measured = Normal(weighted / precision, precision**-0.5)
    odds = SHIFTED_SHARE / (1.0 - SHIFTED_SHARE)
    odds *= measured.likelihood(SHIFTED_SIGMA) / measured.likelihood(MIDDLE_SIGMA)
    if odds < 1.0:
        return None
    together = precision + SHIFTED_SIGMA**-2
    return Normal(weighted / together, together**-0.5)


def camera_priors(
    cameras: Iterable[pycolmap.Camera],
    records: Mapping[int, CameraRecord],
    lines: Mapping[str, LineCamera],
) -> dict[int, CameraPrior]:
    """Return the priors of cameras, by camera id.

    Args:
        cameras: Cameras of a database; those of many images may come as often.
        records: What is on record of them, by camera id.
        lines: What lines say, by image name.
    """
    found = dict[int, CameraPrior]()
    for camera in cameras:
        if camera.camera_id in found:
            continue
        record = records.get(camera.camera_id)
        found[camera.camera_id] = camera_prior(
            camera, record, _lines_of_images(record, lines)
        )
    return found


def _lines_of_images(
    record: CameraRecord | None, lines: Mapping[str, LineCamera]
) -> list[LineCamera]:
    """Return what the lines of the images of a camera say, of those that have some."""
    if record is None:
        return []
    return [lines[name] for name in record.names if name in lines]


def focal_contradictions(
    cameras: Iterable[pycolmap.Camera],
    records: Mapping[int, CameraRecord],
    lines: Mapping[str, LineCamera],
) -> list[FocalContradiction]:
    """Return the focal lengths of the user and of EXIF that lines contradict.

    Args:
        cameras: Cameras of a database.
        records: What is on record of them, by camera id.
        lines: What lines say, by image name.
    """
    found = list[FocalContradiction]()
    for camera in cameras:
        record = records.get(camera.camera_id)
        if record is None or record.source not in TRUSTED:
            continue
        by_lines = _focal_by_lines(_lines_of_images(record, lines))
        longer_px = max(camera.width, camera.height)
        said_px = float(camera.mean_focal_length())
        said = LogNormal(said_px / longer_px, EXIF_SIGMA)
        if by_lines and _contradict(said, by_lines):
            found.append(
                FocalContradiction(
                    names=record.names,
                    source=record.source,
                    said_px=said_px,
                    lines_px=by_lines.focal * longer_px,
                    lines_sigma=by_lines.sigma,
                )
            )
    return found


def _focal_by_lines(lines: Iterable[LineCamera]) -> LogNormal | None:
    """Return the focal length of a camera, in longer sides, as if no lines could be false.

    None where lines say nothing.
    """
    certain = list[Measurement]()
    for measured in _measurements_of_lines(lines):
        certain.append(replace(measured, false_share=NO_SHARE))
    if not certain:
        return None
    return combined(LogNormal(USUAL_FOCAL, WIDE_SIGMA), certain)
