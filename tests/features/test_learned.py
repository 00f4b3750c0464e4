"""Features aliked: what kornia computes, at the right places, under masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from kornia import feature
from numpy.testing import assert_allclose, assert_array_equal
from random_weights import write_random_weights

from colmap_affrect.errors import AffrectError
from colmap_affrect.features.base import EXTRACTORS, NetworkContext
from colmap_affrect.features.learned import Aliked
from colmap_affrect.features.weights import WEIGHT_FILES, find

COURTYARD = Path(__file__).resolve().parents[2] / "sample_scenes" / "courtyard"
SHARED_WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "weights"

ALL = 1_000_000
KEY = "aliked-n16"

MOST_OFFSET_PX = 0.45
"""By what the photographs show; half a pixel too much or too little is more."""

SAME_DESCRIPTOR = 1e-3
"""Sums in another order, where kornia's layout in memory is another."""


def make(weights: dict[str, Path], **options: object) -> Aliked:
    given = {"name": "aliked", "model": "n16", **options}
    return EXTRACTORS.make(EXTRACTORS.options(given), NetworkContext(weights))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """In colour, of sides that no network divides."""
    image = cv2.imread(str(COURTYARD / "images" / "court_4.jpg"))
    return np.ascontiguousarray(image[20:329, 30:451, ::-1])


@pytest.fixture
def published() -> dict[str, Path]:
    folder = SHARED_WEIGHTS if SHARED_WEIGHTS.is_dir() else None
    path = find(KEY, folder)
    if path is None:
        pytest.skip(
            f"{WEIGHT_FILES[KEY].file_name} is not here: see colmap-affrect weights"
        )
    return {KEY: path}


def by_kornia(path: Path, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points and descriptors as kornia's own classes compute them."""
    pixels = torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32))[None] / 255
    state = torch.load(path, map_location="cpu", weights_only=True)
    state = state.get("state_dict", state)
    with torch.inference_mode():
        network = feature.ALIKED(KEY).eval()
        network.load_state_dict(state, strict=False)
        found = network(pixels)[0]
    return found.keypoints.numpy(), found.descriptors.numpy()


def test_features_are_those_of_kornia(weights, photograph) -> None:
    """Up to rounding, which may decide whether a pixel is a maximum."""
    image = photograph[:150, :221]
    features = make(weights, max_num_features=ALL).detect((image, None))
    points, descriptors = by_kornia(weights[KEY], image)
    assert len(features) > 100
    assert abs(len(features) - len(points)) <= 0.01 * len(points)
    shift = np.linalg.norm(features.keypoints[:, None] - points[None], axis=2)
    same = features.descriptors @ descriptors.T
    nearest = np.where(shift < 2, same, -1.0).argmax(axis=1)
    offsets = features.keypoints - points[nearest]
    as_kornia = np.abs(offsets - np.median(offsets, axis=0)).max(axis=1) < 0.01
    as_kornia &= (
        np.abs(features.descriptors - descriptors[nearest]).max(axis=1)
        < SAME_DESCRIPTOR
    )
    assert as_kornia.mean() > 0.99


@pytest.mark.long
def test_points_are_where_they_are_in_a_shrunk_photograph(published) -> None:
    """A constant offset in px of the view is another place in the photograph when it is shrunk."""
    extractor = make(published)
    offsets = []
    for path in sorted((COURTYARD / "images").iterdir())[:3]:
        image = np.ascontiguousarray(cv2.imread(str(path))[:480, :640, ::-1])
        small = cv2.resize(image, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        scale = np.array(small.shape[1::-1]) / image.shape[1::-1]
        first = extractor.detect((image, None))
        second = extractor.detect((small, None))
        points = (second.keypoints + 0.5) / scale - 0.5
        distances = np.linalg.norm(first.keypoints[:, None] - points[None], axis=2)
        nearest = distances.argmin(axis=1)
        rows = np.arange(len(first))
        again = (distances.argmin(axis=0)[nearest] == rows) & (
            distances[rows, nearest] < 4.0
        )
        again &= (first.descriptors * second.descriptors[nearest]).sum(axis=1) > 0.7
        offsets.append((points[nearest] - first.keypoints)[again] * 3.0)
    assert np.linalg.norm(np.concatenate(offsets).mean(axis=0)) < MOST_OFFSET_PX


def test_mask_chooses_among_what_is_found_without_it(weights, photograph) -> None:
    part = photograph[:150, :221]
    mask = np.zeros(part.shape[:2], np.uint8)
    mask[:, 60:] = 255
    whole = make(weights, score_threshold=0.001, max_num_features=ALL).detect(
        (part, None)
    )
    few = make(weights, score_threshold=0.001, max_num_features=30).detect((part, mask))
    inside = whole.select(np.rint(whole.keypoints[:, 0]) >= 60)
    assert len(inside) < len(whole)
    assert_array_equal(few.keypoints, inside.keypoints[:30])
    assert_allclose(few.descriptors, inside.descriptors[:30], atol=1e-5)
    assert (np.diff(few.responses) <= 0).all()
    assert_allclose(
        few.lafs[:, :, :2], np.tile(12.0 * np.eye(2), (30, 1, 1)), atol=1e-9
    )


def test_files_of_other_networks_are_refused(weights, tmp_path) -> None:
    broken = tmp_path / "broken"
    broken.write_bytes(weights[KEY].read_bytes()[:4000])
    for path, message in (
        (weights["hardnet"], "not the weights of aliked-n16"),
        (broken, "broken: "),
    ):
        with pytest.raises(AffrectError, match=message):
            make({KEY: path})
