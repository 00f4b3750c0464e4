"""LightGlue: what the network is given, view by view, and its own authors' code beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from random_weights import write_comparing_lightglue
from strategies import compose_affine
from synthetic import unit_rows

from colmap_affrect.data import LocalFeatures, union
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.geometry.affine import lafs_from_keypoints, transform_lafs
from colmap_affrect.matchers import lightglue
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext, Matches
from colmap_affrect.matchers.lightglue import (
    LightGlue,
    LightGlueOptions,
    adapt_to_cpu,
    load_network,
    merged_matches,
    network_inputs,
    split_off_beginning,
    unwarped_points,
)

SIZE = (900, 600)


def features(
    count: int, seed: int, *, dimension: int = 128, things: np.ndarray | None = None
) -> LocalFeatures:
    """Circles of one radius at random places, with random descriptors or those of things."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, dimension)) if things is None else things
    rows = unit_rows(rows + 0.02 * random.normal(size=rows.shape))
    centers = random.uniform((0.0, 0.0), SIZE, (count, 2))
    lafs = lafs_from_keypoints(centers, np.full(count, 12.0), np.zeros(count))
    return LocalFeatures(
        lafs, random.random(count).astype(np.float32) + np.float32(0.1), rows
    )


def image(found: LocalFeatures, extractor: str = "aliked") -> ImageFeatures:
    return ImageFeatures(found, SIZE, extractor)


@pytest.fixture(scope="module")
def comparing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "lightglue.pth"
    return write_comparing_lightglue(path)


@pytest.fixture
def matcher(comparing: Path) -> LightGlue:
    return LightGlue(
        LightGlueOptions(), MatcherContext({"lightglue-aliked": comparing}, "cpu")
    )


def test_circles_of_a_warp_tell_where_they_were_in_it() -> None:
    warp = np.eye(3)
    warp[:2, :2] = compose_affine(0.8, 0.3, 2.5, 1.1)
    warp[:2, 2] = (35.0, -20.0)
    found = features(50, 1)
    carried = transform_lafs(np.linalg.inv(warp), found.lafs)
    points, size = unwarped_points(carried)
    factor = 12.0 / np.sqrt(np.linalg.det(carried[0, :, :2]))
    low = found.keypoints.min(axis=0)
    assert_allclose(factor * points, found.keypoints - low, atol=1e-9)
    assert_allclose(factor * (size - 1.0), found.keypoints.max(axis=0) - low, atol=1e-9)


def test_positions_are_those_of_pixel_centres_within_width_and_height() -> None:
    lafs = lafs_from_keypoints(
        np.array([[-0.4, 7.0], [899.4, 600.0]]), np.ones(2), np.zeros(2)
    )
    found = replace(features(2, 1), lafs=lafs)
    values = network_inputs(found, SIZE)
    assert set(values) == {"keypoints", "image_size", "descriptors"}
    assert_allclose(values["keypoints"][0], [[0.0, 7.0], [899.4, 600.0]], rtol=1e-6)
    assert_array_equal(values["image_size"][0], SIZE)
    of_warp = network_inputs(found.with_rectification_id(1), SIZE)
    assert_allclose(of_warp["image_size"][0], [900.8, 594.0], rtol=1e-6)


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
    assert_array_equal(
        np.unique(found.indices[:, 1]), np.arange(60)
    )  # the ten in both views once
    assert (np.diff(found.indices[:, 0]) > 0).all()


def test_of_matches_at_one_place_the_best_is_left() -> None:
    points = np.array([[9.0, 5.0], [17.0, 7.0], [9.2, 5.1], [30.0, 40.0]])
    views = [
        Matches(np.array([[1, 1], [0, 0]]), np.array([0.5, 0.9], np.float32)),
        Matches(np.array([[2, 2], [3, 1]]), np.array([0.8, 0.4], np.float32)),
    ]
    found = merged_matches(views, points, points + 100.0)
    assert_array_equal(found.indices, [[0, 0], [1, 1]])
    assert_array_equal(found.scores, np.float32([0.9, 0.5]))


