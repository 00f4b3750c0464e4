"""LightGlue (Lindenberger, Sarlin, Pollefeys, ICCV 2023), built by kornia.

LightGlue reads the positions of features, so it matches one view at a time, in px of that view: the
image, or one of its warps. Of two images with warps, it matches the pairs of views with most mutual
nearest neighbours, and the matches are merged.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import Option, OptionError
from colmap_affrect.features.weights import load_state_dict, unusable
from colmap_affrect.geometry.arrays import Array, Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import without_duplicates
from colmap_affrect.geometry.tilts import of_unit_area
from colmap_affrect.matchers.base import (
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
    Matches,
)
from colmap_affrect.matchers.cpu_products import (
    fast_attention,
    has_fast_products,
    with_fast_products,
)
from colmap_affrect.options import within
from colmap_affrect.parallel.executor import one_openmp_thread

if TYPE_CHECKING:
    from torch import Tensor, nn

    Attend = Callable[[Tensor, Tensor, Tensor], Tensor]

MIN_VIEW_FEATURES = 8
"""Features that a warp needs: matches of fewer could verify no two-view geometry (theory: the
linear estimate of a fundamental matrix needs eight)."""
DUPLICATE_RADIUS_PX = 2.0
"""Of matches that are nearer than this in both images the best stays; the radius of a duplicate in
:class:`.nearest.NearestOptions`; same as NearestOptions.duplicate_radius_px."""
# Of kornia's block of cross-attention
CROSS_BLOCK_PARTS = ("to_qk", "to_v", "to_out", "ffn", "heads")
# Descriptors that are compared at once, which bounds memory; resource
CHUNK_ROWS = 1 << 10


class LightGlueOptions(MatcherOptions):
    """LightGlue for features ``aliked``; defaults are those of its authors."""

    name: Literal["lightglue"] = "lightglue"
    max_num_features: Annotated[int, within(1, 1_000_000)] = 2048  # paper
    """Most features of each view that are matched, those of the largest responses."""
    depth_confidence: Annotated[float, within(0.0, 1.0)] = 0.95  # paper
    """No more layers when this share of the features is decided; 0: always all layers."""
    width_confidence: Annotated[float, within(0.0, 1.0)] = 0.99  # paper
    """Features that are this sure to have no match are dropped between layers; 0: none."""
    min_score: Annotated[float, within(0.0, 1.0)] = 0.1  # paper
    """Smallest score of a match."""
    max_num_view_pairs: Annotated[int, within(0, 1_000_000)] = 8  # resource
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
                f"lightglue takes features of aliked, not of {extractor}",
                where="matching",
                advice=("use ", Option("recipe"), " aliked-lightglue"),
            )


@dataclass(frozen=True)
class PreparedView:
    """One view of an image, ready for the network."""

    rows: Indices  # (N,) features of the image that the view has, rising
    inputs: dict[str, Tensor]  # arguments of the network, a batch of one
    # The same after what the network does with this view alone, once that was asked for
    begun: dict[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class PreparedImage:
    """All views of an image that have enough features."""

    views: tuple[PreparedView, ...]
    keypoints: Array  # (N, 2) px of all features in the image

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        total = self.keypoints.nbytes
        for view in self.views:
            tensors = [*view.inputs.values(), *view.begun.values()]
            total += sum(tensor.nbytes for tensor in tensors)
        return total


class LightGlue:
    """Matches pairs of views with one network.

    On a CPU each thread uses one core, so that results do not depend on the number of threads.
    """

    Options = LightGlueOptions

    def __init__(self, options: LightGlueOptions, context: MatcherContext) -> None:
        """Load the network; AffrectError as :mod:`.networks` raises them."""
        from colmap_affrect.features.networks import resolve_device

        self.options = options
        self._device = resolve_device(context.device)
        (key,) = options.weights
        network = load_network(context.weights[key], options)
        if self._device.type == "cpu":
            adapt_to_cpu(network)
        self._network = network.to(self._device)
        self._begin = split_off_beginning(self._network)
        self._gpu_lock = threading.Lock()

    def prepare(self, image: ImageFeatures) -> PreparedImage:
        """Bring the features of each view into the coordinates of that view."""
        self.options.require_extractor(image.extractor)
        features = image.features
        views = []
        for view_id in np.unique(features.rectification_ids):
            rows = np.flatnonzero(features.rectification_ids == view_id)
            is_warp = view_id != 0
            if is_warp and len(rows) < MIN_VIEW_FEATURES:
                continue
            order = np.argsort(-features.responses[rows], kind="stable")
            strongest = order[: self.options.max_num_features]
            rows = np.sort(rows[strongest])
            inputs = network_inputs(features.select(rows), image.image_size)
            views.append(PreparedView(rows, inputs))
        return PreparedImage(tuple(views), features.keypoints)

    def match(self, first: PreparedImage, second: PreparedImage) -> Matches:
        """Match two images; scores are the network's.

        Args:
            first: prepared image 1.
            second: prepared image 2; either may have no features.

        Returns:
            Matches, one to one.
        """
        view_pairs = list(product(first.views, second.views))
        limit = self.options.max_num_view_pairs
        if limit and len(view_pairs) > limit:
            view_pairs = most_similar_views(first.views, second.views, limit)
        parts = [self._match_views(*pair) for pair in view_pairs]
        if len(parts) == 1:
            return parts[0]
        return merged_matches(parts, first.keypoints, second.keypoints)

    def _match_views(self, first: PreparedView, second: PreparedView) -> Matches:
        if not len(first.rows) or not len(second.rows):
            return Matches.none()
        import torch

        torch.get_num_threads()  # lets torch set up this thread, which would undo the next lines
        is_on_cpu = self._device.type == "cpu"
        limited = one_openmp_thread() if is_on_cpu else self._alone_on_gpu()
        with torch.inference_mode(), limited:
            batch = {"image0": self._begun(first), "image1": self._begun(second)}
            output = self._network(batch)
            matched = output["matches"][0].cpu().numpy()
            scores = output["scores"][0].float().cpu().numpy()
        rows1 = first.rows[matched[:, 0]]
        rows2 = second.rows[matched[:, 1]]
        order = np.argsort(matched[:, 0], kind="stable")
        indices = np.stack([rows1, rows2], axis=1)
        return Matches(indices[order], scores[order])

    def _begun(self, view: PreparedView) -> dict[str, Tensor]:
        """Return what the network goes on with, which is kept with the view for its next pair."""
        if not view.begun:
            inputs = {key: value.to(self._device) for key, value in view.inputs.items()}
            descriptors = self._begin(inputs)
            view.begun.update({**inputs, "descriptors": descriptors})
        return view.begun

    @contextmanager
    def _alone_on_gpu(self) -> Iterator[None]:
        """Wait for other threads, and use no attention of cuDNN.

        cuDNN makes a plan for each number of features, which takes longer than all else: nearly
        every layer has another number.
        """
        from torch.nn.attention import SDPBackend, sdpa_kernel

        kernels = [
            SDPBackend.FLASH_ATTENTION,
            SDPBackend.EFFICIENT_ATTENTION,
            SDPBackend.MATH,
        ]
        with self._gpu_lock, sdpa_kernel(kernels):
            yield


def load_network(path: Path, options: LightGlueOptions) -> nn.Module:
    """Build kornia's LightGlue with the parameters in a file; AffrectError unless it has all."""
    from kornia.feature import LightGlue as Network

    configuration = {
        **Network.features["aliked"],
        "weights": None,
        "depth_confidence": options.depth_confidence,
        "width_confidence": options.width_confidence,
        "filter_threshold": options.min_score,
    }
    network = Network(features=None, **configuration)  # type: ignore[arg-type]
    state = {}
    for name, value in load_state_dict(path).items():
        state[kornia_name(name)] = value
    problem = "not the weights of LightGlue for ALIKED"
    try:
        loaded = network.load_state_dict(state, strict=False)
    except RuntimeError as error:
        raise unusable(path, f"{problem} (of another size)") from error
    parameters = dict(network.named_parameters())
    for name in loaded.missing_keys:
        if name in parameters:
            raise unusable(path, f"{problem} (no {name})")
    return network.eval().requires_grad_(False)


