"""Matching by short lists: the matches are those of exact cosines."""

from __future__ import annotations

import importlib
import itertools
import threading

import numpy as np
import pytest
from numpy.typing import NDArray
from synthetic import unit_rows

from colmap_affrect.data import LocalFeatures
from colmap_affrect.matchers import nearest_8bit as coarse
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext
from colmap_affrect.matchers.nearest import NearestNeighbors, NearestOptions
from colmap_affrect.matchers.nearest_8bit import coarse_pays, has_fast_8_bit_products


@pytest.fixture(autouse=True)
def _on_any_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    if not has_fast_8_bit_products():
        monkeypatch.setattr(coarse, "_packed", coarse._filled_up)
        monkeypatch.setattr(coarse, "_cosine_codes", cosine_codes)


def cosine_codes(
    codes1: NDArray[np.int8], codes2: NDArray[np.int8], unit: float
) -> NDArray[np.uint8]:
    products = codes1.astype(np.int32) @ codes2.astype(np.int32).T
    return np.clip(np.rint(unit / coarse.CODE_STEP * products), 0, 255).astype(np.uint8)


def crowded_views(
    seed: int, noise: float, *, signed: bool
) -> list[tuple[NDArray, NDArray]]:
    """350 and 450 features, of which 250 are the same; some are repeated beside themselves."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(550, 128)) if signed else rng.gamma(0.4, size=(550, 128))
    places = rng.uniform(0, 180, (550, 2))
    rows[150:180] = rows[:30] * (1 + 0.02 * rng.normal(size=(30, 128)))
    places[150:180] = places[:30] + 1.0
    views = []
    for chosen in (slice(0, 350), slice(100, 550)):
        seen = rows[chosen] + noise * np.abs(rows).mean() * rng.normal(
            size=rows[chosen].shape
        )
        views.append(
            (unit_rows(seen if signed else np.abs(seen)), places[chosen] * (1.0, 0.8))
        )
    return views


def require_exact(views: list[tuple[NDArray, NDArray]], options: NearestOptions) -> int:
    """Compare with the matches of exact cosines; return how many there are."""
    images = []
    for descriptors, places in views:
        lafs = np.dstack([np.broadcast_to(np.eye(2), (len(places), 2, 2)), places])
        features = LocalFeatures(lafs, np.ones(len(places), np.float32), descriptors)
        images.append(ImageFeatures(features, (99, 99), ""))
    matchers = [NearestNeighbors(options, MatcherContext()) for _ in range(2)]
    matchers[0].is_coarse = True
    found, exact = (
        matcher.match(*map(matcher.prepare, images)) for matcher in matchers
    )
    np.testing.assert_array_equal(found.indices, exact.indices)
    np.testing.assert_allclose(found.scores, exact.scores, atol=1e-4)
    return len(exact.indices)


@pytest.mark.parametrize("options", [
    NearestOptions(),
    NearestOptions(max_ratio=0.97, ratio_both_ways=False),
    NearestOptions(max_ratio=0.9, min_contrast_distance_px=40.0),
], ids=str)  # fmt: skip
@pytest.mark.parametrize("noise", [0.3, 1.0])
@pytest.mark.parametrize("signed", [False, True])
def test_matches_are_those_of_exact_cosines(
    options: NearestOptions, noise: float, signed: bool
) -> None:
    assert 30 < require_exact(crowded_views(3, noise, signed=signed), options) < 260


def test_ambiguous_copies_do_not_hide_a_match() -> None:
    # The query is nearest to feature 0 or 1, copies of each other. Feature 2, a bit less similar,
    # is a rival of 1 only: with 1 as the nearest the ratio is small, with 0 it is near 1.
    options = NearestOptions(ratio_both_ways=False, min_contrast_distance_px=10.0)
    angles = np.arccos([0.5999, 0.6, 0.597, 0.3])
    others = np.zeros((4, 128), np.float32)
    others[:, 0] = np.cos(angles)
    others[np.arange(4), 1 + np.arange(4)] = np.sin(angles)
    query = np.zeros((1, 128), np.float32)
    query[0, 0] = 1.0
    places = np.array([(0.0, 0.0), (8.0, 0.0), (16.0, 0.0), (99.0, 0.0)])
    for order in itertools.permutations(range(4)):
        views = [(query, np.zeros((1, 2))), (others[list(order)], places[list(order)])]
        assert require_exact(views, options) == 1


@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (1, 1), (1, 7), (300, 1)])
def test_few_features(counts: tuple[int, int]) -> None:
    rng = np.random.default_rng(7)
    views = [
        (unit_rows(rng.gamma(0.4, size=(n, 128))), rng.uniform(0, 99, (n, 2)))
        for n in counts
    ]
    require_exact(views, NearestOptions())


def test_coarse_descriptors_are_made_where_they_pay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(coarse, "available_cores", lambda: 3)
    monkeypatch.setattr(coarse, "has_fast_8_bit_products", lambda: True)
    assert not coarse_pays(1.7e9)
    assert coarse_pays(1.9e9)
    monkeypatch.setattr(coarse, "has_fast_8_bit_products", lambda: False)
    assert not coarse_pays(1e15)


def test_torch_without_the_products_matches_exactly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their operators are not part of torch's public interface and may go or change."""

    class Namespace:
        def __getattr__(self, name: str) -> object:
            raise AttributeError(
                f"'_OpNamespace' 'onednn' object has no attribute '{name}'"
            )

    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: "AVX512")
    monkeypatch.setattr("torch.ops.onednn", Namespace(), raising=False)
    has_fast_8_bit_products.cache_clear()
    matcher = NearestNeighbors(
        NearestOptions(), MatcherContext(device="cpu", num_comparisons=1e15)
    )
    has_fast_8_bit_products.cache_clear()
    features = LocalFeatures.empty(128)
    image = matcher.prepare(ImageFeatures(features, (32, 32), "rootsift"))
    assert image.features.coarse is None


def test_torch_is_loaded_meanwhile_where_there_will_be_enough_to_match(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loaded = threading.Event()
    monkeypatch.setattr(importlib, "import_module", lambda _: loaded.set())
    monkeypatch.setattr(coarse, "available_cores", lambda: 2)

    NearestOptions().load_meanwhile(num_pairs=10)
    assert not loaded.wait(0.01)
    NearestOptions().load_meanwhile(num_pairs=30)
    assert loaded.wait(5.0)
