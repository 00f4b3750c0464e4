"""Random and damaged input of all readers: only our errors, nothing executed.

Lists of pairs, recipes, depth maps: valid ones with a few changes, and random bytes.
"""

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


def write_anew(path: Path, data: bytes) -> None:
    """Write a file; cutting the old one to nothing first takes ten times as long."""
    path.unlink(missing_ok=True)
    path.write_bytes(data)


def fuzz(
    valid: list[bytes], count: int, seed: int, read: Callable[[bytes], object]
) -> tuple[int, int]:
    """Read damaged input; return how many inputs were taken and how many refused."""
    chance = random.Random(seed)
    taken = refused = 0
    for _ in range(count):
        content = bytearray(chance.choice(valid))
        for harm in chance.choices(HARMS, k=chance.choice((1, 1, 3))):
            harm(content, chance) if content else None
        data = bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(data)
        except AffrectError as error:
            refused += bool(str(error))
        except Exception as error:
            raise AssertionError(f"{error!r} for {data[:500]!r}") from error
        else:
            taken += 1
    assert taken + refused == count
    return taken, refused


def test_lists_of_pairs(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"

    def read(data: bytes) -> None:
        write_anew(path, data)
        for pair in read_pairs(path, NAMES):
            assert set(pair) <= set(NAMES)

    taken, refused = fuzz([PAIRS.encode()], 1000, 1, read)
    assert min(taken, refused) > 10


def test_recipe_files(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"

    def read(data: bytes) -> None:
        write_anew(path, data)
        load_recipe(str(path))

    valid = [(recipe_folder() / f"{name}.toml").read_bytes() for name in recipe_names()]
    taken, refused = fuzz(valid, 600, 3, read)
    assert min(taken, refused) > 10


def map_bytes(suffix: str, folder: Path) -> bytes:
    """A valid depth map of 6 x 4 px."""
    depth, content = np.arange(1.0, 25.0).reshape(4, 6) ** 1.5, io.BytesIO()
    if suffix == ".png":
        return write_image(folder / "map.png", depth.astype(np.uint16)).read_bytes()
    if suffix == ".npy":
        np.save(content, depth)
    else:
        np.savez_compressed(content, depth=depth, other=depth[:2])
    return content.getvalue()


def depth_reader(folder: Path, suffix: str) -> Callable[[bytes], object]:
    """Return a function that reads bytes as the depth map of an image of 6 x 4 px."""
    gray = np.zeros((4, 6), np.uint8)
    photograph = Photograph(gray, "a.jpg", folder / "a.jpg", camera_matrix((6, 4)))
    source = DepthFiles(DepthFilesOptions(path=str(folder)))

    def read(data: bytes) -> object:
        write_anew(folder / f"a{suffix}", data)
        depth = source.depth(photograph)
        assert depth.dtype == np.float32
        assert not (depth <= 0).any()
        return depth

    return read


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_depth_maps(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture) -> None:
    (tmp_path / "maps").mkdir()
    read = depth_reader(tmp_path / "maps", suffix)
    valid = map_bytes(suffix, tmp_path)
    read(valid)
    _, refused = fuzz([valid], 130, 5, read)
    assert refused > 40
    capfd.readouterr()  # what decoders have to say
