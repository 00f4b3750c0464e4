"""Matching of pairs: what is kept in memory."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import Call
from results import database_content
from small_scene import NAMES as PHOTOGRAPHS
from synthetic import unit_rows

from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import AffrectError, StoreError
from colmap_affrect.features.weights import WEIGHT_FILES
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.matchers.lightglue import LightGlueOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.pairs.lists import exhaustive_pairs
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import MatchStore, PairMatches
from colmap_affrect.project.record import file_sha256
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.context import Context, Resources
from colmap_affrect.stages import match as stage
from colmap_affrect.stages.match import (
    MANY_MATCHES,
    CachedMatcher,
    Matching,
    iterate_matches,
    load_matchers,
    not_well_tied,
)

NAMES = [f"{index}.png" for index in range(6)]
NUM_FEATURES = 50


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    """Images that show the same things, each a bit otherwise."""
    random = np.random.default_rng(0)
    things = random.gamma(0.4, size=(NUM_FEATURES, 128))
    store = FeatureStore(tmp_path / "features.h5")
    for name in NAMES:
        rows = unit_rows(things + 0.05 * random.random(things.shape))
        centers = random.uniform(10, 400, (NUM_FEATURES, 2))
        ones = np.ones(NUM_FEATURES)
        lafs = lafs_from_keypoints(centers, 6 * ones, 0 * ones)
        store.write(
            name, LocalFeatures(lafs, ones.astype(np.float32), rows), (420, 420)
        )
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
    monkeypatch.setattr(
        stage, "CACHE_BYTES", 5 * stage.BYTES_PER_FEATURE * NUM_FEATURES
    )
    assert matches(store) == expected
    assert len(NAMES) < len(reads) <= 3 * len(NAMES)


def test_threads_make_each_image_ready_once_and_several_at_a_time(
    store: FeatureStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    both_at_work = threading.Barrier(2, timeout=20.0)
    reads: list[str] = []
    read = CachedMatcher._prepare

    def counted(cache: CachedMatcher, name: str) -> stage.PreparedImage:
        both_at_work.wait()
        reads.append(name)
        return read(cache, name)

    monkeypatch.setattr(CachedMatcher, "_prepare", counted)
    matcher = CachedMatcher(Matching(store, NearestOptions()))
    wanted = [*NAMES[:2], *NAMES[:2]]
    with ThreadPoolExecutor(len(wanted)) as threads:
        images = list(threads.map(matcher.prepared, wanted))
    assert sorted(reads) == sorted(NAMES[:2])
    assert images[0] is images[2]


def test_images_whose_features_have_gone_meanwhile_are_named(
    store: FeatureStore,
) -> None:
    pairs = exhaustive_pairs(NAMES)
    store.remove(NAMES[4:])
    with pytest.raises(
        StoreError, match=r"features\.h5: no features of 4\.png, 5\.png"
    ):
        list(iterate_matches(pairs, Matching(store, NearestOptions())))


def test_the_strongest_features_are_matched_first(store: FeatureStore) -> None:
    features = store.read(NAMES[0])
    responses = np.roll(np.arange(1.0, NUM_FEATURES + 1), 7).astype(np.float32)
    store.write(
        NAMES[0], replace(features, responses=responses), store.image_size(NAMES[0])
    )
    pair = (NAMES[0], NAMES[1])
    (every,) = iterate_matches([pair], Matching(store, NearestOptions()))
    (some,) = iterate_matches(
        [pair], Matching(store, NearestOptions(), max_num_features=30)
    )
    strongest = np.argsort(-responses)[:30]
    assert (every.of_some, some.of_some) == (False, True)
    assert len(some.indices) > 5
    assert set(some.indices[:, 0]) <= set(strongest)
    assert set(every.indices[:, 0]) - set(strongest)
    assert some.num_keypoints1 == every.num_keypoints1 == NUM_FEATURES


def test_all_features_are_matched_where_the_strongest_do_not_tie_both_images(
    tmp_path: Path,
) -> None:
    """Images a and b have three pairs with many matches, c, d and e two, then c and e three."""

    def pair(names: str, num: int, *, of_some: bool = True) -> PairMatches:
        indices = np.stack([np.arange(num)] * 2, axis=1)
        scores = np.ones(num, np.float32)
        return PairMatches((names[0], names[1]), indices, scores, num, of_some=of_some)

    store = MatchStore(tmp_path / "matches.h5")
    many = [
        pair(names, MANY_MATCHES)
        for names in ("ab", "ac", "ad", "bc", "bd", "eb", "ea")
    ]
    few = [pair(names, MANY_MATCHES - 1) for names in ("cd", "ce", "fa")]
    known = [pair("ga", 5, of_some=False)]
    store.write([*many, *few, *known])
    pairs = [found.names for found in (*many, *few, *known)]
    assert not_well_tied(store, pairs) == [("c", "d"), ("c", "e"), ("f", "a")]
    store.write([pair("ec", MANY_MATCHES), pair("cd", 9, of_some=False)])
    assert not_well_tied(store, [*pairs, ("e", "c")]) == [("f", "a")]


@pytest.mark.long
def test_all_features_are_matched_once_a_pair_that_tied_an_image_is_not_listed(
    photos: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then the database has these matches, too."""
    monkeypatch.setattr(stage, "MANY_MATCHES", 140)
    monkeypatch.setattr(stage, "NUM_WELL_TIED", 1)
    out = tmp_path / "out"
    (a, b, c, _) = PHOTOGRAPHS
    where = ["--output-path", out]
    assert (
        call("extract", "--image-path", photos, *where, "--recipe", "rectified").code
        == 0
    )
    listed = tmp_path / "list.txt"
    pairs = exhaustive_pairs(PHOTOGRAPHS)
    listed.write_text(
        "".join(f"{one}\t{two}\n" for one, two in pairs), encoding="utf-8"
    )
    assert call("pairs", *where, "--match-list-path", listed).code == 0
    assert call("match", *where, "--set", "matching.max_num_first=300").code == 0
    store = MatchStore(out / "matches.h5")
    few = len(next(store.read([(a, c)])).indices)
    assert set(store.nums_of_some(pairs)) == {(a, b), (a, c), (b, c)}
    listed.write_text(f"{a}\t{c}\n{b}\t{c}\n", encoding="utf-8")
    assert call("pairs", *where, "--match-list-path", listed).code == 0
    assert call("match", *where).code == 0
    many = next(store.read([(a, c)])).indices
    assert len(many) > 2 * few
    assert database_content(out / "database.db")["raw matches"][a, c] == len(many)


