"""Random and damaged input of all readers: only our errors, nothing executed.

Lists of pairs, recipes, depth maps. Half of the inputs are random bytes, half are valid ones with a
few changes.
"""

from __future__ import annotations

import io
import random
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic import write_image

from colmap_affrect.conventions import camera_matrix
from colmap_affrect.data import Photograph
from colmap_affrect.errors import AffrectError
from colmap_affrect.images.depth import DepthFiles, DepthFilesOptions
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.recipes import load_recipe, recipe_folder, recipe_names

NAMES = ["a.png", "b c.png", "side/č.png", "side/d,e.png", "# f.png"]

PAIRS = "# pairs\na.png b c.png\nside/č.png\ta.png\na.png,side/d,e.png\n# f.png a.png\n"

PIECES = [
    b"", b"\0", b"\n", b"\r\n", b"\t", b" ", b"#", b",", b"..", b"/", b"\\", b'"', b"'", b"'''",
    b"[", b"]" * 3, b"[[", b"{", b"}", b"=", b"-", b"9" * 30, b"1e999", b"nan", b"-inf", b"true",
    b"0x", b"1979-05-27", b"\xff\xfe", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b"\xc2\x85", b"\x1b[31m",
    b"%s", b"{0}", b"a" * 300, "🏛".encode(), b"\xed\xa0\x80", b"../" * 20, b"/dev/zero", b"depth",
    b"\xff" * 8, b"\x7f\xff\xff\xff", b"[" * 3000,
]  # fmt: skip


def damaged(valid: bytes, chance: random.Random) -> bytes:
    """Change a few places, or make up something as long."""
    if chance.random() < 0.5:
        return chance.randbytes(chance.choice([0, 1, 7, 60, len(valid)]))
    data = bytearray(valid)
    for _ in range(chance.randint(1, 4)):
        start = chance.randrange(len(data) + 1)
        end = min(len(data), start + chance.choice([0, 1, 1, 4, 40]))
        kind = chance.randrange(5)
        if kind == 0 and start < len(data):
            data[start] ^= 1 << chance.randrange(8)
        elif kind == 1:
            data[start:end] = chance.choice(PIECES)
        elif kind == 2:
            data[start:end] = chance.randbytes(end - start)
        elif kind == 3:
            data[start:start] = data[end : end + chance.randrange(200)]
        else:
            del data[start : chance.choice([end, len(data)])]
    return bytes(data)


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
        data = damaged(chance.choice(valid), chance)
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


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png"])
def test_depth_maps(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture) -> None:
    (tmp_path / "maps").mkdir()
    read = depth_reader(tmp_path / "maps", suffix)
    valid = map_bytes(suffix, tmp_path)
    read(valid)
    _, refused = fuzz([valid], 130, 5, read)
    assert refused > 40
    capfd.readouterr()  # what decoders have to say
