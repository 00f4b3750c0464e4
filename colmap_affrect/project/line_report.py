"""What is stored and reported of the straight lines of a photograph."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.lines import (
    DOWN,
    FOCALS,
    MIN_NUM_SEGMENTS,
    SHIFTS,
    LineFindings,
    LineLikelihood,
    Lines,
)
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.options import documented

FILM_MM = 36.0  # longer side of small-format film, for which lenses are compared
# (N, 4) starts and ends, longer sides from the middle of the image
SEGMENTS = "line_segments"
LIKELIHOODS = "line_log_likelihoods"  # (F, S) of focal lengths and shifts
ROTATIONS = "line_rotations"  # (F, S, 3, 3)
DISTORTION = "line_distortion"  # (1,), of :meth:`Segments.undistorted`
# Of an image, beside its features
DOWNWARDS = "line_down"  # (2,), of photographs that are stored on their side
LINE_DATASETS = (SEGMENTS, LIKELIHOODS, ROTATIONS, DISTORTION, DOWNWARDS)


@documented
@dataclass(frozen=True)
class LineReport:
    """What the straight lines of a photograph say of its camera."""

    num_segments: int
    """Straight segments that were looked at, the longest."""
    is_known: bool = False
    """Whether the lines tell the focal length, with a deviation below 15 per cent."""
    focal_px: float | None = None
    """Focal length, with what is usual where lines say little; None where there are too few."""
    focal_mm: float | None = None
    """The same for film of 36 mm, of which the longer side of the photograph is the width."""
    focal_sigma: float | None = None
    """Its deviation as a share (of the logarithm)."""
    shift_px: float | None = None
    """How far below the middle of the image the optical axis is."""
    shift_sigma_px: float | None = None
    """Its deviation."""
    is_shifted: bool = False
    """Whether the lines say that the optical axis is not in the middle."""
    up: tuple[float, float, float] | None = None
    """The upright direction in the frame of the camera: x right, y down, z ahead."""
    up_sigma_deg: float | None = None
    """Its deviation; one of more than a few degrees is by chance."""

    def sentence(self) -> str:
        """Return what the lines say in a sentence."""
        if self.focal_px is None or self.focal_mm is None or self.focal_sigma is None:
            return (
                f"{self.num_segments} straight lines are too few to say anything, "
                f"{MIN_NUM_SEGMENTS} are needed"
            )
        lens = f"{self.focal_px:,.0f} px ({self.focal_mm:.0f} mm for film of 36 mm)"
        if self.is_known:
            text = (
                f"the lines tell a focal length of {lens} within {self.focal_sigma:.0%}"
            )
        else:
            text = (
                "the lines do not tell the focal length well enough: "
                f"{lens} within {self.focal_sigma:.0%}"
            )
        if self.is_shifted and self.shift_px is not None:
            side = "below" if self.shift_px > 0.0 else "above"
            text += (
                f"; the optical axis is {abs(self.shift_px):,.0f} px {side} the middle: "
                "a view camera, or a crop"
            )
        return text


def line_report(found: LineFindings, image_size: tuple[int, int]) -> LineReport:
    """Return what lines say of the camera of a photograph of (width, height) px."""
    camera = found.camera
    if camera is None:
        return LineReport(found.num_segments)
    longer_side = max(image_size)
    x, y, z = camera.up.tolist()
    return LineReport(
        num_segments=found.num_segments,
        is_known=camera.is_known,
        focal_px=camera.focal * longer_side,
        focal_mm=camera.focal * FILM_MM,
        focal_sigma=camera.focal_sigma,
        shift_px=camera.shift * longer_side,
        shift_sigma_px=camera.shift_sigma * longer_side,
        is_shifted=found.says_shifted,
        up=(x, y, z),
        up_sigma_deg=math.degrees(camera.up_sigma),
    )


def line_datasets(lines: Lines) -> dict[str, NDArray[Any]]:
    """Return what is stored of lines."""
    ends = np.hstack([lines.segments.starts, lines.segments.ends])
    datasets: dict[str, NDArray[Any]] = {SEGMENTS: ends.astype(np.float32)}
    if lines.likelihood is not None:
        datasets[LIKELIHOODS] = lines.likelihood.log_likelihoods.astype(np.float32)
        datasets[ROTATIONS] = lines.likelihood.rotations.astype(np.float32)
        datasets[DISTORTION] = np.array([lines.likelihood.distortion], np.float32)
    if lines.down != DOWN:
        datasets[DOWNWARDS] = np.array(lines.down, np.float32)
    return datasets


def lines_from_datasets(datasets: Mapping[str, NDArray[Any]]) -> Lines | None:
    """Return the lines that were stored; None where none were, or by another grid."""
    if SEGMENTS not in datasets:
        return None
    ends = datasets[SEGMENTS].astype(np.float64)
    segments = Segments(ends[:, :2], ends[:, 2:])
    right, downwards = datasets.get(DOWNWARDS, np.array(DOWN)).tolist()
    down = (right, downwards)
    if LIKELIHOODS not in datasets:
        return Lines(segments, None, down)
    log_likelihoods = datasets[LIKELIHOODS].astype(np.float64)
    if log_likelihoods.shape != (len(FOCALS), len(SHIFTS)):
        return None
    # Files of before lines were looked at with distortions have none.
    distortion = datasets.get(DISTORTION, np.zeros(1, np.float32))
    return Lines(
        segments,
        LineLikelihood(
            log_likelihoods=log_likelihoods,
            rotations=datasets[ROTATIONS].astype(np.float64),
            distortion=float(distortion[0]),
        ),
        down,
    )
