"""Depth maps of photographs: from files, or from a monocular network.

A depth map is (h, w) float32: depth along the optical axis, > 0, NaN where it is unknown. It
covers the whole image at any resolution, so that ``conventions.resized_from_original`` relates
its pixels to those of the photograph. The unit is free: normals do not depend on it.
"""

import hashlib
import io
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import log, prod
from pathlib import Path
from posixpath import splitext
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol
from zipfile import BadZipFile

import numpy as np

from colmap_affrect.data import Photograph
from colmap_affrect.errors import DepthError, OptionError, WorkspaceError
from colmap_affrect.geometry.arrays import Array, Bytes, Floats, Singles
from colmap_affrect.geometry.conventions import resized_from_original
from colmap_affrect.images.depth_files import SUFFIXES, UnusableMap, read_map
from colmap_affrect.images.headers import header_size
from colmap_affrect.images.reading import read_color, shrink_to
from colmap_affrect.options import PartOptions, Registry, within
from colmap_affrect.project.atomic_files import replace_bytes

MAX_ASPECT_RATIO = 1.05  # of aspects of map and photograph: networks round sizes to 32 px
MIN_VALID_FRAC = 0.01  # share of the pixels of a map that must be known
MIN_DISPARITY_FRAC = 0.01  # inverse depth below this share of the largest is sky, i.e. unknown
NETWORK_IMAGE_SIZE_PX = 1024  # longer side; most networks work at about 384 to 784 px

DAMAGED = (OSError, ValueError, KeyError, EOFError, RuntimeError, BadZipFile, zlib.error)
"""What numpy raises for a kept prediction that is missing or damaged."""


class DepthSource(Protocol):
    """Depth maps of photographs; called with its ``Options`` and a :class:`DepthContext`."""

    def depth(self, photograph: Photograph) -> Singles:
        """Return (h, w) float32 z-depth > 0, NaN where unknown, of any size over the whole image.

        Raises DepthError when there is no usable map.
        """

    def require_some(self, names: Sequence[str]) -> None:
        """Raise DepthError when there cannot be a map for any of the images named."""


@dataclass(frozen=True)
class DepthContext:
    """What depth sources work with."""

    cache_path: Path | None = None  # folder that keeps a network's predictions; None keeps none
    device: str = "cpu"  # where a network runs: ``cpu``, ``cuda``, ``cuda:1``, ``mps``


class DepthOptions(PartOptions):
    """Base of the options of all depth sources."""

    uses_network: ClassVar[bool] = False
    """Whether it runs on torch."""
    kind: Literal["z", "ray", "inverse"] = "z"
    """What the values are: ``z`` (along the optical axis), ``ray`` (distance from the camera), or
    ``inverse`` (1 / z). For a network ``z`` means as its own configuration says."""

    @property
    def folder(self) -> Path | None:
        """Folder that is read while images are worked on, if there is one."""
        return None

    @property
    def is_given(self) -> bool:
        """Whether there is a source of depth at all."""
        return True

    def file(self, name: str) -> Path | None:  # noqa: ARG002
        """Return the file that the depth of an image is read from, if there is one."""
        return None


class DepthFilesOptions(DepthOptions):
    """Depth maps in a folder."""

    name: Literal["files"] = "files"
    path: str = ""
    """Folder of depth maps, named as the images: ``a/b.jpg`` has ``a/b.npy``, or .png, .tif (also
    after the image's full name, ``a/b.jpg.npy``)."""
    png_scale: Annotated[float, within(1e-12, 1e12)] = 0.001
    """Depth of one step of a 16-bit PNG; only the ratio of depths matters."""

    @property
    def folder(self) -> Path | None:
        """The folder of the maps."""
        return Path(self.path) if self.path else None

    @property
    def is_given(self) -> bool:
        """Whether a folder is named."""
        return bool(self.path)

    def file(self, name: str) -> Path | None:
        """Return the map of an image, if any: ``a/b.jpg.npy`` and so on, then ``a/b.npy``."""
        stems = (name, splitext(name)[0])
        paths = (Path(self.path) / f"{stem}{suffix}" for stem in stems for suffix in SUFFIXES)
        return next((path for path in paths if path.is_file()), None)


class MonocularOptions(DepthOptions):
    """A monocular depth network."""

    name: Literal["monocular"] = "monocular"
    uses_network: ClassVar[bool] = True
    model: str
    """A name or local folder for Hugging Face transformers."""


