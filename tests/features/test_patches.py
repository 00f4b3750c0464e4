"""Patches of frames: those that kornia samples, at the places that the frames say."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.feature import extract_patches_from_pyramid
from numpy.testing import assert_allclose
from synthetic import texture

from colmap_affrect.features import networks as patches
from colmap_affrect.features.networks import PatchSampler
from colmap_affrect.geometry.affine import rotation


def some_frames(count: int, size: tuple[int, int], largest_px: float) -> np.ndarray:
    """Turned and sheared frames of all sizes, some of them reaching beyond the image."""
    random = np.random.default_rng(2)
    shapes = np.tile(np.eye(2), (count, 1, 1))
    shapes[:, 1, 0] = random.uniform(-0.8, 0.8, count)
    shapes[:, 0, 0] = random.uniform(0.5, 2.0, count)
    radii = np.exp(random.uniform(np.log(3.0), np.log(largest_px), count))
    centers = random.uniform(-5, 5, (count, 2)) + random.uniform(0, 1, (count, 2)) * size
    matrices = radii[:, None, None] * shapes @ rotation(random.uniform(-np.pi, np.pi, count))
    return np.concatenate([matrices, centers[:, :, None]], axis=2)


CPU = torch.device("cpu")


def unit_texture(size: tuple[int, int]) -> np.ndarray:
    return texture(size, seed=1).astype(np.float32) / 255


@pytest.mark.parametrize("size", [(301, 257), (640, 130), (64, 63), (40, 20)])
@pytest.mark.parametrize("patches_at_once", [7, 128])
def test_patches_are_those_of_kornia(
    size: tuple[int, int], patches_at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patches, "PATCHES_AT_ONCE", patches_at_once)
    image = unit_texture(size)
    frames = some_frames(150, size, largest_px=max(size))
    found = PatchSampler(image, CPU).sample(frames)
    expected = extract_patches_from_pyramid(
        torch.from_numpy(image)[None, None], torch.from_numpy(frames.astype(np.float32))[None], 32
    )[0]
    assert found.dtype == torch.float32
    assert_allclose(found, expected, atol=1e-4)


def test_columns_of_a_patch_follow_the_first_axis_of_the_frame() -> None:
    x, y = np.meshgrid(np.arange(90.0), np.arange(70.0))
    frame = np.array([[[3.0, 8.0, 41.0], [0.5, 5.0, 33.0]]])
    u, v = np.meshgrid(*2 * [(2 * np.arange(32) + 1) / 32 - 1])
    for image, row in ((x, frame[0, 0]), (y, frame[0, 1])):
        sampler = PatchSampler(image.astype(np.float32), CPU)
        assert len(sampler.levels) == 2
        expected = row[0] * u + row[1] * v + row[2]
        assert_allclose(sampler.sample(frame)[0, 0], expected, atol=1e-4)


def test_no_frames_give_no_patches_and_bad_ones_harm_no_others() -> None:
    sampler = PatchSampler(unit_texture((90, 70)), CPU)
    assert sampler.sample(np.zeros((0, 2, 3))).shape == (0, 1, 32, 32)
    frames = some_frames(4, (90, 70), 20.0)
    expected = sampler.sample(frames)
    frames[1, 0, 0], frames[2, 1, 2] = np.nan, np.inf
    found = sampler.sample(frames)
    assert torch.equal(found[[0, 3]], expected[[0, 3]])
