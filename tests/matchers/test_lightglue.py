"""LightGlue: what the network is given, view by view, and its own authors' code beside it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from random_weights import write_comparing_lightglue
from strategies import compose_affine

from colmap_affrect.data import LocalFeatures, union
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.geometry.affine import (
    lafs_from_keypoints,
    transform_frames,
)
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext, Matches
from colmap_affrect.matchers.lightglue import (
    TRAININGS,
    LightGlue,
    LightGlueOptions,
    frames_of_view,
    load_network,
    network_inputs,
    united,
)

SIZE = (900, 600)


def features(
    count: int, seed: int, *, dimension: int = 128, things: np.ndarray | None = None
) -> LocalFeatures:
    """Circles of one radius at random places, with random descriptors or those of things."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, dimension)) if things is None else things
    rows = rows + 0.02 * random.normal(size=rows.shape)
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    centers = random.uniform((0.0, 0.0), SIZE, (count, 2))
    lafs = lafs_from_keypoints(centers, np.full(count, 12.0), np.zeros(count))
    return LocalFeatures(lafs, random.random(count).astype(np.float32) + np.float32(0.1), rows)


def image(found: LocalFeatures, extractor: str = "aliked") -> ImageFeatures:
    return ImageFeatures(found, SIZE, extractor)


@pytest.fixture(scope="module")
def comparing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "lightglue.pth"
    return write_comparing_lightglue(path, "aliked")


@pytest.fixture
def matcher(comparing: Path) -> LightGlue:
    return LightGlue(LightGlueOptions(), MatcherContext({"lightglue-aliked": comparing}, "cpu"))


def test_circles_of_a_warp_tell_where_they_were_in_it() -> None:
    warp = np.eye(3)
    warp[:2, :2] = compose_affine(0.8, 0.3, 2.5, 1.1)
    warp[:2, 2] = (35.0, -20.0)
    found = features(50, 1)
    carried = transform_frames(np.linalg.inv(warp), found.lafs)
    frames, size = frames_of_view(carried, has_circles=True)
    factor = 12.0 / np.sqrt(np.linalg.det(carried[0, :, :2]))
    low = found.keypoints.min(axis=0)
    assert_allclose(factor * frames[:, :, 2], found.keypoints - low, atol=1e-9)
    assert_allclose(factor * (size - 1.0), found.keypoints.max(axis=0) - low, atol=1e-9)


def test_turned_frames_of_a_warp_tell_where_they_were_up_to_a_rotation() -> None:
    random = np.random.default_rng(3)
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    lafs = lafs_from_keypoints(random.uniform(0, 500, (60, 2)), random.uniform(3, 20, 60), angles)
    warp = np.eye(3)
    warp[:2, :2] = compose_affine(3.0**-0.5, 0.4, 3.0, 0.7)
    frames, _ = frames_of_view(transform_frames(np.linalg.inv(warp), lafs), has_circles=False)
    assert_allclose(np.linalg.svd(frames[:, :, :2])[1].prod(axis=1) ** 0.5,
                    np.sqrt(np.linalg.det(lafs[:, :, :2])), rtol=1e-6)  # fmt: skip
    turned = frames[:, :, 2] - frames[0, :, 2]
    expected = lafs[:, :, 2] - lafs[0, :, 2]
    assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(expected, axis=1), rtol=1e-6)
    cosines = (turned[1:] * expected[1:]).sum(axis=1)
    crosses = turned[1:, 0] * expected[1:, 1] - turned[1:, 1] * expected[1:, 0]
    assert np.ptp(np.arctan2(crosses, cosines)) < 1e-6


def test_positions_are_those_of_pixel_centres_within_width_and_height() -> None:
    lafs = lafs_from_keypoints(np.array([[-0.4, 7.0], [899.4, 600.0]]), np.ones(2), np.zeros(2))
    values = network_inputs(lafs, np.array([900.0, 600.0]), 900, "aliked")
    assert set(values) == {"keypoints", "image_size"}
    assert_allclose(values["keypoints"], [[0.0, 7.0], [899.4, 600.0]])
    assert_allclose(values["image_size"], SIZE)


def test_scales_and_orientations_are_those_of_training() -> None:
    from kornia.feature import LightGlueMatcher
    from kornia.feature.integrated import _lightglue_keypoint_scale_ori

    assert LightGlueMatcher.known_modes
    angles = np.array([0.2, 3.0, -2.5, 5.9])
    lafs = lafs_from_keypoints(np.ones((4, 2)), np.array([6.0, 12.0, 18.0, 7.5]), angles)
    size = np.array([512.0, 300.0])
    scales, oris = _lightglue_keypoint_scale_ori(torch.from_numpy(lafs)[None], "sift")
    values = network_inputs(lafs, size, 512, "sift")
    assert_allclose(values["scales"], scales[0], rtol=1e-9)
    assert_allclose(values["oris"], oris[0], rtol=1e-9)
    shrunk = network_inputs(lafs, size, 4096, "sift")["scales"]
    assert_allclose(shrunk, values["scales"] / 4.0)


