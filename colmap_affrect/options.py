"""Options of all stages: frozen dataclasses, checked, rejecting unknown keys.

A recipe is a TOML file of the sections ``rectifier``, ``second_moment``, ``features`` and
``matching``; what it leaves out keeps the defaults below.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from colmap_affrect.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base: strict construction from mappings, plain dictionaries out."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Build from a mapping; unknown keys and values of a wrong type raise OptionError."""
        if not isinstance(values, Mapping):
            raise OptionError(f"{where}: expected options, got {values!r}")
        fields = {item.name: item for item in dataclasses.fields(cls)}
        for key in values:
            if key not in fields:
                raise OptionError(f"{where}: unknown option '{key}'{_suggestion(key, fields)}")
        known = {
            key: _converted(value, fields[key], f"{where}.{key}") for key, value in values.items()
        }
        try:
            return cls(**known)
        except OptionError as error:
            raise OptionError(f"{where}: {error}") from error

    def to_mapping(self) -> dict[str, Any]:
        """Return the options as nested dictionaries of plain values."""
        return dataclasses.asdict(self)

    def _check(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise OptionError(f"{name}={value} is outside [{low:g}, {high:g}]")


def _suggestion(key: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(known)})"


def _converted(value: Any, item: dataclasses.Field[Any], where: str) -> Any:
    default = item.default
    if item.default_factory is not dataclasses.MISSING:
        default = item.default_factory()
    if isinstance(default, Options):
        return type(default).from_mapping(value, where)
    if isinstance(default, tuple) and isinstance(value, list | tuple):
        return tuple(_converted_scalar(element, default[0], where) for element in value)
    return _converted_scalar(value, default, where)


def _converted_scalar(value: Any, default: Any, where: str) -> Any:
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        expected, given = type(default).__name__, type(value).__name__
        raise OptionError(f"{where}: expected {expected}, got {given} ({value!r})")
    return value


@dataclass(frozen=True, kw_only=True)
class DenseShapesOptions(Options):
    """Rectifier: which warps are planned."""

    name: str = "dense-shapes"
    """``dense-shapes``, or ``identity`` for no rectification at all."""
    shape_source: str = "second-moment"
    tilt_radius: float = 1.7
    """Radius r of a covering ball as a tilt ratio. Paper: 1.7."""
    max_tilt: float = 5.8
    """Shapes of a larger tilt neither vote nor count. Paper: 5.8."""
    covered_frac: float = 0.95
    """Share of the textured blocks that the balls must hold. Paper: 0.95."""
    max_num_rectifications: int = 8
    """Upper bound on the warps of one image."""
    min_region_frac: float = 0.02
    """Regions of a smaller share of the image are not warped."""

    min_part_frac: float = 0.002
    """Scattered pieces of a region of a smaller share of the image are left out."""

    def __post_init__(self) -> None:
        self._check("min_part_frac", 0.0, 1.0)
        self._check("tilt_radius", 1.05, 10.0)
        self._check("max_tilt", 1.0, 20.0)
        self._check("covered_frac", 0.0, 1.0)
        self._check("max_num_rectifications", 0, 192)
        self._check("min_region_frac", 0.0, 1.0)
        if self.name not in ("dense-shapes", "identity"):
            raise OptionError(f"name={self.name!r} is not one of dense-shapes, identity")
        if self.shape_source != "second-moment":
            raise OptionError(f"shape_source={self.shape_source!r} is not second-moment")


@dataclass(frozen=True, kw_only=True)
class SecondMomentOptions(Options):
    """Shape source ``second-moment``."""

    derivative_sigma_px: float = 1.5
    """Gaussian smoothing before the gradients."""
    integration_sigmas_px: tuple[float, ...] = (8.0, 16.0, 32.0)
    """Windows over which the structure tensor is averaged; shapes are their log-Euclidean mean."""
    min_gradient: float = 1.0
    """Root mean square gradient, gray values per px, under which a block counts as flat."""

    def __post_init__(self) -> None:
        self._check("derivative_sigma_px", 0.3, 20.0)
        self._check("min_gradient", 0.0, 255.0)
        if not self.integration_sigmas_px or min(self.integration_sigmas_px) < 1.0:
            raise OptionError("integration_sigmas_px needs at least one value, each >= 1")


