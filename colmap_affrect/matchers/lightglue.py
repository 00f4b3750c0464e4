"""LightGlue (Lindenberger, Sarlin, Pollefeys, ICCV 2023), built by kornia.

LightGlue reads positions, so it takes the features of one view: the image, or one of its warps, in
px of the view. Of images with warps the pairs of views with most mutual nearest neighbours are
matched, and the matches united.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import OptionError
from colmap_affrect.features.weights import load_state_dict, unusable
from colmap_affrect.geometry.arrays import Array, Indices, Singles
from colmap_affrect.geometry.neighbors import without_duplicates
from colmap_affrect.geometry.tilts import of_unit_area
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext, MatcherOptions, Matches
from colmap_affrect.options import within
from colmap_affrect.parallel.executor import one_openmp_thread

if TYPE_CHECKING:
    from torch import Tensor, nn

MIN_VIEW_FEATURES = 8  # of a view: no geometry could be verified by what fewer add
CHUNK_ROWS = 1 << 10  # features whose similarities are held at once, which bounds memory
DUPLICATE_RADIUS_PX = 2.0  # of nearer matches of several views, at both ends, the best stays


class LightGlueOptions(MatcherOptions):
    """LightGlue for features ``aliked``; defaults are those of its authors."""

    name: Literal["lightglue"] = "lightglue"
    max_num_features: Annotated[int, within(1, 1_000_000)] = 2048
    """Most features of each view that are matched, those of the largest responses."""
    depth_confidence: Annotated[float, within(0.0, 1.0)] = 0.95
    """No more layers when this share of the features is decided; 0: always all layers."""
    width_confidence: Annotated[float, within(0.0, 1.0)] = 0.99
    """Features that are this sure to have no match are dropped between layers; 0: none."""
    min_score: Annotated[float, within(0.0, 1.0)] = 0.1
    """Smallest score of a match."""
    max_num_view_pairs: Annotated[int, within(0, 1_000_000)] = 8
    """Of images with warps: pairs of views that are matched, those with most mutual nearest
    neighbours; 0: all."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Key of the file of weights."""
        return ("lightglue-aliked",)

    def require_extractor(self, extractor: str) -> None:
        """Refuse features that the weights were not trained for."""
        if extractor not in ("", "aliked"):
            raise OptionError(
                f"matching: lightglue takes features of aliked, not of {extractor}; "
                "use --recipe aliked-lightglue"
            )


@dataclass(frozen=True)
class PreparedView:
    """One view of an image as the network takes it."""

    rows: Indices  # (N,) of the image's features
    inputs: dict[str, Tensor]  # the network's, a batch of one


@dataclass(frozen=True)
class PreparedViews:
    """All views of an image that have features enough, and (N, 2) centres of all features, px."""

    views: tuple[PreparedView, ...]
    keypoints: Array

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        tensors = (tensor for view in self.views for tensor in view.inputs.values())
        return self.keypoints.nbytes + sum(tensor.nbytes for tensor in tensors)


class LightGlue:
    """Matches with one network, a pair of views at a time.

    On a CPU each thread uses one core, so that results do not depend on their number.
    """

    Options = LightGlueOptions

    def __init__(self, options: LightGlueOptions, context: MatcherContext) -> None:
        """Load the network; AffrectError as :mod:`.networks` raises them."""
        from colmap_affrect.features.networks import resolve_device

        self.options, self._device = options, resolve_device(context.device)
        (key,) = options.weights
        self._network = load_network(context.weights[key], options).to(self._device)
        self._gpu_lock = threading.Lock()

    def prepare(self, image: ImageFeatures) -> PreparedViews:
        """Bring the features of each view into its own coordinates."""
        self.options.require_extractor(image.extractor)
        features = image.features
        views = []
        for number in np.unique(features.rectification_ids):
            rows = np.flatnonzero(features.rectification_ids == number)
            if len(rows) < MIN_VIEW_FEATURES and number:
                continue
            order = np.argsort(-features.responses[rows], kind="stable")
            rows = np.sort(rows[order[: self.options.max_num_features]])
            inputs = network_inputs(features.select(rows), image.image_size)
            views.append(PreparedView(rows, inputs))
        return PreparedViews(tuple(views), features.keypoints)

    def match(self, first: PreparedViews, second: PreparedViews) -> Matches:
        """Match two images; scores are the network's."""
        pairs = list(product(first.views, second.views))
        limit = self.options.max_num_view_pairs
        if limit and len(pairs) > limit:
            pairs = promising(first.views, second.views, limit)
        parts = [self._match_views(*pair) for pair in pairs]
        return parts[0] if len(parts) == 1 else united(parts, first.keypoints, second.keypoints)

    def _match_views(self, first: PreparedView, second: PreparedView) -> Matches:
        if not len(first.rows) or not len(second.rows):
            return Matches.none()
        import torch

        torch.get_num_threads()  # lets torch set up this thread, which would undo the next line
        alone = one_openmp_thread() if self._device.type == "cpu" else self._alone_on_gpu()
        with torch.inference_mode(), alone:
            found = self._network({
                f"image{k}": {name: tensor.to(self._device) for name, tensor in view.inputs.items()}
                for k, view in enumerate((first, second))
            })  # fmt: skip
            rows, columns = found["matches"][0].cpu().numpy().T
            scores = found["scores"][0].float().cpu().numpy()
        order = np.argsort(rows, kind="stable")
        indices = np.stack([first.rows[rows], second.rows[columns]], axis=1)
        return Matches(indices[order], scores[order])

    @contextmanager
    def _alone_on_gpu(self) -> Iterator[None]:
        """Wait for other threads, and keep cuDNN out: it makes a plan for every number of features.

        Nearly every layer has another one, and to make a plan takes longer than all else.
        """
        from torch.nn.attention import SDPBackend, sdpa_kernel

        kernels = [SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH]
        with self._gpu_lock, sdpa_kernel(kernels):
            yield


