"""What is done for one pair, in a thread of this process or on a worker of a cluster."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np

from colmap_affrect.features.weights import digests, resolve
from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.matchers.base import (
    MATCHERS,
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
    Matches,
)
from colmap_affrect.pairs.base import Pair
from colmap_affrect.pairs.lists import ordered_for_reuse
from colmap_affrect.parallel.executor import Executor, Threads, available_cores
from colmap_affrect.project.stores import FeatureStore, PairMatches
from colmap_affrect.stages.context import Resources, require_same_files

CACHE_BYTES = 1 << 29  # memory that prepared images may take in a process
BYTES_PER_FEATURE = 870  # of a feature ready for matching, with descriptors of 128 and coarse ones


@dataclass(frozen=True)
class Matching:
    """What is matched, how, and with what."""

    store: FeatureStore  # of the features
    options: MatcherOptions  # of the matcher
    level: int = 0  # of escalation: its features, together with those of its base
    base: int = 0  # level that has the features of the images themselves
    extractor: str = ""  # kind of the features; empty for another program's
    resources: Resources = field(default_factory=Resources)  # weights and device
    num_similarities: float = 0  # about how many pairs of features there will be to compare


def iterate_matches(
    pairs: Sequence[Pair], matching: Matching, executor: Executor | None = None
) -> Generator[PairMatches, None, None]:
    """Match pairs, in an order in which an image, once read, stays in memory for most of its pairs.

    By default there is a thread for each core. AffrectError when workers do not see the file of
    features.
    """
    if not pairs:
        return
    executor = executor or Threads(available_cores())
    counts = matching.store.num_keypoints()
    num_similarities = sum(counts[first] * counts[second] for first, second in pairs)
    num_kept = CACHE_BYTES * len(counts) // (BYTES_PER_FEATURE * sum(counts.values()) + 1)
    matcher = CachedMatcher(replace(matching, num_similarities=num_similarities))
    ordered = ordered_for_reuse(pairs, max(1, num_kept // 2))
    yield from executor.map(matcher, ordered, [matching.store.path])


@dataclass(frozen=True)
class PreparedImage:
    """An image ready for matching."""

    content: Any  # what the matcher made of it
    frames: Floats  # (N, 2, 3) local affine frames in pixel-centre px
    indices: Indices  # (N,) int64 that its features have in the store


Content = TypeVar("Content")


class ImageCache(Generic[Content]):
    """Keeps what is made of images, those used last, as many as ``CACHE_BYTES`` hold."""

    def __init__(self, make: Callable[[str], Content], nbytes: Callable[[Content], int]) -> None:
        """Say how to make what is missing, of the name of an image, and what memory it takes."""
        self._make, self._nbytes, self._lock = make, nbytes, threading.Lock()
        self._images: OrderedDict[str, Content] = OrderedDict()

    def get(self, name: str) -> Content:
        """Return what there is of an image; made one at a time."""
        with self._lock:
            if name not in self._images:
                self._images[name] = self._make(name)
            self._images.move_to_end(name)
            nbytes = sum(map(self._nbytes, self._images.values()))
            while nbytes > CACHE_BYTES and len(self._images) > 1:
                nbytes -= self._nbytes(self._images.popitem(last=False)[1])
            return self._images[name]


class CachedMatcher:
    """Matches pairs, and keeps the images that it has prepared; a copy elsewhere has none."""

    def __init__(self, matching: Matching) -> None:
        options, resources = matching.options, matching.resources
        options.require_extractor(matching.extractor)
        self._matching = matching
        self._weights = resolve(options.weights, resources.weights_path)
        context = MatcherContext(self._weights, resources.device, matching.num_similarities)
        self._matcher = MATCHERS.make(options, context)
        self._images = ImageCache(self._prepare, lambda image: int(image.content.nbytes))

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self._matching, digests(self._weights))

    def __call__(self, names: Pair) -> PairMatches:
        """Match the stored features of two images."""
        first, second = map(self.prepared, names)
        found = self.match(first, second)
        rows, columns = found.indices.T
        indices = np.stack([first.indices[rows], second.indices[columns]], axis=1)
        count = int(first.indices.max(initial=-1)) + 1
        return PairMatches(names, indices, found.scores, count, self._matching.level)

    def match(self, first: PreparedImage, second: PreparedImage) -> Matches:
        """Match two images; indices are those among the features that were prepared."""
        return self._matcher.match(first.content, second.content)

    def prepared(self, name: str) -> PreparedImage:
        """Return an image ready for matching."""
        return self._images.get(name)

    def _prepare(self, name: str) -> PreparedImage:
        matching, store = self._matching, self._matching.store
        indices = store.level_indices(name, matching.level, matching.base)
        features = store.read(name).select(indices)
        image = ImageFeatures(features, store.image_size(name), matching.extractor)
        return PreparedImage(self._matcher.prepare(image), features.lafs, indices)


def _rebuilt(matching: Matching, sent: Mapping[str, str]) -> CachedMatcher:
    matcher = CachedMatcher(matching)
    require_same_files(matcher._weights, sent)
    return matcher