def adapt_to_cpu(network: Any) -> None:
    """Have LightGlue multiply and attend as is fast on a CPU; results are the same to rounding.

    kornia attends from image to image by fused attention on GPUs alone. Elsewhere it holds the
    similarities of all pairs of features, for which more than half of the time of a pair of images
    goes.

    Args:
        network: kornia's; changed in place, where its blocks have the parts that are known.
    """
    from torch.nn.functional import scaled_dot_product_attention

    attend: Attend = scaled_dot_product_attention
    is_fast = has_fast_products()
    if is_fast:
        attend = fast_attention
        with_fast_products(network.transformers)
    for layer in network.transformers:
        attention = getattr(layer.self_attn, "inner_attn", None)
        if is_fast and attention is not None:
            attention.forward = _attend_within
        block = layer.cross_attn
        if all(hasattr(block, part) for part in CROSS_BLOCK_PARTS):
            block.forward = partial(_attend_across, block, attend)


def split_off_beginning(network: Any) -> Callable[[Mapping[str, Tensor]], Tensor]:
    """Have LightGlue begin where images tell each other, and return what comes before that.

    Until then it looks at each image alone, which is a tenth of the time of a pair, and the same
    for all pairs of an image.

    Args:
        network: kornia's; changed in place: its descriptors are to be those that are returned.

    Returns:
        What makes the descriptors of an image that the network takes then, from its inputs.
    """
    from kornia.feature.lightglue import normalize_keypoints
    from torch import nn

    project = network.input_proj
    encode = network.posenc
    attend = network.transformers[0].self_attn

    def begin(inputs: Mapping[str, Tensor]) -> Tensor:
        points = normalize_keypoints(inputs["keypoints"], inputs["image_size"])
        encoding = encode(points.clone())
        descriptors: Tensor = attend(project(inputs["descriptors"]), encoding)
        return descriptors

    class Done(nn.Module):
        def forward(self, descriptors: Tensor, *_: Tensor) -> Tensor:
            return descriptors

    network.input_proj = nn.Identity()
    network.transformers[0].self_attn = Done()
    network.conf.input_dim = network.conf.descriptor_dim
    return begin


