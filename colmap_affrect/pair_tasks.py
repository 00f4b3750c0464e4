"""Matching of the pairs of a run, in threads of this process or on the workers of a cluster.

Workers read features from shared storage. Where they do not see the file, those of its two images
travel with each pair.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.executor import Executor, Threads, available_cores, unless_gpu_is_full
from colmap_affrect.matching.coarse import coarse_descriptors
from colmap_affrect.matching.nearest import (
    MatchableImage,
    PutativeMatches,
    match_features,
    matchable,
)
from colmap_affrect.matching.pairs import Pair, ordered_for_reuse
from colmap_affrect.options import MatchingOptions
from colmap_affrect.store import FeatureStore, PairMatches

logger = logging.getLogger(__name__)

MATCHING_CACHE_BYTES = 1 << 29
BYTES_PER_FEATURE = 870
"""Of a feature ready for matching: measured 830 to 870 for descriptors of 128 with coarse ones."""

Found = TypeVar("Found")


def iterate_matches(
    pairs: Sequence[Pair],
    features: FeatureStore,
    options: MatchingOptions,
    level: int,
    device: str = "auto",
    executor: Executor | None = None,
) -> Generator[PairMatches, None, None]:
    """Match pairs by the features of the images themselves and those of one level.

    They come in an order in which images that are read stay in memory for most of their pairs.

    Args:
        pairs: names of images.
        features: of the images; workers that do not see the file get those of each pair.
        options: of matching.
        level: of escalation.
        device: of similarities.
        executor: where; by default in a thread for each core.
    """
    if not pairs:
        return
    executor = executor or Threads(available_cores())
    store = FeatureStore(features.path.absolute(), features.options_digest)
    counts = store.num_keypoints()
    num_similarities = sum(counts[first] * counts[second] for first, second in pairs)
    num_kept = MATCHING_CACHE_BYTES * len(counts) // (BYTES_PER_FEATURE * sum(counts.values()) + 1)
    cache = MatchableCache(store, options, level, None, num_similarities, device)
    files = [store.path]
    is_shared = executor.sees(files)
    tasks = (
        PairTask(pair, None if is_shared else (cache.stored(pair[0]), cache.stored(pair[1])))
        for pair in ordered_for_reuse(pairs, max(1, num_kept // 2))
    )
    yield from executor.map(MatchPair(cache), tasks, files if is_shared else ())


@dataclass(frozen=True)
class StoredFeatures:
    """What matching takes from the store for one image.

    Attributes:
        descriptors: (N, D) float16 rows of unit length.
        keypoints: (N, 2) pixel-centre px.
        indices: (N,) int64 that the features have in the store.
    """

    descriptors: NDArray[np.float16]
    keypoints: NDArray[np.floating]
    indices: NDArray[np.int64]


@dataclass(frozen=True)
class PairTask:
    """One pair to match; the features of its images where the worker does not see their file."""

    names: Pair
    sent: tuple[StoredFeatures, StoredFeatures] | None

    def __str__(self) -> str:
        return " and ".join(self.names)


@dataclass(frozen=True)
class MatchPair:
    """What is done for one pair."""

    cache: MatchableCache

    def __call__(self, task: PairTask) -> PairMatches:
        """Match by the features that came with the task, or by those in the store."""
        if task.sent:
            images = [self.cache.prepared(stored) for stored in task.sent]
        else:
            images = [self.cache[name] for name in task.names]
        (first, indices1), (second, indices2) = images
        found = self.cache.match(first, second)
        rows, columns = found.indices.T
        indices = np.stack([indices1[rows], indices2[columns]], axis=1)
        count = int(indices1.max(initial=-1)) + 1
        return PairMatches(task.names, indices, 1.0 - found.ratios, count, self.cache.level)


class MatchableCache:
    """Images ready for matching, the least recently used dropped over a memory budget.

    Each comes with the indices that its features have in the store. In another process (pickled)
    it is empty at first.

    Attributes:
        options: of matching.
        level: of escalation.
    """

    def __init__(
        self,
        store: FeatureStore,
        options: MatchingOptions,
        level: int,
        max_num_features: int | None = None,
        num_similarities: int = 0,
        device: str = "auto",
    ) -> None:
        """Name the features.

        Args:
            store: where they are.
            options: of matching.
            level: of escalation; its features come together with those of level 0.
            max_num_features: of the features of an image, those of the largest responses; None
                takes all.
            num_similarities: about how many there will be to compute, to choose the way.
            device: of similarities.
        """
        self.options, self.level = options, level
        self._num_similarities, self._device = num_similarities, device
        self._make_coarse = coarse_descriptors(num_similarities, device)
        self._store, self._max_num_features = store, max_num_features
        self._images: OrderedDict[str, tuple[MatchableImage, NDArray[np.int64]]] = OrderedDict()
        self._lock = threading.Lock()
        self._unsaid = threading.Lock()

    def __reduce__(self) -> tuple[type[MatchableCache], tuple[Any, ...]]:
        return MatchableCache, (
            self._store,
            self.options,
            self.level,
            self._max_num_features,
            self._num_similarities,
            self._device,
        )

    def stored(self, name: str) -> StoredFeatures:
        """Read the features of an image."""
        indices = self._store.level_indices(name, self.level)
        features = self._store.read(name).select(indices)
        if self._max_num_features is not None:
            order = np.argsort(-features.responses, kind="stable")
            strongest = np.sort(order[: self._max_num_features])
            indices, features = indices[strongest], features.select(strongest)
        return StoredFeatures(features.descriptors.astype(np.float16), features.keypoints, indices)

    def prepared(self, stored: StoredFeatures) -> tuple[MatchableImage, NDArray[np.int64]]:
        """Make features ready for matching; they are not kept."""
        with_gpu, without = (
            partial(matchable, stored.descriptors, stored.keypoints, self.options, make_coarse)
            for make_coarse in (self._make_coarse, None)
        )
        return self._without_gpu_if_full(with_gpu, without), stored.indices

    def match(self, image1: MatchableImage, image2: MatchableImage) -> PutativeMatches:
        """Match two images; without the GPU, with the same result, if its memory is full."""
        exact1, exact2 = (replace(image, coarse=None) for image in (image1, image2))
        return self._without_gpu_if_full(
            partial(match_features, image1, image2, self.options),
            partial(match_features, exact1, exact2, self.options),
        )

    def _without_gpu_if_full(
        self, with_gpu: Callable[[], Found], without: Callable[[], Found]
    ) -> Found:
        def say_and_go_on() -> Found:
            if self._unsaid.acquire(blocking=False):  # never released: said once
                logger.warning("the memory of the GPU is full; the CPU matches the rest")
            return without()

        return unless_gpu_is_full(with_gpu, say_and_go_on)

    def __getitem__(self, name: str) -> tuple[MatchableImage, NDArray[np.int64]]:
        with self._lock:
            if name not in self._images:
                self._images[name] = self.prepared(self.stored(name))
            self._images.move_to_end(name)
            while self._num_bytes() > MATCHING_CACHE_BYTES and len(self._images) > 1:
                self._images.popitem(last=False)
            return self._images[name]

    def _num_bytes(self) -> int:
        return sum(image.num_bytes for image, _ in self._images.values())