@pytest.mark.long
@pytest.mark.parametrize(("growth", "are_left"), [(1.1, False), (1e9, True)])
def test_all_features_are_not_matched_where_a_sample_of_pairs_gains_nothing(
    photos: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, growth: float,
    are_left: bool,
) -> None:  # fmt: skip
    """Which is on record: the same command says so again. No pair is matched twice by all."""
    matched = list[tuple[str, str]]()
    match_pair = CachedMatcher.__call__

    def counted(matcher: CachedMatcher, names: tuple[str, str]) -> PairMatches:
        if not matcher._matching.max_num_features:
            matched.append(names)
        return match_pair(matcher, names)

    monkeypatch.setattr(CachedMatcher, "__call__", counted)
    monkeypatch.setattr(stage, "NUM_TRIED", 2)
    monkeypatch.setattr(stage, "MIN_GROWTH", growth)
    out = tmp_path / "out"
    assert call("extract", "--image-path", photos, "--output-path", out).code == 0
    assert call("pairs", "--output-path", out).code == 0
    for _ in range(2):
        assert (
            call(
                "match", "--output-path", out, "--set", "matching.max_num_first=300"
            ).code
            == 0
        )
        store = MatchStore(out / "matches.h5")
        assert bool(store.nums_of_some(exhaustive_pairs(PHOTOGRAPHS))) == are_left
        assert len(set(matched)) == len(matched) > 0
        monkeypatch.setattr(stage, "MIN_GROWTH", 0.0)


def test_only_networks_of_files_that_are_not_the_published_ones_are_built_beforehand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published = WEIGHT_FILES["lightglue-aliked"]
    path = tmp_path / published.file_name
    path.write_bytes(b"no network")
    context = Context(Workspace(tmp_path / "out"), Resources(weights_path=tmp_path))
    extraction = load_recipe("aliked-lightglue").extraction
    with pytest.raises(AffrectError, match="not a file of weights"):
        load_matchers(context, extraction, LightGlueOptions())
    as_published = replace(published, sha256=file_sha256(path))
    monkeypatch.setitem(WEIGHT_FILES, "lightglue-aliked", as_published)
    found = load_matchers(context, extraction, LightGlueOptions())
    assert found == {"lightglue-aliked": path}