def _attend_within(
    queries: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None = None
) -> Tensor:
    """Do what the forward of kornia's ``Attention`` does where nothing is masked."""
    if mask is not None:
        raise NotImplementedError("fast attention masks nothing")
    return fast_attention(queries, keys, values)


def _attend_across(
    block: Any, attend: Attend, first: Tensor, second: Tensor
) -> tuple[Tensor, Tensor]:
    """Do what the forward of kornia's ``CrossBlock`` does.

    Args:
        block: kornia's.
        attend: as torch's ``scaled_dot_product_attention``.
        first: (B, N, D) descriptors of image 1.
        second: (B, M, D) descriptors of image 2.

    Returns:
        Both with what they have learned of each other, (B, N, D) and (B, M, D).
    """
    import torch

    keys = [_by_head(block.to_qk(x), block.heads) for x in (first, second)]
    values = [_by_head(block.to_v(x), block.heads) for x in (first, second)]
    told = [
        attend(keys[0], keys[1], values[1]),
        attend(keys[1], keys[0], values[0]),
    ]
    found = []
    for descriptors, message in zip((first, second), told, strict=True):
        merged = block.to_out(message.transpose(1, 2).flatten(start_dim=-2))
        change = block.ffn(torch.cat([descriptors, merged], -1))
        found.append(descriptors + change)
    return found[0], found[1]