def test_strongest_features_are_matched_and_keep_their_indices(comparing: Path) -> None:
    options = LightGlueOptions(max_num_features=30)
    matcher = LightGlue(options, MatcherContext({"lightglue-aliked": comparing}, "cpu"))
    things = np.random.default_rng(0).normal(size=(50, 128))
    first = features(50, 1, things=things)
    second = features(50, 2, things=things[::-1])
    second = replace(second, responses=first.responses[::-1])
    found = matcher.match(matcher.prepare(image(first)), matcher.prepare(image(second)))
    strongest = np.sort(np.argsort(-first.responses)[:30])
    assert_array_equal(found.indices, np.stack([strongest, 49 - strongest], axis=1))


def test_views_are_matched_one_by_one_and_united(matcher: LightGlue) -> None:
    things = np.random.default_rng(0).normal(size=(60, 128))
    parts = [features(40, 1, things=things[:40]), features(30, 2, things=things[30:])]
    parts.append(features(5, 3))
    first = union([part.with_rectification_id(k) for k, part in enumerate(parts)])
    second = features(60, 4, things=things)
    seen: list[tuple[int, int]] = []
    plain = matcher._match_views
    matcher._match_views = lambda a, b: (  # type: ignore[method-assign]
        seen.append((len(a.rows), len(b.rows))) or plain(a, b)
    )
    found = matcher.match(matcher.prepare(image(first)), matcher.prepare(image(second)))
    assert seen == [(40, 60), (30, 60)]  # of views with few features nothing is asked
    shown = np.concatenate([np.arange(40), np.arange(30, 60)])
    assert_array_equal(shown[found.indices[:, 0]], found.indices[:, 1])
    assert_array_equal(np.unique(found.indices[:, 1]), np.arange(60))  # the ten in both views once
    assert (np.diff(found.indices[:, 0]) > 0).all()


def test_of_matches_at_one_place_the_best_is_left() -> None:
    places = np.array([[9.0, 5.0], [30.0, 7.0], [9.2, 5.1], [30.0, 40.0]])
    views = [
        Matches(np.array([[1, 1], [0, 0]]), np.array([0.5, 0.9], np.float32)),
        Matches(np.array([[2, 2], [3, 1]]), np.array([0.8, 0.4], np.float32)),
    ]
    found = united(views, places, places + 100.0)
    assert_array_equal(found.indices, [[0, 0], [1, 1]])
    assert_array_equal(found.scores, np.float32([0.9, 0.5]))


def test_one_place_seen_in_two_views_is_one_match(matcher: LightGlue) -> None:
    things = np.random.default_rng(0).normal(size=(40, 128))
    image1, warp1 = features(40, 1, things=things[:40]), features(40, 1, things=things[:40])
    image2 = features(80, 2, things=np.concatenate([things, things[::-1]]))
    second = replace(image2, lafs=np.concatenate([image2.lafs[:40], image2.lafs[39::-1]]))
    first = union([image1, warp1.with_rectification_id(1)])
    second = second.with_rectification_id(0)
    second = union(
        [second.select(np.arange(40)), second.select(np.arange(40, 80)).with_rectification_id(1)]
    )
    found = matcher.match(matcher.prepare(image(first)), matcher.prepare(image(second)))
    places = np.rint(first.keypoints[found.indices[:, 0]])
    assert len(np.unique(places, axis=0)) == len(places) == 40


def test_threads_find_the_same(matcher: LightGlue) -> None:
    images = [matcher.prepare(image(features(150, seed % 2))) for seed in range(4)]
    pairs = [(a, b) for a in images[:2] for b in images[2:]]
    alone = [matcher.match(*pair) for pair in pairs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda pair: matcher.match(*pair), pairs))
    assert any(len(found.scores) for found in alone)
    for one, other in zip(alone, together, strict=True):
        assert_array_equal(one.indices, other.indices)
        assert_array_equal(one.scores, other.scores)


@pytest.mark.long
@pytest.mark.parametrize("trained_for", TRAININGS)
def test_every_kind_of_features_is_matched_and_in_warps(trained_for: str, tmp_path: Path) -> None:
    training = TRAININGS[trained_for]
    path = write_comparing_lightglue(tmp_path / "lightglue.pth", trained_for)
    options = LightGlueOptions.from_mapping({"trained_for": trained_for}, "")
    matcher = LightGlue(options, MatcherContext({training.weights: path}, "cpu"))
    parts = [features(20, seed) for seed in (1, 2)]
    parts[1] = parts[1].with_rectification_id(1)
    views = matcher.prepare(image(union(parts), training.kind))
    indices = matcher.match(views, views).indices
    assert_array_equal(indices[:, 0], indices[:, 1])
    assert set(indices[:, 0] // 20) == {0, 1}
    assert len(indices) > 35


def test_features_of_another_extractor_are_refused_in_one_line(matcher: LightGlue) -> None:
    with pytest.raises(OptionError, match="'aliked' takes features of aliked, not of rootsift"):
        matcher.prepare(image(features(20, 1), "rootsift"))
    matcher.prepare(image(features(20, 1), ""))


def test_weights_of_another_network_are_refused(comparing: Path, tmp_path: Path) -> None:
    with pytest.raises(
        AffrectError, match=r"lightglue\.pth: not the weights of LightGlue for sift"
    ):
        load_network(comparing, LightGlueOptions(trained_for="sift"))
    state = torch.load(comparing, weights_only=True)
    del state["posenc.Wr.weight"]
    torch.save(state, tmp_path / "partial.pth")
    with pytest.raises(AffrectError, match=r"partial\.pth: .*no posenc\.Wr\.weight"):
        load_network(tmp_path / "partial.pth", LightGlueOptions())