def test_one_place_seen_in_two_views_is_one_match(matcher: LightGlue) -> None:
    things = np.random.default_rng(0).normal(size=(40, 128))
    image1 = features(40, 1, things=things[:40])
    warp1 = features(40, 1, things=things[:40])
    image2 = features(80, 2, things=np.concatenate([things, things[::-1]]))
    second = replace(
        image2, lafs=np.concatenate([image2.lafs[:40], image2.lafs[39::-1]])
    )
    first = union([image1, warp1.with_rectification_id(1)])
    second = second.with_rectification_id(0)
    second = union(
        [
            second.select(np.arange(40)),
            second.select(np.arange(40, 80)).with_rectification_id(1),
        ]
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


@pytest.mark.parametrize("is_fast", [False, True])
@pytest.mark.parametrize("count", [5, 0])
def test_on_a_cpu_a_layer_tells_each_image_what_kornia_tells_it(
    monkeypatch: pytest.MonkeyPatch, count: int, *, is_fast: bool
) -> None:
    from kornia.feature.lightglue import TransformerLayer

    if is_fast and not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        pytest.skip("torch without oneDNN")
    torch.manual_seed(0)
    layer = TransformerLayer(embed_dim=64, num_heads=2).eval().requires_grad_(False)
    first = torch.randn(1, 11, 64)
    second = torch.randn(1, count, 64)
    given = (
        first,
        second,
        torch.randn(2, 1, 1, 11, 32),
        torch.randn(2, 1, 1, count, 32),
    )
    expected = layer(*given)
    monkeypatch.setattr(lightglue, "has_fast_products", lambda: is_fast)
    adapt_to_cpu(SimpleNamespace(transformers=torch.nn.ModuleList([layer])))
    adapted = layer(*given)
    changed = {name for name, part in layer.named_modules() if "forward" in vars(part)}
    linear = {"self_attn.inner_attn", "self_attn.Wqkv", "cross_attn.to_qk"}
    assert changed >= {"cross_attn"}
    assert changed.issuperset(linear) == is_fast
    for found, known in zip(adapted, expected, strict=True):
        torch.testing.assert_close(found, known, atol=1e-5, rtol=1e-5)
    assert (adapted[0] - first).abs().max() > 0.1


def test_what_an_image_says_alone_is_asked_once_for_all_of_its_pairs(
    comparing: Path,
) -> None:
    options = LightGlueOptions()
    whole = load_network(comparing, options)
    split = load_network(comparing, options)
    torch.manual_seed(0)
    for name, value in whole.state_dict().items():
        if "self_attn" in name or "posenc" in name:
            value.copy_(0.02 * torch.randn(value.shape))
            split.state_dict()[name].copy_(value)
    one, other = (network_inputs(features(30, seed), SIZE) for seed in (1, 2))
    begin = split_off_beginning(split)
    with torch.inference_mode():
        expected = whole({"image0": one, "image1": other})
        begun = [{**side, "descriptors": begin(side)} for side in (one, other)]
        found = split({"image0": begun[0], "image1": begun[1]})
    assert not torch.equal(
        begun[0]["descriptors"], whole.input_proj(one["descriptors"])
    )
    assert_array_equal(found["log_assignment"], expected["log_assignment"])


def test_an_image_begins_once(
    matcher: LightGlue, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = list[int]()
    begin = matcher._begin

    def counted(inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        begun.append(len(inputs["keypoints"][0]))
        return begin(inputs)

    monkeypatch.setattr(matcher, "_begin", counted)
    images = [matcher.prepare(image(features(count, count))) for count in (20, 30, 40)]
    for first, second in combinations(images, 2):
        matcher.match(first, second)
    assert sorted(begun) == [20, 30, 40]


def test_another_network_of_kornia_stays_as_it_is() -> None:
    layer = torch.nn.Module()
    layer.self_attn = torch.nn.ReLU()
    layer.cross_attn = torch.nn.ReLU()
    adapt_to_cpu(SimpleNamespace(transformers=torch.nn.ModuleList([layer])))
    assert "forward" not in vars(layer.self_attn)
    assert "forward" not in vars(layer.cross_attn)


def test_features_of_another_extractor_are_refused_in_one_line(
    matcher: LightGlue,
) -> None:
    with pytest.raises(
        OptionError, match="lightglue takes features of aliked, not of rootsift"
    ):
        matcher.prepare(image(features(20, 1), "rootsift"))
    matcher.prepare(image(features(20, 1), ""))


@pytest.mark.parametrize(
    ("shape", "message"),
    [((32, 4), "(of another size)"), (None, "(no posenc.Wr.weight)")],
)
def test_weights_of_another_network_are_refused(
    comparing: Path, tmp_path: Path, shape: tuple[int, int] | None, message: str
) -> None:
    state = torch.load(comparing, weights_only=True)
    del state["posenc.Wr.weight"]
    if shape:
        state["posenc.Wr.weight"] = torch.zeros(shape)
    torch.save(state, tmp_path / "other.pth")
    message = re.escape(f"other.pth: not the weights of LightGlue for ALIKED {message}")
    with pytest.raises(AffrectError, match=message):
        load_network(tmp_path / "other.pth", LightGlueOptions())
