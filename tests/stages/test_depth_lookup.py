"""Depth maps as mapping asks them: by name, at COLMAP's pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.depth_lookup import depth_lookup
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.inputs import Inputs


def extracted(tmp_path: Path, name: str, settings: list[str]) -> Context:
    workspace = Workspace(tmp_path / name)
    workspace.path.mkdir()
    context = Context(workspace)
    extract(context, Inputs.of(tmp_path / "photos"), load_recipe("unrectified-rootsift", settings))
    return context


def test_depths_are_read_where_colmap_has_its_pixels(tmp_path: Path) -> None:
    photos, depth = tmp_path / "photos", tmp_path / "depth"
    photos.mkdir()
    depth.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
    for name in ("a", "b"):
        cv2.imwrite(str(photos / f"{name}.png"), cv2.resize(noise, (160, 120)))
    values = 1.0 + np.arange(60)[:, None] + 100.0 * np.arange(80)[None]
    values[7, 9] = np.nan
    np.save(depth / "a.npy", values)
    find = depth_lookup(extracted(tmp_path, "out", [f"depth.path='{depth}'"]))
    assert find is not None
    # Pixel (column, row) of the map covers COLMAP's px 2 column to 2 column + 2, and so on.
    places = np.array([[0.1, 0.1], [30.9, 20.1], [159.9, 119.9], [18.5, 15.5], [200.0, -3.0]])
    np.testing.assert_array_equal(find("a.png", places), [1.0, 1511.0, 7960.0, np.nan, 7901.0])
    assert np.isnan(find("b.png", places)).all()
    assert depth_lookup(extracted(tmp_path, "without", [])) is None
