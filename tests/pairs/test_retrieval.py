"""Image vectors against plain loops, and whether images of one place find each other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from synthetic import unit_rows

from colmap_affrect.pairs import retrieval
from colmap_affrect.pairs.lists import most_similar_pairs
from colmap_affrect.pairs.retrieval import (
    build_vocabulary,
    image_vector,
    nearest_words,
    similarities,
)

SIZE = 32


def images_of_places(
    counts: list[int], seed: int
) -> tuple[list[NDArray[np.float32]], list[int]]:
    """Descriptors of so many images of each place: half of an image is what the place has."""
    random = np.random.default_rng(seed)
    images = []
    places = []
    for place, count in enumerate(counts):
        structure = random.random((200, SIZE))
        for _ in range(count):
            seen = random.choice(structure, 100, replace=False) + random.normal(
                0, 0.1, (100, SIZE)
            )
            images.append(unit_rows(np.concatenate([seen, random.random((100, SIZE))])))
            places.append(place)
    return images, places


def vectors_of(images: list[NDArray[np.float32]]) -> NDArray[np.float16]:
    """Vectors of images by a vocabulary of their own."""
    random = np.random.default_rng(0)
    vocabulary = build_vocabulary(np.concatenate(images), random)
    return np.stack([image_vector(image, vocabulary) for image in images])


def test_images_of_one_place_find_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrieval, "NUM_WORDS", 64)
    images, places = images_of_places([8, 3, 5, 4], 0)
    place_of = {}
    shuffled = []
    for number, index in enumerate(np.random.default_rng(0).permutation(len(images))):
        place_of[f"{number:02d}"] = places[index]
        shuffled.append(images[index])
    pairs = most_similar_pairs(list(place_of), similarities(vectors_of(shuffled)), 5)
    num_right = 0
    for first, second in pairs:
        num_right += place_of[first] == place_of[second]
    assert len(pairs) == 50
    assert num_right >= 45  # of 28 + 3 + 10 + 6 = 47 that there are


def test_vector_is_that_of_a_plain_loop() -> None:
    random = np.random.default_rng(1)
    vocabulary = unit_rows(random.random((5, 8)))
    descriptors = unit_rows(random.random((40, 8)))
    expected = np.zeros((5, 8))
    nearest = []
    for descriptor in descriptors:
        distances = np.linalg.norm(descriptor - vocabulary, axis=1)
        word = int(np.argmin(distances))
        nearest.append(word)
        expected[word] += descriptor - vocabulary[word]
    for word in set(nearest):
        expected[word] /= np.linalg.norm(expected[word])
    expected = np.sign(expected) * np.sqrt(np.abs(expected))
    expected /= np.linalg.norm(expected)
    assert nearest_words(descriptors, vocabulary).tolist() == nearest
    assert_allclose(image_vector(descriptors, vocabulary), expected.ravel(), atol=1e-3)


@pytest.mark.parametrize("at_once", [1, 3, 100])
def test_similarities_are_cosines_about_the_mean_however_many_at_once(
    at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "VECTORS_AT_ONCE", at_once)
    vectors = unit_rows(np.random.default_rng(7).random((7, 24)) + 0.5).astype(
        np.float16
    )
    centered = unit_rows(
        vectors.astype(np.float64) - vectors.astype(np.float64).mean(axis=0)
    )
    assert_allclose(
        np.stack(list(similarities(vectors))), centered @ centered.T, atol=2e-3
    )


def test_vectors_are_centered_once_where_parts_are_few(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    num_centered = 0
    unit_rows_of = retrieval._unit_rows

    def counted(rows: NDArray[np.float32]) -> NDArray[np.float32]:
        nonlocal num_centered
        num_centered += len(rows)
        return unit_rows_of(rows)

    monkeypatch.setattr(retrieval, "VECTORS_AT_ONCE", 2)
    monkeypatch.setattr(retrieval, "_unit_rows", counted)
    vectors = np.random.default_rng(7).random((8, 24)).astype(np.float16)
    assert len(list(similarities(vectors))) == num_centered == len(vectors)
    assert 2 <= retrieval.NUM_CENTERED_PARTS <= 16  # of 64 MiB each
