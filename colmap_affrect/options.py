"""Options of all stages: frozen dataclasses, checked, rejecting unknown keys.

A recipe is a TOML file whose sections are the fields of :class:`ExtractionOptions` and
``matching``; what it leaves out keeps the defaults below.

In this order: what all options can do; rectifiers; shapes and depth that they use; feature
profiles; extraction as a whole; then pairs, matching, verification, mapping, cameras and masks.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, ClassVar, Self

from colmap_affrect.errors import OptionError

RECTIFIERS = "colmap_affrect.rectifiers"
FEATURES = "colmap_affrect.features"
"""Entry-point groups of other packages' rectifiers and feature profiles."""


def entry_points(group: str) -> dict[str, metadata.EntryPoint]:
    """Return the entry points of a group by name."""
    return {point.name: point for point in metadata.entry_points(group=group)}


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

    def __str__(self) -> str:
        """Return one line for each option.

        >>> print(MatchingOptions(max_ratio=0.8))
        MatchingOptions
          max_ratio = 0.8
          ratio_both_ways = True
          min_contrast_distance_px = 10.0
          duplicate_radius_px = 2.0
        """
        lines = [f"  {key} = {value!r}" for key, value in flat(self.to_mapping()).items()]
        return "\n".join([type(self).__name__, *lines])

    def _check(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise OptionError(f"{name}={value} is outside [{low:g}, {high:g}]")

    def _check_fixed(self, name: str) -> None:
        """Refuse another value than the default, which says what kind of options these are."""
        self._check_choice(name, (str(self.__dataclass_fields__[name].default),))

    def _check_choice(self, name: str, choices: tuple[str, ...]) -> None:
        value = getattr(self, name)
        if value not in choices:
            raise OptionError(f"{name}={value!r} is not one of {', '.join(choices)}")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Join the keys of nested mappings by dots; tuples become lists.

    >>> flat({"a": {"b": (1, 2)}, "c": 3})
    {'a.b': [1, 2], 'c': 3}
    """
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = list(value) if isinstance(value, tuple) else value
    return found


def _suggestion(key: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(known)})"


def _converted(value: Any, item: dataclasses.Field[Any], where: str) -> Any:
    default = item.default
    if item.default_factory is not dataclasses.MISSING:
        default = item.default_factory()
    if "section" in item.metadata:
        section = item.metadata["section"]
        if isinstance(default, Options):
            return _options(value, section, where)
        if not isinstance(value, list | tuple):
            raise OptionError(f"{where}: expected a list of sections [[{item.name}]]")
        return tuple(_options(element, section, where) for element in value)
    if isinstance(default, Options):
        return type(default).from_mapping(value, where)
    if isinstance(default, tuple) and isinstance(value, list | tuple):
        return tuple(_converted_scalar(element, default[0], where) for element in value)
    return _converted_scalar(value, default, where)


def _options(value: Any, section: str, where: str) -> Options:
    if not isinstance(value, Mapping):
        raise OptionError(f"{where}: expected options, got {value!r}")
    try:
        chosen = options_class(section, value)
    except OptionError as error:
        raise OptionError(f"{where}: {error}") from error
    return chosen.from_mapping(value, where)


def _converted_scalar(value: Any, default: Any, where: str) -> Any:
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        expected, given = type(default).__name__, type(value).__name__
        raise OptionError(f"{where}: expected {expected}, got {given} ({value!r})")
    return value


@dataclass(frozen=True, kw_only=True)
class RectifierOptions(Options):
    """Base of the options of all rectifiers."""

    name: str = ""
    uses_depth: ClassVar[bool] = False
    """Whether it reads a depth map of every photograph."""

    def __post_init__(self) -> None:
        self._check_fixed("name")


@dataclass(frozen=True, kw_only=True)
class IdentityOptions(RectifierOptions):
    """No warps."""

    name: str = "identity"


@dataclass(frozen=True, kw_only=True)
class AffineWarpOptions(RectifierOptions):
    """How large affine warps are rendered."""

    area_preserving: bool = True
    """Warp by diag(sqrt t, 1 / sqrt t), which keeps the area; False: by diag(1, 1 / t), which
    never magnifies (the paper)."""


@dataclass(frozen=True, kw_only=True)
class AsiftOptions(AffineWarpOptions):
    """The same warps of the whole image for every photograph."""

    name: str = "asift"
    covering: str = "near-optimal"
    """``near-optimal``: 24 maps that with the identity cover all tilts to 5.8 (Rodriguez et al.
    2018); ``asift``: the 60 of ASIFT with tilts to 8 (Morel & Yu 2009, the paper)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("covering", ("near-optimal", "asift"))


@dataclass(frozen=True, kw_only=True)
class CoverOptions(AffineWarpOptions):
    """Greedy cover of the affine shapes of a photograph in the space of tilts."""

    shape_source: str = "second-moment"
    """``second-moment`` (structure tensor) or ``affnet`` (network)."""
    tilt_radius: float = 1.7
    """Radius r of a covering ball as a tilt ratio. Paper: 1.7."""
    max_tilt: float = 5.8
    """Shapes of a larger tilt neither vote nor count. Paper: 5.8."""
    covered_frac: float = 0.95
    """Share of the shapes that the balls must hold. Paper: 0.95."""
    max_num_rectifications: int = 8
    """Upper bound on the covering maps."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("shape_source", ("second-moment", "affnet"))
        self._check("tilt_radius", 1.05, 10.0)
        self._check("max_tilt", 1.0, 20.0)
        self._check("covered_frac", 0.0, 1.0)
        self._check("max_num_rectifications", 0, 192)


@dataclass(frozen=True, kw_only=True)
class DenseShapesOptions(CoverOptions):
    """Each block of the photograph is warped by the covering map nearest to its shape."""

    name: str = "dense-shapes"
    min_region_frac: float = 0.02
    """Regions of a smaller share of the image are not warped."""
    min_part_frac: float = 0.002
    """A region in several places is warped piece by piece, and pieces of a smaller share of the
    image are left out. 0: all of a region in one warp (the paper)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("min_region_frac", 0.0, 1.0)
        self._check("min_part_frac", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class AffNetShapesOptions(CoverOptions):
    """The whole photograph is warped by every covering map of its shapes."""

    name: str = "affnet-shapes"


@dataclass(frozen=True, kw_only=True)
class PlaneOptions(Options):
    """Planes from the normals of a depth map (the paper's depth-map-based method)."""

    num_candidates: int = 500
    """Candidate normals, on a spiral over the whole sphere. Paper: 500."""
    bin_angle_deg: float = 35.0
    """Normals at most this far from a candidate vote for it."""
    min_separation_deg: float = 87.5
    """Planes are at least this far apart."""
    max_num_planes: int = 3
    min_votes_frac: float = 0.15
    """Share of the pixels that a plane must have."""
    max_angle_deg: float = 75.0
    """Planes seen at a larger angle are not rectified."""
    min_region_frac: float = 0.03
    """Connected regions of a smaller share of the image are not rectified."""
    orthogonal: bool = False
    """Turn the normals of up to three planes into exactly orthogonal ones."""
    antipodal: bool = False
    """Count opposite normals as one plane."""

    def __post_init__(self) -> None:
        self._check("num_candidates", 10, 100_000)
        self._check("bin_angle_deg", 1.0, 89.0)
        self._check("min_separation_deg", 0.0, 180.0)
        self._check("max_num_planes", 1, 100)
        self._check("min_votes_frac", 0.0, 1.0)
        self._check("max_angle_deg", 0.0, 85.0)
        self._check("min_region_frac", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class DepthPlanesOptions(RectifierOptions):
    """One homography per planar region, as if seen from the front."""

    name: str = "depth-planes"
    planes: PlaneOptions = field(default_factory=PlaneOptions)
    keep_original: str = "everywhere"
    """Features of the photograph itself are kept ``everywhere`` or ``outside`` of the rectified
    regions (the paper)."""
    uses_depth: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("keep_original", ("everywhere", "outside"))


@dataclass(frozen=True, kw_only=True)
class DepthAffNetOptions(CoverOptions):
    """Planar regions from depth, each warped by a cover of the shapes inside it."""

    name: str = "depth-affnet"
    planes: PlaneOptions = field(default_factory=PlaneOptions)
    uses_depth: ClassVar[bool] = True


RECTIFIER_OPTIONS: dict[str, type[RectifierOptions]] = {
    "identity": IdentityOptions,
    "asift": AsiftOptions,
    "affnet-shapes": AffNetShapesOptions,
    "depth-planes": DepthPlanesOptions,
    "depth-affnet": DepthAffNetOptions,
    "dense-shapes": DenseShapesOptions,
}


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
class AffNetOptions(Options):
    """Shape source ``affnet``."""

    scales: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Sizes of the image at which dense shapes are estimated; their log-Euclidean mean counts."""
    paper: bool = False
    """Normalise by mean and deviation of the whole image and use the full size only, as the
    authors did; otherwise by those of the surrounding 33 x 33 px."""
    min_deviation: float = 3.0
    """Standard deviation of the surroundings, in gray values, under which a block counts as flat;
    not with ``paper``."""
    max_num_keypoints: int = 4000
    """Sparse shapes are those of the strongest keypoints."""

    def __post_init__(self) -> None:
        self._check("min_deviation", 0.0, 255.0)
        self._check("max_num_keypoints", 1, 1_000_000)
        if not self.scales or not all(0.05 <= scale <= 1.0 for scale in self.scales):
            raise OptionError("scales needs at least one value, each in [0.05, 1]")


@dataclass(frozen=True, kw_only=True)
class DepthOptions(Options):
    """Where depth maps come from, for rectifiers that use them."""

    path: str = ""
    """Folder of depth maps, named as the images: ``a/b.jpg`` has ``a/b.npy``, or .npz, .png, .exr,
    .h5 (also after the image's full name, ``a/b.jpg.npy``)."""
    model: str = ""
    """Monocular depth model: a name or local folder for Hugging Face transformers."""
    kind: str = "z"
    """What the values are: ``z`` (along the optical axis), ``ray`` (distance from the camera), or
    ``inverse`` (1 / z). For a model ``z`` means as its own configuration says."""
    png_scale: float = 0.001
    """Depth of one step of a 16-bit PNG; only the ratio of depths matters."""

    def __post_init__(self) -> None:
        self._check_choice("kind", ("z", "ray", "inverse"))
        self._check("png_scale", 1e-12, 1e12)
        if self.path and self.model:
            raise OptionError("path and model cannot both be given: depth comes from one of them")


@dataclass(frozen=True, kw_only=True)
class FeatureOptions(Options):
    """Base of the options of all feature profiles."""

    profile: str = ""
    max_num_features: int = 8192
    """Most features of the image itself, by response."""
    max_num_rectified_features: int = 6144
    """Most features of all warps together, by response."""

    def __post_init__(self) -> None:
        self._check_fixed("profile")
        self._check("max_num_features", 1, 1_000_000)
        self._check("max_num_rectified_features", 1, 1_000_000)


@dataclass(frozen=True, kw_only=True)
class DogOptions(FeatureOptions):
    """OpenCV's difference-of-Gaussians detector."""

    contrast_threshold: float = 0.013
    """OpenCV's contrast threshold; lower finds fainter features (OpenCV and the paper: 0.04)."""
    edge_threshold: float = 10.0
    num_octave_layers: int = 3
    sigma_px: float = 1.6

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("contrast_threshold", 0.0, 1.0)
        self._check("edge_threshold", 1.0, 1e6)
        self._check("num_octave_layers", 1, 10)
        self._check("sigma_px", 0.5, 10.0)


@dataclass(frozen=True, kw_only=True)
class SiftOptions(DogOptions):
    """Feature profile ``rootsift``."""

    profile: str = "rootsift"
    max_num_features: int = 13_000
    """Most features of the image itself, by response times scale: large ones are found again more
    often. Those of several orientations count as several, so this is about as many as COLMAP keeps
    of a large photograph, which counts 8192 before."""


DETECTORS = ("dog", "keynet", "hessian")
DESCRIPTORS = ("hardnet", "hardnet8", "hynet", "sosnet", "tfeat", "mkd", "hardtfeat")


@dataclass(frozen=True, kw_only=True)
class AffNetHardNetOptions(DogOptions):
    """Feature profile ``affnet-hardnet``: detector, AffNet, OriNet and a learned descriptor."""

    profile: str = "affnet-hardnet"
    detector: str = "dog"
    """``dog`` (OpenCV, as in the paper), ``keynet`` or ``hessian``."""
    descriptor: str = "hardnet"
    affine_shape: bool = True
    """Estimate affine shapes by AffNet; otherwise measurement regions are circles."""
    patch_sigmas: float = 12.0
    """Half width of a patch in units of the feature's sigma (12 as in the paper, for DoG)."""
    batch_size: int = 256
    """Patches that go through a network at once."""
    dtype: str = "float32"
    """Arithmetic of the networks: ``float32``, or ``float16`` and ``bfloat16`` where the device
    is faster with them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_choice("detector", DETECTORS)
        self._check_choice("descriptor", DESCRIPTORS)
        self._check_choice("dtype", ("float32", "float16", "bfloat16"))
        self._check("patch_sigmas", 1.0, 100.0)
        self._check("batch_size", 1, 1_000_000)


FEATURE_OPTIONS: dict[str, type[FeatureOptions]] = {
    "rootsift": SiftOptions,
    "affnet-hardnet": AffNetHardNetOptions,
}


def options_class(section: str, values: Mapping[str, Any]) -> type[Options]:
    """Return the class of the options of a section by the name it gives.

    Args:
        section: ``rectifier`` or ``features``.
        values: what the section holds; ``name`` or ``profile`` chooses the class, built in or
            of another package.

    Raises:
        OptionError: for an unknown name.
    """
    if section == "rectifier":
        name, built_in, group = values.get("name", "dense-shapes"), RECTIFIER_OPTIONS, RECTIFIERS
        return _chosen(name, built_in, group)
    return _chosen(values.get("profile", "rootsift"), FEATURE_OPTIONS, FEATURES)


def _chosen(name: Any, built_in: Mapping[str, type[Options]], group: str) -> type[Options]:
    if name in built_in:
        return built_in[name]
    plugins = entry_points(group)
    if name in plugins:
        chosen: type[Options] = plugins[name].load().Options
        return chosen
    known = {**built_in, **plugins}
    raise OptionError(f"unknown '{name}'{_suggestion(str(name), known)}")


@dataclass(frozen=True, kw_only=True)
class ExtractionOptions(Options):
    """Everything that decides the features of an image."""

    rectifier: RectifierOptions = field(
        default_factory=DenseShapesOptions, metadata={"section": "rectifier"}
    )
    escalation: tuple[RectifierOptions, ...] = field(default=(), metadata={"section": "rectifier"})
    """Rectifiers for pairs that fail verification, one after the other until it succeeds."""
    escalation_strong_num_inliers: int = 100
    """A pair with fewer inliers climbs too while one of its images has no pair with as many:
    an image that hangs on weak pairs alone is verified but rarely registered."""
    escalation_min_num_tracks: int = 30
    """All pairs of an image climb that has fewer features in tracks through three images or more:
    mapping registers images by such features, and COLMAP wants 30 of them."""
    second_moment: SecondMomentOptions = field(default_factory=SecondMomentOptions)
    affnet: AffNetOptions = field(default_factory=AffNetOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    features: FeatureOptions = field(default_factory=SiftOptions, metadata={"section": "features"})
    max_image_size_px: int = 2400
    """Larger images are shrunk to this longer side before extraction. At 2400 a photograph of
    12 megapixels needs 1.0 GiB of memory, two at once 1.8 GiB; at 3200, COLMAP's limit for SIFT,
    one needs 1.8 GiB."""

    def __post_init__(self) -> None:
        self._check("max_image_size_px", 16, 1_000_000)
        self._check("escalation_strong_num_inliers", 0, 1_000_000)
        self._check("escalation_min_num_tracks", 0, 1_000_000)

    @property
    def rectifiers(self) -> tuple[RectifierOptions, ...]:
        """The rectifiers of all levels, that of every image first."""
        return (self.rectifier, *self.escalation)


PAIR_METHODS = ("exhaustive", "retrieval", "low-resolution", "gps", "sequence")


@dataclass(frozen=True, kw_only=True)
class PairOptions(Options):
    """Which images are matched: the pairs of several methods together."""

    methods: tuple[str, ...] = ("exhaustive",)
    """``exhaustive``: all pairs. ``retrieval``: images whose descriptors are alike as a whole.
    ``low-resolution``: images of which the strongest features match. ``gps``: images taken near to
    each other. ``sequence``: images that follow each other by name."""
    num_neighbors: int = 20
    """Of each image: on average, by retrieval and low-resolution, and half as many at least; at
    most, by gps; before and after it, in a sequence."""
    max_distance_m: float = 100.0
    """Between positions of ``gps``; in their own unit where they are not longitude and latitude."""

    def __post_init__(self) -> None:
        if not self.methods:
            raise OptionError(f"methods is empty; give some of {', '.join(PAIR_METHODS)}")
        for name in self.methods:
            if name not in PAIR_METHODS:
                close = _suggestion(name, dict.fromkeys(PAIR_METHODS))
                raise OptionError(f"unknown way to choose pairs {name!r}{close}")
        self._check("num_neighbors", 1, 1_000_000)
        self._check("max_distance_m", 0.0, 1e9)


@dataclass(frozen=True, kw_only=True)
class MatchingOptions(Options):
    """Matching of two images."""

    max_ratio: float = 0.85
    """Largest ratio of first to second descriptor distance."""
    ratio_both_ways: bool = True
    """Test the ratio in both directions; False: from image 1 to 2 only, as in the paper."""
    min_contrast_distance_px: float = 10.0
    """The second neighbour must be this far from the first (FGINN; MODS: 10-30 px)."""
    duplicate_radius_px: float = 2.0
    """Of matches closer than this at both ends the best one stays."""

    def __post_init__(self) -> None:
        self._check("max_ratio", 0.1, 1.0)
        self._check("min_contrast_distance_px", 0.1, 1000.0)
        self._check("duplicate_radius_px", 0.01, 1000.0)


PRESETS = ("sparse", "colmap")
"""Names of the presets of verification and mapping: ours for few photographs, and COLMAP's."""
CUSTOM = "custom"
"""What options that are no preset are called."""

MAPPERS = ("incremental", "global")


def _check_preset(name: str) -> None:
    if name not in PRESETS:
        raise OptionError(f"preset {name!r} is not one of {', '.join(PRESETS)}")


@dataclass(frozen=True, kw_only=True)
class VerificationOptions(Options):
    """Two-view geometry, by default the sparse preset (names as in pycolmap)."""

    max_error_px: float = 3.0
    min_num_inliers: int = 20
    """COLMAP's 15 is what 100 random matches reach: measured, they made wrong pairs."""
    min_inlier_ratio: float = 0.20
    """COLMAP's 0 accepts random matches once there are many of them. Of the pairs that escalation
    brought to 230 raw matches on a temple before black, 77 verified wrongly with 24 to 66 inliers;
    71 of them had less than this share. Right pairs that have less are rare (2 of 104)."""
    max_num_trials: int = 10000
    ransac_min_inlier_ratio: float = 0.10

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "max_error_px": 4.0,
        "min_num_inliers": 15,
        "min_inlier_ratio": 0.0,
        "max_num_trials": 10000,
        "ransac_min_inlier_ratio": 0.25,
    }
    """The preset ``colmap``: COLMAP's own defaults."""

    def __post_init__(self) -> None:
        self._check("max_error_px", 0.01, 1000.0)
        self._check("min_num_inliers", 5, 1_000_000)
        self._check("min_inlier_ratio", 0.0, 1.0)
        self._check("max_num_trials", 1, 100_000_000)
        self._check("ransac_min_inlier_ratio", 0.0, 1.0)

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return the options of a preset, ``sparse`` or ``colmap``."""
        _check_preset(name)
        return cls(**cls.COLMAP) if name == "colmap" else cls()

    @property
    def preset_name(self) -> str:
        """Name of the preset that these options are, else ``custom``."""
        return next((name for name in PRESETS if self == self.preset(name)), CUSTOM)


@dataclass(frozen=True, kw_only=True)
class MappingOptions(Options):
    """Mapping, by default incremental with the sparse preset (names as in pycolmap)."""

    mapper: str = "incremental"
    """``incremental`` or ``global``, which uses the options that are not of first pairs (init)
    and single poses (abs_pose) and tries once."""
    ignore_two_view_tracks: bool = False
    """COLMAP's True leaves sparse sets without a model: there most tracks have two views."""
    init_min_tri_angle_deg: float = 8.0
    init_min_num_inliers: int = 50
    abs_pose_min_num_inliers: int = 12
    min_model_size: int = 2
    max_num_attempts: int = 3
    """While images are missing, map again with another seed and keep the largest model. With 100
    images in it nothing is tried again."""
    keep_given_intrinsics: bool = True
    """Leave camera parameters that the user gave as they are; refining them on a few images
    of a sparse set moves them far away (measured: focal lengths of 1437 px to 1256 px)."""
    mapper_options: dict[str, Any] = field(default_factory=dict)
    """Other options of pycolmap's pipeline, by dotted key (``mapper.init_max_error``); they win
    over those above."""

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "ignore_two_view_tracks": True,
        "init_min_tri_angle_deg": 16.0,
        "init_min_num_inliers": 100,
        "abs_pose_min_num_inliers": 30,
        "min_model_size": 10,
        "max_num_attempts": 1,
        "keep_given_intrinsics": False,
    }
    """The preset ``colmap``: COLMAP's own defaults."""
    COLMAP_GLOBAL: ClassVar[Mapping[str, Any]] = {**COLMAP, "min_model_size": 3}
    """The same for global mapping."""

    def __post_init__(self) -> None:
        self._check_choice("mapper", MAPPERS)
        self._check("init_min_tri_angle_deg", 0.0, 180.0)
        self._check("init_min_num_inliers", 1, 1_000_000)
        self._check("abs_pose_min_num_inliers", 3, 1_000_000)
        self._check("min_model_size", 2, 1_000_000)
        self._check("max_num_attempts", 1, 100)

    @classmethod
    def preset(
        cls,
        name: str,
        *,
        mapper: str = "incremental",
        mapper_options: Mapping[str, Any] | None = None,
    ) -> Self:
        """Return the options of a preset, ``sparse`` or ``colmap``, for one of the mappers."""
        _check_preset(name)
        colmap = cls.COLMAP_GLOBAL if mapper == "global" else cls.COLMAP
        values = colmap if name == "colmap" else {}
        return cls(mapper=mapper, mapper_options=dict(mapper_options or {}), **values)

    @property
    def preset_name(self) -> str:
        """Name of the preset that these options are, ``mapper_options`` apart, else ``custom``."""

        def is_preset(name: str) -> bool:
            options = self.preset(name, mapper=self.mapper, mapper_options=self.mapper_options)
            return self == options

        return next((name for name in PRESETS if is_preset(name)), CUSTOM)

    @property
    def num_attempts(self) -> int:
        """How often mapping may be tried; global mapping has no first pair to choose anew."""
        return 1 if self.mapper == "global" else self.max_num_attempts


@dataclass(frozen=True, kw_only=True)
class CameraOptions(Options):
    """How images share cameras (COLMAP's camera modes, models and parameters)."""

    mode: str = "auto"
    model: str = "SIMPLE_RADIAL"
    params: str = ""
    default_focal_length_factor: float = 1.2
    """Focal length in units of the longer side where EXIF has none."""
    existing_camera_id: int = -1
    """Camera of the database that all new images get; -1 makes cameras for them."""

    def __post_init__(self) -> None:
        self._check_choice("mode", ("auto", "single", "per-folder", "per-image"))
        self._check("default_focal_length_factor", 0.01, 100.0)
        self._check("existing_camera_id", -1, 2**31)


@dataclass(frozen=True, kw_only=True)
class MaskOptions(Options):
    """Where features may be, as COLMAP has it: nowhere that a mask is black."""

    path: str = ""
    """Folder with a mask for every image: a/b.jpg has a/b.jpg.png or a/b.png; empty for none."""
    camera_path: str = ""
    """One mask for all images; empty for none."""
