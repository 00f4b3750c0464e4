"""Which images show the same, by one vector per image (VLAD).

The vocabulary is of descriptors of the images themselves. An image is the sums of differences of
its descriptors to their nearest words (Jegou et al. 2010), each of unit length and damped by square
roots (Arandjelovic and Zisserman 2013), less what all images have in common.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.arrays import Indices, Singles
from colmap_affrect.pairs.lists import Pair, most_similar_pairs
from colmap_affrect.progress import Progress

NUM_WORDS = 256  # resource
# The vocabulary of larger sets is built from that many of their images; resource
NUM_SAMPLED_IMAGES = 512
NUM_SAMPLES = 1 << 15  # descriptors that the vocabulary is built from; resource
NUM_ITERATIONS = 10  # resource
# Compared with as many others at a time, which bounds memory; resource
VECTORS_AT_ONCE = 512
# Parts of as many vectors that are kept when they are centered, 64 MiB each: enough for those of
# 2,048 images; resource
NUM_CENTERED_PARTS = 4


def build_vocabulary(samples: Singles, random: np.random.Generator) -> Singles:
    """Find (K, D) words of (M, D) descriptors by k-means, ``NUM_WORDS`` or as many as there are."""
    words = random.permutation(samples)[:NUM_WORDS]
    if len(samples) <= len(words):
        return words
    labels = nearest_words(samples, words).astype(np.int32)
    ends = (cv2.TERM_CRITERIA_MAX_ITER, NUM_ITERATIONS, 0.0)
    found = cv2.kmeans(
        samples, len(words), labels, ends, 1, cv2.KMEANS_USE_INITIAL_LABELS
    )
    return np.asarray(found[2], dtype=np.float32)


def nearest_words(descriptors: Singles, vocabulary: Singles) -> Indices:
    """Return the (N,) nearest of (K, D) words to (N, D) descriptors."""
    half_squares = 0.5 * np.einsum("kd,kd->k", vocabulary, vocabulary)
    return np.asarray((descriptors @ vocabulary.T - half_squares).argmax(axis=1))


def image_vector(descriptors: Singles, vocabulary: Singles) -> NDArray[np.float16]:
    """Describe (N, D) descriptors by (K, D) words: (K * D,) of unit length, or zeros."""
    words = nearest_words(descriptors, vocabulary)
    sums = _unit_rows(_sums(descriptors - vocabulary[words], words, len(vocabulary)))
    damped = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray(_unit_rows(damped.reshape(1, -1))[0], dtype=np.float16)


def _sums(rows: Singles, words: Indices, num_words: int) -> Singles:
    """Add up the (N, D) rows of each word; (K, D), zeros where there are none."""
    order = np.argsort(words, kind="stable")
    present, begins = np.unique(words[order], return_index=True)
    sums = np.zeros((num_words, rows.shape[1]), np.float32)
    if len(rows):
        sums[present] = np.add.reduceat(rows[order], begins, axis=0)
    return sums


def similarities(vectors: NDArray[np.float16]) -> Iterator[Singles]:
    """Yield the (N,) cosines of each of (N, V) image vectors with all, the mean subtracted."""
    mean = vectors.mean(axis=0, dtype=np.float32)
    begins = range(0, len(vectors), VECTORS_AT_ONCE)

    @lru_cache(NUM_CENTERED_PARTS)
    def centered(begin: int) -> Singles:
        return _unit_rows(vectors[begin : begin + VECTORS_AT_ONCE] - mean)

    for begin in begins:
        queries = centered(begin)
        yield from np.concatenate(
            [queries @ centered(other).T for other in begins], axis=1
        )


def _unit_rows(rows: Singles) -> Singles:
    """Divide (N, V) rows by their lengths; rows of zeros stay."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, np.finfo(np.float32).tiny))


def retrieved_pairs(
    names: Sequence[str],
    read: Callable[[str], LocalFeatures],
    num_neighbors: int,
    progress: Progress,
) -> list[Pair]:
    """Return pairs of images that are alike as a whole.

    Args:
        names: of the images.
        read: returns the features of an image by its name.
        num_neighbors: of an image on average, see :func:`~.lists.most_similar_pairs`.
        progress: shows how many images are done.

    Returns:
        The pairs, sorted; none if all features are of warps.
    """
    random = np.random.default_rng(0)
    sampled = random.permutation(len(names))[:NUM_SAMPLED_IMAGES]
    num_each = math.ceil(NUM_SAMPLES / max(1, len(sampled)))
    samples = []
    with progress.stage("retrieval", len(sampled) + len(names), "images") as advance:
        for index in sampled:
            descriptors = _original_descriptors(read(names[index]))
            samples.append(random.permutation(descriptors)[:num_each])
            advance(1)
        vocabulary = build_vocabulary(np.concatenate(samples), random)
        if not len(vocabulary):
            return []
        vectors = np.empty((len(names), vocabulary.size), np.float16)
        for vector, name in zip(vectors, names, strict=True):
            vector[:] = image_vector(_original_descriptors(read(name)), vocabulary)
            advance(1)
    return most_similar_pairs(names, similarities(vectors), num_neighbors)


def _original_descriptors(features: LocalFeatures) -> Singles:
    """Return the (N, D) descriptors of the image itself; with those of warps recall is lower."""
    return np.asarray(
        features.descriptors[features.rectification_ids == 0], dtype=np.float32
    )