def _by_head(descriptors: Tensor, num_heads: int) -> Tensor:
    """Return (B, N, D) descriptors as (B, H, N, D / H)."""
    size, number, length = descriptors.shape
    parts = descriptors.reshape(size, number, num_heads, length // num_heads)
    return parts.transpose(1, 2).contiguous()


def kornia_name(name: str) -> str:
    """Return kornia's name of a parameter in the files of LightGlue's authors.

    >>> kornia_name("self_attn.3.out_proj.bias")
    'transformers.3.self_attn.out_proj.bias'
    """
    return re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", name)


def network_inputs(
    features: LocalFeatures, image_size: tuple[int, int]
) -> dict[str, Tensor]:
    """Return what the network reads of one view, in pixel-centre px as in training.

    The image has ``image_size``, (width, height) in px.
    """
    points = features.keypoints
    size = np.asarray(image_size, np.float64)
    if features.rectification_ids[0]:
        points, size = unwarped_points(features.lafs)
    return {
        "keypoints": _as_batch(np.clip(points, 0.0, size)),
        "image_size": _as_batch(size),
        "descriptors": _as_batch(features.descriptors),
    }


def _as_batch(array: Floats) -> Tensor:
    """Return an array as a float32 batch of one."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(array, np.float32))[None]


def unwarped_points(lafs: Array) -> tuple[Array, Array]:
    """Return the positions of features in the warp that they were detected in.

    Their LAFs were carried back into the image: circles of one radius became the linear part of
    the warp.

    Args:
        lafs: (N, 2, 3) in px of the image.

    Returns:
        (N, 2) points in px of the warp, and its (width, height): as far as the points reach.
    """
    shapes = of_unit_area(lafs[:, :, :2])
    (linear,) = of_unit_area(shapes.mean(axis=0, keepdims=True))
    points = (np.linalg.inv(linear) @ lafs)[:, :, 2]
    low = points.min(axis=0)
    high = points.max(axis=0)
    return points - low, high - low + 1.0


def most_similar_views(
    first: Sequence[PreparedView], second: Sequence[PreparedView], count: int
) -> list[tuple[PreparedView, PreparedView]]:
    """Return the pairs of views with most mutual nearest neighbours among all features.

    Args:
        first: views of image 1.
        second: views of image 2.
        count: pairs of views to return, at most as many as there are.

    Returns:
        Pairs of views, the most similar ones first.
    """
    descriptors1, views1 = _descriptors_and_views(first)
    descriptors2, views2 = _descriptors_and_views(second)
    nearest2 = _nearest(descriptors1, descriptors2)
    nearest1 = _nearest(descriptors2, descriptors1)
    is_mutual = nearest1[nearest2] == np.arange(len(views1))
    num_mutual = np.zeros((len(first), len(second)), np.int64)
    mutual_views = (views1[is_mutual], views2[nearest2[is_mutual]])
    np.add.at(num_mutual, mutual_views, 1)
    order = np.argsort(-num_mutual, axis=None, kind="stable")
    numbers1, numbers2 = np.divmod(order[:count], len(second))
    return [(first[i], second[j]) for i, j in zip(numbers1, numbers2, strict=True)]


def _descriptors_and_views(views: Sequence[PreparedView]) -> tuple[Singles, Indices]:
    """Return (N, D) descriptors of all views, and (N,) the number of the view of each."""
    descriptors = [view.inputs["descriptors"][0].numpy() for view in views]
    counts = [len(view.rows) for view in views]
    return np.concatenate(descriptors), np.repeat(np.arange(len(views)), counts)


def _nearest(queries: Singles, descriptors: Singles) -> Indices:
    """Return the most similar of (M, D) descriptors for each of (N, D) queries."""
    nearest = []
    for begin in range(0, len(queries), CHUNK_ROWS):
        cosines = queries[begin : begin + CHUNK_ROWS] @ descriptors.T
        nearest.append(cosines.argmax(axis=1))
    return np.concatenate(nearest)


def merged_matches(
    parts: list[Matches], keypoints1: Array, keypoints2: Array
) -> Matches:
    """Merge matches of several pairs of views: one to one, and one match at each position.

    Args:
        parts: matches of pairs of views; of several that exclude each other the best score stays.
        keypoints1: (N, 2) px of all features of image 1.
        keypoints2: (M, 2) px of all features of image 2.

    Returns:
        The matches of both images.
    """
    if not any(len(part.scores) for part in parts):
        return Matches.none()
    indices = np.concatenate([part.indices for part in parts])
    scores = np.concatenate([part.scores for part in parts])
    by_score = np.argsort(-scores, kind="stable")
    indices = indices[by_score]
    scores = scores[by_score]
    for column in (0, 1):
        _, best_of_feature = np.unique(indices[:, column], return_index=True)
        kept = np.sort(best_of_feature)
        indices = indices[kept]
        scores = scores[kept]
    points1 = keypoints1[indices[:, 0]]
    points2 = keypoints2[indices[:, 1]]
    kept = np.flatnonzero(without_duplicates(points1, points2, DUPLICATE_RADIUS_PX))
    rising = kept[np.argsort(indices[kept, 0])]
    return Matches(indices[rising], scores[rising])
