"""Random and damaged input of readers: only our errors, nothing executed."""

from __future__ import annotations

import io
import random
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from damaged import HARMS
from synthetic import write_image

from colmap_affrect.data import Photograph
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.conventions import camera_matrix
from colmap_affrect.images.depth import DepthFiles, DepthFilesOptions
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.recipes import load_recipe, recipe_folder, recipe_names

NAMES = ["a.png", "b c.png", "side/č.png", "side/d,e.png", "# f.png"]
PAIRS = "# pairs\na.png b c.png\nside/č.png\ta.png\na.png,side/d,e.png\n# f.png a.png\n"


def fuzz(path: Path, valid: list[bytes], count: int, read: Callable[[], object]) -> None:
    """Read a damaged file again and again: some of it is taken, much of it refused."""
    chance = random.Random(1)
    refused = 0
    for _ in range(count):
        content = bytearray(chance.choice(valid))
        for harm in chance.choices(HARMS, k=chance.choice((1, 1, 3))):
            harm(content, chance) if content else None
        path.unlink(missing_ok=True)  # cutting the old one to nothing takes ten times as long
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read()
        except AffrectError as error:
            refused += bool(str(error))
        except Exception as error:
            raise AssertionError(f"{error!r} for {bytes(content[:500])!r}") from error
    assert 10 < refused < count


def test_lists_of_pairs(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"

    def read() -> None:
        for pair in read_pairs(path, NAMES):
            assert set(pair) <= set(NAMES)

    fuzz(path, [PAIRS.encode()], 1000, read)


def test_recipe_files(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    valid = [(recipe_folder() / f"{name}.toml").read_bytes() for name in recipe_names()]
    fuzz(path, valid, 600, lambda: load_recipe(str(path)))


def map_bytes(suffix: str, folder: Path) -> bytes:
    """A valid depth map of 6 x 4 px."""
    depth, content = np.arange(1.0, 25.0).reshape(4, 6) ** 1.5, io.BytesIO()
    if suffix == ".png":
        return write_image(folder / "map.png", depth.astype(np.uint16)).read_bytes()
    np.save(content, depth)
    return content.getvalue()


@pytest.mark.parametrize("suffix", [".npy", ".png"])
@pytest.mark.usefixtures("capfd")  # what decoders have to say
def test_depth_maps(tmp_path: Path, suffix: str) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    photograph = Photograph(
        np.zeros((4, 6), np.uint8), "a.jpg", folder / "a.jpg", camera_matrix((6, 4))
    )
    source = DepthFiles(DepthFilesOptions(path=str(folder)))

    def read() -> None:
        depth = source.depth(photograph)
        assert depth.dtype == np.float32
        assert not (depth <= 0).any()

    fuzz(folder / f"a{suffix}", [map_bytes(suffix, tmp_path)], 130, read)