def load_network(path: Path, options: LightGlueOptions) -> nn.Module:
    """Build kornia's LightGlue with the parameters in a file, all of them, else AffrectError."""
    from kornia.feature import LightGlue as Network

    configuration = {
        **Network.features["aliked"],
        "weights": None,
        "depth_confidence": options.depth_confidence,
        "width_confidence": options.width_confidence,
        "filter_threshold": options.min_score,
    }
    network = Network(features=None, **configuration)  # type: ignore[arg-type]
    state = {renamed(name): value for name, value in load_state_dict(path).items()}
    not_these = "not the weights of LightGlue for ALIKED"
    try:
        found = network.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise unusable(path, f"{not_these} (of another size)") from error
    parameters = dict(network.named_parameters())
    if missing := [name for name in found.missing_keys if name in parameters]:
        raise unusable(path, f"{not_these} (no {missing[0]})")
    return network.eval().requires_grad_(False)


def renamed(name: str) -> str:
    """Return kornia's name of a parameter in LightGlue's first files.

    >>> renamed("self_attn.3.out_proj.bias")
    'transformers.3.self_attn.out_proj.bias'
    """
    return re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", name)


def network_inputs(features: LocalFeatures, image_size: tuple[int, int]) -> dict[str, Tensor]:
    """Return what the network reads of a view, in pixel-centre px as in training."""
    import torch

    points, size = features.keypoints, np.asarray(image_size, np.float64)
    if features.rectification_ids[0]:
        points, size = points_of_view(features.lafs)
    values = {"keypoints": np.clip(points, 0.0, size), "image_size": size}
    return {
        name: torch.from_numpy(np.ascontiguousarray(array, np.float32))[None]
        for name, array in (*values.items(), ("descriptors", features.descriptors))
    }


def points_of_view(lafs: Array) -> tuple[Array, Array]:
    """Undo the warp of a view, whose frames were carried back into the image.

    Circles of one radius became the linear part of the warp. Returns (N, 2) points in px of the
    view, and its (width, height): as far as they reach.
    """
    shapes = of_unit_area(lafs[:, :, :2])
    (linear,) = of_unit_area(shapes.mean(axis=0, keepdims=True))
    points = (np.linalg.inv(linear) @ lafs)[:, :, 2]
    low, high = points.min(axis=0), points.max(axis=0)
    return points - low, high - low + 1.0


def promising(
    first: Sequence[PreparedView], second: Sequence[PreparedView], count: int
) -> list[tuple[PreparedView, PreparedView]]:
    """Return the pairs of views with most mutual nearest neighbours among all features."""
    descriptors1, descriptors2 = (
        np.concatenate([view.inputs["descriptors"][0].numpy() for view in views])
        for views in (first, second)
    )
    views1, views2 = (
        np.repeat(np.arange(len(views)), [len(view.rows) for view in views])
        for views in (first, second)
    )
    nearest1 = _nearest(descriptors1, descriptors2)
    mutual = _nearest(descriptors2, descriptors1)[nearest1] == np.arange(len(views1))
    shared = np.zeros((len(first), len(second)), np.int64)
    np.add.at(shared, (views1[mutual], views2[nearest1[mutual]]), 1)
    chosen = np.argsort(-shared, axis=None, kind="stable")[:count]
    return [(first[i], second[j]) for i, j in zip(*np.divmod(chosen, len(second)), strict=True)]


def _nearest(queries: Singles, descriptors: Singles) -> Indices:
    """Return the most similar of (M, D) descriptors for each of (N, D) queries."""
    chunks = (queries[i : i + CHUNK_ROWS] for i in range(0, len(queries), CHUNK_ROWS))
    return np.concatenate([(chunk @ descriptors.T).argmax(axis=1) for chunk in chunks])


def united(parts: list[Matches], keypoints1: Array, keypoints2: Array) -> Matches:
    """Unite matches of several pairs of views: one-to-one, and each place once, the best first."""
    if not sum(len(part.scores) for part in parts):
        return Matches.none()
    indices = np.concatenate([part.indices for part in parts])
    scores = np.concatenate([part.scores for part in parts])
    order = np.argsort(-scores, kind="stable")
    indices, scores = indices[order], scores[order]
    for column in (0, 1):  # the best match of each feature, in both images
        best = np.sort(np.unique(indices[:, column], return_index=True)[1])
        indices, scores = indices[best], scores[best]
    places = keypoints1[indices[:, 0]], keypoints2[indices[:, 1]]
    kept = np.flatnonzero(without_duplicates(*places, DUPLICATE_RADIUS_PX))
    rising = kept[np.argsort(indices[kept, 0])]
    return Matches(indices[rising], scores[rising])