DEPTH_SOURCES: Registry[DepthSource] = Registry(
    kind="depth source",
    group="colmap_affrect.depth",
    built_in={
        "files": "colmap_affrect.images.depth:DepthFiles",
        "monocular": "colmap_affrect.images.depth:MonocularDepth",
    },
    default="files",
)


class DepthFiles:
    """Depth maps in a folder; values that are not finite or not positive are unknown."""

    Options = DepthFilesOptions

    def __init__(self, options: DepthFilesOptions, context: DepthContext | None = None) -> None:
        del context
        self._options = options
        self._path = Path(options.path)

    def require_some(self, names: Sequence[str]) -> None:
        """Raise DepthError when no image has a map, OptionError when there is no folder."""
        if not self._path.is_dir():
            raise OptionError(f"{self._path}: no such folder; give the folder of the depth maps")
        if not any(self._options.file(name) for name in names):
            raise DepthError(
                f"{self._path}: holds no depth map of any of the {len(names)} images; "
                f"{self._places(names[0])}"
            )

    def depth(self, photograph: Photograph) -> Singles:
        """Read a map; DepthError if there is none, or it is damaged or not of this photograph."""
        path = self._options.file(photograph.name)
        if path is None:
            raise DepthError(
                f"{self._path}: no depth map of {photograph.name}; {self._places(photograph.name)}"
            )
        try:
            stored = photograph.path and header_size(photograph.path)
            values = read_map(path, prod(stored or photograph.size))
            if path.suffix == ".png":
                values = values * self._options.png_scale
            _require_same_aspect(values, photograph)
            return _z_depth(values, self._options.kind, photograph)
        except UnusableMap as error:
            raise DepthError(f"{path}: depth map of {photograph.name}: {error}") from error

    def _places(self, name: str) -> str:
        suffixes = ", ".join(SUFFIXES)
        return f"looked for {name}.* and {splitext(name)[0]}.* with * one of {suffixes}"


class _Prediction(NamedTuple):
    values: Singles  # (h, w) depth or inverse depth
    inverse: bool  # whether the network predicts relative inverse depth


class MonocularDepth:
    """Depth from one image by a network of Hugging Face transformers (``depth-estimation``).

    Relative inverse depth is known up to scale and shift: 0 is taken for infinitely far, and less
    than ``MIN_DISPARITY_FRAC`` of the largest value for unknown. Normals from such depth are
    approximate.

    Predictions are kept as ``<image name>.npz`` and used again for the same pixels and the same
    name of a model. Threads may share one instance: they take turns at the network.
    """

    Options = MonocularOptions

    def __init__(self, options: MonocularOptions, context: DepthContext) -> None:
        """Choose a network; it is loaded for the first prediction."""
        self._model, self._kind = options.model, options.kind
        self._cache_path, self._device = context.cache_path, context.device
        self._network: Any = None
        self._lock = threading.Lock()

    def require_some(self, names: Sequence[str]) -> None:
        """Load the network now unless all predictions are kept; DepthError if it cannot be."""
        files = [self._cache_file(name) for name in names]
        if not all(file is not None and file.exists() for file in files):
            with self._lock:
                self._load()

    def depth(self, photograph: Photograph) -> Singles:
        """Predict the (h, w) float32 z-depth of a photograph, NaN where it is unknown."""
        prediction = self._prediction(photograph)
        kind = "inverse" if self._kind == "z" and prediction.inverse else self._kind
        values = prediction.values
        if kind == "inverse":
            largest = np.nanmax(values, initial=0.0)
            far = values <= MIN_DISPARITY_FRAC * largest
            values = np.asarray(np.where(far, np.nan, values) / largest, dtype=np.float32)
        try:
            return _z_depth(values, kind, photograph)
        except UnusableMap as error:
            raise DepthError(f"{photograph.name}: depth by {self._model}: {error}") from error

    def _prediction(self, photograph: Photograph) -> _Prediction:
        if photograph.path is None:
            gray = shrink_to(photograph.gray, NETWORK_IMAGE_SIZE_PX)
            image = np.stack([gray] * 3, axis=-1)
        else:
            image = read_color(photograph.path, NETWORK_IMAGE_SIZE_PX)
        pixels = hashlib.sha256(image.tobytes() + str(image.shape).encode()).hexdigest()
        file = self._cache_file(photograph.name)
        kept = _read_prediction(file, self._model, pixels) if file else None
        if kept is not None:
            return kept
        with self._lock:
            self._load()
            prediction = self._predict(image)
        if file:
            _write_prediction(file, prediction, self._model, pixels)
        return prediction

    def _cache_file(self, name: str) -> Path | None:
        return self._cache_path / f"{name}.npz" if self._cache_path else None

    def _load(self) -> None:
        if self._network is not None:
            return
        try:
            from PIL import Image
            from transformers import pipeline
        except ImportError as error:
            raise DepthError(
                'depth from a network needs transformers: pip install "colmap-affrect[depth]"'
            ) from error
        try:
            network = pipeline(
                "depth-estimation", model=self._model, device=self._device, trust_remote_code=False
            )
        except Exception as error:  # a model's files can fail in any way
            reason = next(iter(str(error).splitlines()), type(error).__name__).strip()
            raise DepthError(
                f"{self._model}: cannot be loaded as a depth network ({reason}); give the name of "
                "a depth-estimation model on the Hugging Face hub, or a local folder that has one"
            ) from error
        network.model.float()  # weights that are stored as float16 would give coarse depth
        self._network, self._pillow_from_array = network, Image.fromarray

    def _predict(self, image: Bytes) -> _Prediction:
        # The pipeline also makes a preview, for which it divides by a range that may be 0.
        with np.errstate(all="ignore"):
            output = self._network(self._pillow_from_array(image))["predicted_depth"]
        values = output.detach().cpu().float().numpy()
        values = values.reshape(values.shape[-2:])
        return _Prediction(values, predicts_inverse_depth(self._network.model.config))


