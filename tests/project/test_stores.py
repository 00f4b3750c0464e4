"""Features and matches come back as written, in hloc's layout, whatever happened to the writer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from colmap_affrect.data import LocalFeatures
from colmap_affrect.errors import StoreError
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.guided_store import GuidedPair, GuidedStore
from colmap_affrect.project.match_state import Begun, LearnedModels, MatchState
from colmap_affrect.project.match_store import (
    Learned,
    MatchStore,
    PairMatches,
    pair_key,
)
from colmap_affrect.stages.stationary import StationaryFilter

NAMES = ["a.png", "b c.png", "west wing/č ñ 图.jpg", "west wing/upper floor/a.png"]

FLOAT16_ROUNDING = 1e-3
"""Descriptors and scores are at most 1 in size and stored as float16."""


def some_features(count: int, seed: int = 0) -> LocalFeatures:
    rng = np.random.default_rng(seed)
    lafs = rng.uniform(0, 300, (count, 2, 3))
    lafs[:, :, :2] = np.eye(2) * rng.uniform(1, 50, (count, 1, 1)) + rng.normal(
        0, 0.1, (2, 2)
    )
    descriptors = rng.uniform(0.1, 1, (count, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    responses = rng.uniform(0.01, 1, count).astype(np.float32)
    return LocalFeatures(
        lafs, responses, descriptors, rng.integers(0, 9, count).astype(np.int32)
    )


def test_levels_of_other_features_are_kept_side_by_side(tmp_path: Path) -> None:
    """Shorter and longer descriptors; the photograph looked at again is no warp."""
    store = FeatureStore(tmp_path / "features.h5")
    first = some_features(4)
    short = some_features(3, seed=1)
    long = some_features(2, seed=2)
    short = replace(short, descriptors=short.descriptors[:, :64])
    wide = np.pad(long.descriptors, ((0, 0), (100, 0)))
    long = replace(long, descriptors=wide)
    store.write("a.png", first, (300, 200))
    store.extend(
        "a.png", replace(short, rectification_ids=np.array([0, 1, 0], np.int32)), 3
    )
    store.extend("a.png", long, 1)
    read = store.read("a.png")
    highest = first.rectification_ids.max()
    assert_array_equal(read.rectification_ids[4:7], [0, highest + 1, 0])
    assert_array_equal(store.level_indices("a.png", 1), [0, 1, 2, 3, 7, 8])
    assert_array_equal(store.level_indices("a.png", 1, base=3), [4, 5, 6, 7, 8])
    assert_array_equal(store.level_indices("a.png", 3, base=3), [4, 5, 6])
    assert store.level_ranges("a.png") == {0: range(4), 3: range(4, 7), 1: range(7, 9)}
    assert read.descriptors.shape == (9, 228)
    assert_allclose(
        read.descriptors[4:7, :64], short.descriptors, atol=FLOAT16_ROUNDING
    )
    assert not read.descriptors[4:7, 64:].any()
    assert_allclose(read.descriptors[7:], wide, atol=FLOAT16_ROUNDING)


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    return FeatureStore(tmp_path / "features.h5")


@pytest.fixture
def matches(tmp_path: Path) -> MatchStore:
    return MatchStore(tmp_path / "matches.h5")


@pytest.mark.parametrize("count", [0, 1, 40_000])
def test_features_are_read_as_written(store: FeatureStore, count: int) -> None:
    written = some_features(count)
    store.write("west wing/a.png", written, (320, 240))
    read = store.read("west wing/a.png")
    assert_array_equal(read.lafs, written.lafs.astype(np.float32))
    assert_array_equal(read.responses, written.responses)
    assert_array_equal(read.rectification_ids, written.rectification_ids)
    assert_allclose(read.descriptors, written.descriptors, atol=FLOAT16_ROUNDING)
    assert read.descriptors.flags.c_contiguous
    assert (read.descriptors.dtype, read.lafs.dtype) == (np.float32, np.float64)
    assert store.num_keypoints() == {"west wing/a.png": count}


@pytest.mark.parametrize("count", [0, 1, 400])
def test_stored_features_have_the_layout_of_hloc(
    store: FeatureStore, count: int
) -> None:
    written = some_features(count)
    store.write("west wing/a.png", written, (320, 240))
    with h5py.File(store.path, "r") as file:
        group = file["west wing"]["a.png"]
        # hloc counts from the centre of the first pixel, as we do.
        assert group["keypoints"].dtype == np.float32
        assert_array_equal(group["keypoints"][()], written.keypoints.astype(np.float32))
        assert group["descriptors"].shape == (128, count)
        assert group["scores"].shape == (count,)
        assert group["image_size"][()].tolist() == [320, 240]
        assert group["image_size"].dtype.kind == "i"
        assert (group["lafs"].shape, group["lafs"].dtype) == ((count, 2, 3), np.float32)
        assert all(np.issubdtype(item.dtype, np.number) for item in group.values())
        assert file.attrs["pixel_origin"] == "center"
        assert file.attrs["format"] == "colmap_affrect/features"


def test_files_do_not_need_the_newest_hdf5(store: FeatureStore) -> None:
    store.write("a.png", some_features(3), (4, 3))
    # Superblock 0 is HDF5 1.0's; with libver="latest" it is 2 or 3, and a kill loses the file.
    assert store.path.read_bytes()[8] == 0


def test_images_in_folders_with_names_of_datasets_are_told_from_these(
    store: FeatureStore,
) -> None:
    names = ["keypoints/descriptors/a.png", "keypoints/b.png", "z.png"]
    for count, name in enumerate(names, start=3):
        store.write(name, some_features(count), (4, 3))
    assert store.num_keypoints() == dict(zip(sorted(names), (4, 3, 5), strict=True))
    for absent in ("keypoints", "keypoints/descriptors", "keypoints/a.png"):
        with pytest.raises(StoreError, match=rf"no features of {absent}; run extract"):
            store.read(absent)
    store.remove(names[:1])
    assert store.names() == names[1:]


@pytest.mark.parametrize("access", ["read", "write"])
@pytest.mark.parametrize(
    ("attributes", "found"),
    [
        ({}, "found None"),
        ({"format": "colmap_affrect/matches"}, "found colmap_affrect/matches"),
    ],
    ids=["foreign", "other kind"],
)
def test_foreign_file_is_refused_and_left_as_it_is(
    store: FeatureStore, attributes: dict[str, object], found: str, access: str
) -> None:
    with h5py.File(store.path, "w") as file:
        file.attrs.update(attributes)
        file.create_group("a.png").attrs["content"] = ""
    before = store.path.read_bytes()
    with pytest.raises(StoreError, match=rf"{store.path}: .*{found}.*--output-path"):
        store.names() if access == "read" else store.write(
            "b.png", some_features(2), (4, 3)
        )
    assert store.path.read_bytes() == before


@pytest.mark.parametrize(
    "content", [b"\0", b"no HDF5 at all" * 100, b"\x89HDF\r\n\x1a\n" + b"\0" * 88]
)
def test_damaged_file_is_refused_with_one_line(
    store: FeatureStore, content: bytes
) -> None:
    store.path.write_bytes(content)
    for access in (store.names, lambda: store.write("a.png", some_features(2), (4, 3))):
        with pytest.raises(StoreError, match=r"^.*damaged .*--overwrite.*$"):
            access()
    assert store.path.read_bytes() == content


def test_values_that_were_not_written_are_damage(
    store: FeatureStore, matches: MatchStore
) -> None:
    store.write("a.png", some_features(30), (4, 3))
    matches.write([pair_matches(("a.png", "b.png"), [[0, 1]], 9)])
    for path, name in (
        (store.path, "a.png/descriptors"),
        (matches.path, "a.png/b.png/matches0"),
    ):
        with h5py.File(path, "r+") as file:
            file[name][0] = 7
    reads = (
        lambda: store.read("a.png"),
        store.check_all,
        lambda: list(matches.read([("a.png", "b.png")])),
        matches.check_all,
    )
    for read, mend in zip(
        reads, ("'extract'",) * 2 + ("match --output-path",) * 2, strict=True
    ):
        with pytest.raises(StoreError, match=f"is not as it was written.*{mend}"):
            read()


@pytest.mark.parametrize(("name1", "name2", "key"), [
    ("a.png", "b.png", "a.png/b.png"),
    ("west wing/a.png", "east/up/č.png", "west wing-a.png/east-up-č.png"),
])  # fmt: skip
def test_pair_key_is_that_of_hloc(name1: str, name2: str, key: str) -> None:
    assert pair_key(name1, name2) == key


def pair_matches(
    names: tuple[str, str], indices: list[list[int]], count: int
) -> PairMatches:
    array = np.asarray(indices, np.int64).reshape(-1, 2)
    scores = np.linspace(0.25, 0.5, len(array)).astype(np.float32)
    return PairMatches(names, array, scores, count)


def test_matches_have_the_layout_of_hloc(matches: MatchStore) -> None:
    matches.write([pair_matches(("west/a.png", "b c.png"), [[1, 0], [4, 32_767]], 6)])
    with h5py.File(matches.path, "r") as file:
        group = file["west-a.png"]["b c.png"]
        assert group["matches0"].dtype == np.int16
        assert group["matches0"][()].tolist() == [-1, 0, -1, -1, 32_767, -1]
        assert group["matching_scores0"].dtype == np.float16
        assert group["matching_scores0"][()].tolist() == [0.0, 0.25, 0.0, 0.0, 0.5, 0.0]


@pytest.mark.parametrize(
    ("indices", "count"),
    [([], 0), ([], 5), ([[0, 0]], 1), ([[0, 32_768], [39_999, 3]], 40_000)],
)
def test_read_returns_the_matches_that_were_written(
    matches: MatchStore, indices: list[list[int]], count: int
) -> None:
    other = pair_matches(("č/a.png", "d.png"), [[2, 1], [3, 0]], 4)
    matches.write([pair_matches(("a.png", "b.png"), indices, count), other])
    found = matches.read([("a.png", "b.png"), ("č/a.png", "d.png")])
    first, second = (pair.indices for pair in found)
    assert first.shape == (len(indices), 2)
    assert first.tolist() == indices
    assert second.dtype == np.int64
    assert second.tolist() == [[2, 1], [3, 0]]


def test_read_of_a_pair_without_matches_says_what_to_run(matches: MatchStore) -> None:
    matches.write(
        [pair_matches((name, "z.png"), [[0, 0]], 1) for name in ("a.png", "b.png")]
    )
    with h5py.File(matches.path, "a") as file:
        del file["b.png/z.png"]
    assert matches.has([("a.png", "z.png"), ("b.png", "z.png")]).tolist() == [
        True,
        False,
    ]
    with pytest.raises(StoreError, match=r"no matches of b\.png, z\.png; run match"):
        list(matches.read([("a.png", "z.png"), ("b.png", "z.png")]))


def test_levels_are_told_of_the_pairs_that_are_stored(matches: MatchStore) -> None:
    pairs = [("a.png", "b.png"), ("a.png", "c.png")]
    for level, names in enumerate(pairs):
        matches.write(
            [
                PairMatches(
                    names,
                    indices=np.array([(0, 1)], np.int64),
                    scores=np.ones(1, np.float32),
                    num_keypoints1=4,
                    level=level,
                )
            ]
        )
    found = matches.levels_of_stored([*pairs, ("b.png", "c.png")])
    assert found == {pairs[0]: 0, pairs[1]: 1}


def test_file_that_somebody_else_has_written_is_read_again(store: FeatureStore) -> None:
    store.write("a.png", some_features(2), (8, 6))
    assert store.num_keypoints() == {"a.png": 2}
    other = FeatureStore(store.path.with_name("other.h5"))
    other.write("b.png", some_features(3), (8, 6))
    other.path.replace(store.path)
    assert store.num_keypoints() == {"b.png": 3}


def test_learned_matches_kept_beside_those_in_use_stay_when_these_change(
    matches: MatchStore,
) -> None:
    names = ("a.png", "b c.png")

    def found(*rows: tuple[int, int], level: int = 0) -> PairMatches:
        indices = np.array(rows, np.int64).reshape(-1, 2)
        return PairMatches(
            names, indices, np.full(len(rows), 0.5, np.float32), 9, level
        )

    matches.write([found((0, 3), (2, 1))])
    learned = Learned(found((4, 7), level=2), (12, 0))
    matches.write_learned([learned])
    matches.write([], [names], 3, {names: (0, 5)})
    matches.write([found((1, 1), (3, 8), level=4)])
    (used,) = matches.read([names])
    assert_array_equal(used.indices, [[1, 1], [3, 8]])
    (kept,) = matches.learned([names]).values()
    assert_array_equal(kept.matches.indices, learned.matches.indices)
    assert (kept.matches.level, kept.worth) == (2, (12, 0))
    assert matches.learned_levels([names]) == {names: 2}
    assert matches.measured_worths([names]) == {names: (0, 5)}
    assert matches.levels([names], "tried") == {names: 0b11001}
    matches.choose([learned.matches], {names: (3, 0)}, follows="sparse.best")
    (used,) = matches.read([names])
    assert (used.level, used.indices.tolist()) == (2, [[4, 7]])
    assert matches.measured_worths([names]) == {names: (3, 0)}
    assert matches.state == MatchState(follows="sparse.best")


def test_pairs_without_learned_matches_beside_those_in_use_have_none(
    matches: MatchStore,
) -> None:
    names = ("a.png", "b c.png")
    matches.write(
        [PairMatches(names, np.zeros((0, 2), np.int64), np.zeros(0, np.float32), 0)]
    )
    assert matches.learned([names]) == {}
    assert matches.learned_levels([names]) == {names: -1}
    assert matches.measured_worths([names]) == {names: (0, 0)}


def test_state_of_matches_is_kept_with_them_and_forgotten_where_pairs_go(
    matches: MatchStore,
) -> None:
    assert matches.state == MatchState()
    pairs = (("a.png", "b.png"), ("a.png", "c.png"))
    matches.write([pair_matches(pair, [[0, 0]], 1) for pair in pairs])
    stationary = (((40, 30), ((1, 2), (3, 4))),)
    matches.update_state(stationary=stationary, effort="high", listed="digest")
    learned_models = LearnedModels("digest", 2.5, 0.75, is_of_most=True)
    matches.update_state(
        step=Begun(1, pairs),
        rounds=(2, 1),
        unlearned_set="set",
        learned_models=learned_models,
        in_vain=("a", True),
    )
    assert matches.state == MatchState(
        "digest", ("a", True), stationary, effort="high", learned_models=learned_models,
        unlearned_set="set", step=Begun(1, pairs), rounds=(2, 1),
    )  # fmt: skip
    matches.remove(pairs=pairs[:1])
    assert matches.state == MatchState(stationary=stationary, effort="high")


@pytest.mark.parametrize("names", [NAMES[1::-1], [NAMES[0], NAMES[2]], NAMES[:1]])
def test_guided_matches_of_other_images_than_written_are_damage(
    tmp_path: Path, names: list[str]
) -> None:
    """Their columns would be those of other images."""
    store = GuidedStore(tmp_path / "guided.h5")
    exact = np.array([[1, 2], [3, 4]])
    store.write([GuidedPair((NAMES[0], NAMES[1]), exact, 2)])
    assert_array_equal(store.read()[0].exact, exact)
    with h5py.File(store.path, "r+") as file:
        group = file[pair_key(NAMES[0], NAMES[1])]
        group.attrs["names"] = np.asarray(names, dtype=h5py.string_dtype())
    with pytest.raises(StoreError, match="damaged"):
        store.read()


@pytest.mark.parametrize("level", [-1, 2, 1 << 40])
def test_levels_that_the_recipe_has_not_are_damage(tmp_path: Path, level: int) -> None:
    names = (NAMES[0], NAMES[1])
    store = MatchStore(tmp_path / "matches.h5", num_levels=2)
    store.write([PairMatches(names, np.zeros((0, 2), int), np.zeros(0), 5, level=1)])
    assert store.levels([names]) == {names: 1}
    assert store.levels([names], "tried") == {names: 2}
    with h5py.File(store.path, "r+") as file:
        file[pair_key(*names)].attrs["level"] = level
    with pytest.raises(StoreError, match=f"damaged .matches are of level {level}"):
        store.levels([names])
    assert MatchStore(store.path).levels([]) == {}
    begun = Begun(2, (names,))
    store.update_state(step=begun)
    with pytest.raises(StoreError, match=r"damaged .matches are of level 2"):
        _ = store.state


@pytest.mark.parametrize("is_in_another_file", [True, False])
def test_what_is_linked_from_elsewhere_is_not_of_a_store(
    tmp_path: Path, is_in_another_file: bool
) -> None:
    other = FeatureStore(tmp_path / "other.h5")
    store = FeatureStore(tmp_path / "features.h5")
    for seed, name in enumerate(("a.png", "b.png", "c.png")):
        store.write(name, some_features(3, seed), (300, 200))
    store.path.with_name("other.h5").write_bytes(store.path.read_bytes())
    with h5py.File(store.path, "r+") as file:
        for key, source in (("a.png", "/b.png"), ("c.png/lafs", "/b.png/lafs")):
            del file[key]
            link = h5py.SoftLink(source)
            if is_in_another_file:
                link = h5py.ExternalLink(str(other.path), source)
            file[key] = link
    assert store.names() == ["b.png", "c.png"]
    assert store.lines_of(["a.png"]) == {}
    with pytest.raises(StoreError, match=r"no features of a\.png"):
        store.read("a.png")
    for use in (lambda: store.read("c.png"), store.check_all):
        with pytest.raises(StoreError, match="is linked from elsewhere"):
            use()
    for name in ("a.png", "c.png"):
        store.write(name, some_features(3), (300, 200))
    store.check_all()


@pytest.mark.parametrize(
    "changes",
    [
        {"stationary": (((320, 240), ((1, 2), (99999, 0))),)},
        {"backgrounds": (("a.png", "zz"),)},
    ],
)
def test_places_that_are_none_are_damage(
    tmp_path: Path, changes: dict[str, object]
) -> None:
    store = MatchStore(tmp_path / "matches.h5")
    store.update_state(**changes)
    features = FeatureStore(tmp_path / "features.h5")
    with pytest.raises(StoreError, match=r"matches\.h5: damaged .*match --output-path"):
        StationaryFilter(features, store)


def test_state_that_is_none_is_damage(matches: MatchStore) -> None:
    matches.update_state(listed="digest")
    with h5py.File(matches.path, "a") as file:
        file.attrs["state"] = '{"step": {"level": "all"}}'
    with pytest.raises(StoreError, match=r"matches\.h5: damaged .*--overwrite"):
        _ = matches.state
