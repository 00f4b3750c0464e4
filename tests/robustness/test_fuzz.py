"""Random and damaged input of readers: only our errors, nothing executed."""

from __future__ import annotations

import io
import random
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from damaged import HARMS

from colmap_affrect.data import Photograph
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.conventions import camera_matrix
from colmap_affrect.images.depth import DepthMaps, DepthOptions
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.recipes import load_recipe, recipe_folder, recipe_names

NAMES = ["a.png", "b c.png", "side/č.png", "side/d,e.png", "# f.png"]
PAIRS = "# pairs\na.png b c.png\nside/č.png\ta.png\na.png,side/d,e.png\n# f.png a.png\n"
DEPTH = np.arange(1.0, 25.0).reshape(4, 6) ** 1.5


def npy(values: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


def encoded(suffix: str, values: np.ndarray) -> bytes:
    return cv2.imencode(suffix, values)[1].tobytes()


def pairs(path: Path) -> None:
    for pair in read_pairs(path, NAMES):
        assert set(pair) <= set(NAMES)


def recipe(path: Path) -> None:
    load_recipe(str(path))


def depth_map(path: Path) -> None:
    camera = camera_matrix((6, 4))
    photograph = Photograph(
        np.zeros((4, 6), np.uint8), "a.jpg", path.with_name("a.jpg"), camera
    )
    depth = DepthMaps(DepthOptions(path=str(path.parent))).depth(photograph)
    assert depth.dtype == np.float32
    assert not (depth <= 0).any()


RECIPES = [(recipe_folder() / f"{name}.toml").read_bytes() for name in recipe_names()]


@pytest.mark.usefixtures("capfd")  # what decoders have to say
@pytest.mark.parametrize(("name", "read", "valid", "count"), [
    ("pairs.txt", pairs, [PAIRS.encode()], 1000),
    ("recipe.toml", recipe, RECIPES, 600),
    ("a.npy", depth_map, [npy(DEPTH)], 130),
    ("a.png", depth_map, [encoded(".png", DEPTH.astype(np.uint16))], 130),
    ("a.tif", depth_map, [encoded(".tif", DEPTH.astype(np.float32))], 130),
])  # fmt: skip
def test_damaged_files_are_taken_or_refused(
    tmp_path: Path,
    name: str,
    read: Callable[[Path], None],
    valid: list[bytes],
    count: int,
) -> None:
    chance = random.Random(1)
    path = tmp_path / name
    refused = 0
    path.write_bytes(valid[0])
    read(path)
    for _ in range(count):
        content = bytearray(chance.choice(valid))
        for harm in chance.choices(HARMS, k=chance.choice((1, 1, 3))):
            harm(content, chance) if content else None
        path.unlink(
            missing_ok=True
        )  # cutting the old one to nothing takes ten times as long
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
        except AffrectError as error:
            refused += bool(str(error))
        except Exception as error:
            raise AssertionError(f"{error!r} for {bytes(content[:500])!r}") from error
    assert refused > 10