@dataclass(frozen=True, kw_only=True)
class SiftOptions(Options):
    """Feature profile ``rootsift``."""

    profile: str = "rootsift"
    max_num_features: int = 8192
    """Most features of the image itself, by response."""
    max_num_rectified_features: int = 6144
    """Most features of all warps together, by response."""
    contrast_threshold: float = 0.013
    """OpenCV's contrast threshold; lower finds fainter features (OpenCV's default: 0.04)."""
    edge_threshold: float = 10.0
    num_octave_layers: int = 3
    sigma_px: float = 1.6

    def __post_init__(self) -> None:
        self._check("max_num_features", 1, 1_000_000)
        self._check("max_num_rectified_features", 1, 1_000_000)
        self._check("contrast_threshold", 0.0, 1.0)
        self._check("edge_threshold", 1.0, 1e6)
        self._check("num_octave_layers", 1, 10)
        self._check("sigma_px", 0.5, 10.0)
        if self.profile != "rootsift":
            raise OptionError(f"profile={self.profile!r} is not rootsift")


@dataclass(frozen=True, kw_only=True)
class ExtractionOptions(Options):
    """Everything that decides the features of an image."""

    rectifier: DenseShapesOptions = field(default_factory=DenseShapesOptions)
    second_moment: SecondMomentOptions = field(default_factory=SecondMomentOptions)
    features: SiftOptions = field(default_factory=SiftOptions)
    max_image_size_px: int = 2400
    """Larger images are shrunk to this longer side before extraction. At 2400 a photograph of
    12 megapixels needs 1.0 GiB of memory, at 3200 (COLMAP's limit for SIFT) 1.8 GiB."""

    def __post_init__(self) -> None:
        self._check("max_image_size_px", 16, 1_000_000)


@dataclass(frozen=True, kw_only=True)
class MatchingOptions(Options):
    """Matching of two images."""

    max_ratio: float = 0.85
    """Largest ratio of first to second descriptor distance, tested in both directions."""
    min_contrast_distance_px: float = 10.0
    """The second neighbour must be this far from the first (FGINN; MODS: 10-30 px)."""
    duplicate_radius_px: float = 2.0
    """Of matches closer than this at both ends the best one stays."""

    def __post_init__(self) -> None:
        self._check("max_ratio", 0.1, 1.0)
        self._check("min_contrast_distance_px", 0.1, 1000.0)
        self._check("duplicate_radius_px", 0.01, 1000.0)


@dataclass(frozen=True, kw_only=True)
class VerificationOptions(Options):
    """Two-view geometry, the sparse preset (names as in pycolmap)."""

    max_error_px: float = 3.0
    min_num_inliers: int = 20
    """COLMAP's 15 is what 100 random matches reach: measured, they made wrong pairs."""
    min_inlier_ratio: float = 0.10
    """COLMAP's 0 accepts random matches once there are many of them."""
    max_num_trials: int = 10000
    ransac_min_inlier_ratio: float = 0.10

    def __post_init__(self) -> None:
        self._check("max_error_px", 0.01, 1000.0)
        self._check("min_num_inliers", 5, 1_000_000)
        self._check("min_inlier_ratio", 0.0, 1.0)
        self._check("max_num_trials", 1, 100_000_000)
        self._check("ransac_min_inlier_ratio", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class MappingOptions(Options):
    """Incremental mapping, the sparse preset (names as in pycolmap)."""

    ignore_two_view_tracks: bool = False
    """COLMAP's True leaves sparse sets without a model: there most tracks have two views."""
    init_min_tri_angle_deg: float = 8.0
    init_min_num_inliers: int = 50
    abs_pose_min_num_inliers: int = 12
    min_model_size: int = 2
    max_num_attempts: int = 3
    """While images are missing, map again with another seed and keep the largest model."""
    keep_given_intrinsics: bool = True
    """Leave camera parameters that the user gave as they are; refining them on a few images
    of a sparse set moves them far away (measured: focal lengths of 1437 px to 1256 px)."""

    def __post_init__(self) -> None:
        self._check("init_min_tri_angle_deg", 0.0, 180.0)
        self._check("init_min_num_inliers", 1, 1_000_000)
        self._check("abs_pose_min_num_inliers", 3, 1_000_000)
        self._check("min_model_size", 2, 1_000_000)
        self._check("max_num_attempts", 1, 100)


@dataclass(frozen=True, kw_only=True)
class CameraOptions(Options):
    """How images share cameras (COLMAP's camera modes, models and parameters)."""

    mode: str = "auto"
    model: str = "SIMPLE_RADIAL"
    params: str = ""

    def __post_init__(self) -> None:
        modes = ("auto", "single", "per-folder", "per-image")
        if self.mode not in modes:
            raise OptionError(f"mode={self.mode!r} is not one of {', '.join(modes)}")
