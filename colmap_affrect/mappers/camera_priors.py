"""What is known of cameras before mapping: focal length, principal point, distortion.

The logarithm of a focal length is normal, and so is the principal point. What the user gives is
held. EXIF, the straight lines of photographs (:mod:`colmap_affrect.geometry.lines`) and lenses as
they usually are say the rest, each as a distribution; their product is the prior. Adjustments
(:mod:`colmap_affrect.mappers.adjustment`) and scores (:mod:`colmap_affrect.mappers.model_score`)
use the same one.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import TRUSTED, CameraRecord

# The usual focal length and its deviation are judged on lenses of 25 to 70 mm on 35 mm film; the
# deviation by EXIF covers rounding and the distance of focus.
USUAL_FOCAL = 1.15  # longer sides of the image, the median
USUAL_SIGMA = 0.4  # of the logarithm of an uncalibrated focal length
EXIF_SIGMA = 0.08  # of the logarithm of a focal length by EXIF
DISTORTION_SIGMA = 0.07  # of each distortion coefficient, judged on lenses that are no fisheyes
MIN_FOCAL_PX = 1e-9  # whose logarithm is taken


@dataclass(frozen=True)
class CameraPrior:
    """What is known of the intrinsics of a camera."""

    focal_px: float  # median of the focal length
    sigma: float  # standard deviation of its logarithm; 0 where it is given and held

    def cost(self, focal_px: float) -> float:
        """Return how much a focal length costs, in nats."""
        if not self.sigma:
            return 0.0
        return 0.5 * (math.log(max(focal_px, MIN_FOCAL_PX) / self.focal_px) / self.sigma) ** 2


def camera_prior(camera: pycolmap.Camera, record: CameraRecord | None) -> CameraPrior:
    """Return what is known of a camera of a database, by the record of it if there is one."""
    focal_px = float(camera.mean_focal_length())
    if record and "focal" in record.given:
        return CameraPrior(focal_px, 0.0)
    if record.source in TRUSTED if record else camera.has_prior_focal_length:
        return CameraPrior(focal_px, EXIF_SIGMA)
    return CameraPrior(USUAL_FOCAL * max(camera.width, camera.height), USUAL_SIGMA)


def camera_priors(
    cameras: Iterable[pycolmap.Camera], records: Mapping[int, CameraRecord]
) -> dict[int, CameraPrior]:
    """Return the priors of cameras, by camera id."""
    return {c.camera_id: camera_prior(c, records.get(c.camera_id)) for c in cameras}