def predicts_inverse_depth(config: Any) -> bool:
    """Return whether a model predicts relative inverse depth, by its configuration.

    Depth Anything says so. DPT does but for metric heads, those with ``add_projection``.
    """
    estimation_type = getattr(config, "depth_estimation_type", None)
    if estimation_type is not None:
        return bool(estimation_type == "relative")
    return bool(config.model_type == "dpt" and not config.add_projection)


def _z_depth(values: Floats, kind: str, photograph: Photograph) -> Singles:
    """Turn (h, w) values of a kind of depth into float32 z-depth, NaN where it is unknown."""
    with np.errstate(all="ignore"):  # unknown values may be anything, and become NaN below
        if kind == "inverse":
            values = 1.0 / values
        elif kind == "ray":
            values = values / _ray_lengths((values.shape[1], values.shape[0]), photograph)
        depth = values.astype(np.float32)
    known = np.isfinite(depth) & (depth > 0.0)
    if known.mean() < MIN_VALID_FRAC:
        raise UnusableMap(
            f"{100 * known.mean():.2g} % of the values are depths (finite and positive), at least "
            f"{100 * MIN_VALID_FRAC:g} % are needed; make the map again"
        )
    return np.where(known, depth, np.float32(np.nan))


def _ray_lengths(size: tuple[int, int], photograph: Photograph) -> Array:
    """Distance from the camera of the points of depth 1 that the (h, w) pixels of a map show."""
    camera = resized_from_original(photograph.size, size) @ photograph.camera_matrix
    pixels = np.stack([*np.meshgrid(np.arange(size[0]), np.arange(size[1])), np.ones(size[::-1])])
    rays = np.tensordot(np.linalg.inv(camera), pixels, axes=1)
    return np.asarray(np.linalg.norm(rays, axis=0))


def _require_same_aspect(values: Floats, photograph: Photograph) -> None:
    height, width = values.shape
    image_width, image_height = photograph.size
    if abs(log(width / height) - log(image_width / image_height)) > log(MAX_ASPECT_RATIO):
        raise UnusableMap(
            f"is {width} x {height} px, the photograph {image_width} x {image_height} (width x "
            "height): not of this photograph, or turned; map and photograph must have the same "
            "aspect as stored, EXIF orientation is not applied"
        )


def _read_prediction(file: Path, model: str, pixels: str) -> _Prediction | None:
    """Read a prediction that was kept; None if it is not of this model and these pixels."""
    try:
        with file.open("rb") as stream:
            kept = np.load(stream, allow_pickle=False)
            if (str(kept["model"]), str(kept["pixels"])) != (model, pixels):
                return None
            return _Prediction(kept["values"], bool(kept["inverse"]))
    except DAMAGED:
        return None


def _write_prediction(file: Path, prediction: _Prediction, model: str, pixels: str) -> None:
    """Keep a prediction; the file appears under its name only when it is complete."""
    content = io.BytesIO()
    np.savez(content, **prediction._asdict(), model=model, pixels=pixels)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_bytes(file, content.getvalue())
    except (OSError, WorkspaceError) as error:
        raise DepthError(f"{file}: depth cannot be kept there ({error})") from error
