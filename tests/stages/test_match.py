"""Matching of pairs: what is kept in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.pairs.lists import exhaustive_pairs
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.stages import match as stage
from colmap_affrect.stages.match import CachedMatcher, Matching, iterate_matches

NAMES = [f"{index}.png" for index in range(6)]
NUM_FEATURES = 50


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    """Images that show the same things, each a bit otherwise."""
    random = np.random.default_rng(0)
    things = random.gamma(0.4, size=(NUM_FEATURES, 128))
    store = FeatureStore(tmp_path / "features.h5")
    for name in NAMES:
        rows = things + 0.05 * random.random(things.shape)
        rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
        centers = random.uniform(10, 400, (NUM_FEATURES, 2))
        ones = np.ones(NUM_FEATURES)
        lafs = lafs_from_keypoints(centers, 6 * ones, 0 * ones)
        store.write(name, LocalFeatures(lafs, ones.astype(np.float32), rows), (420, 420))
    return store


def matches(store: FeatureStore) -> dict[tuple[str, str], list[list[int]]]:
    pairs = exhaustive_pairs(NAMES)
    found = list(iterate_matches(pairs, Matching(store, NearestOptions())))
    assert sorted(item.names for item in found) == pairs
    return {item.names: item.indices.tolist() for item in found}


def test_images_over_the_budget_are_dropped_and_the_matches_are_the_same(
    store: FeatureStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = matches(store)
    assert min(map(len, expected.values())) > NUM_FEATURES // 2
    reads: list[str] = []
    read = CachedMatcher._prepare

    def counted(cache: CachedMatcher, name: str) -> stage.PreparedImage:
        reads.append(name)
        return read(cache, name)

    monkeypatch.setattr(CachedMatcher, "_prepare", counted)
    monkeypatch.setattr(stage, "CACHE_BYTES", 5 * stage.BYTES_PER_FEATURE * NUM_FEATURES)
    assert matches(store) == expected
    assert len(NAMES) < len(reads) <= 3 * len(NAMES)
