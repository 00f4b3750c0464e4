"""Campaign (tests/campaign.py): lists, photographs and files as other systems leave them."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from campaign import CAMPAIGN, assert_clear, run_words
from command import FAST, Call
from PIL import Image

pytestmark = CAMPAIGN

PAIRS = "a.png b-c.png\na.png side/č.png\n"
LISTS = {
    "with a mark of UTF-8": (b"\xef\xbb\xbf" + PAIRS.encode(), 0),
    "with line ends of old Macs": (PAIRS.encode().replace(b"\n", b"\r"), 0),
    "that turns pairs round": (b"a.png b-c.png\nb-c.png a.png\n" * 3, 0),
    "of 20,000 lines": (PAIRS.encode() * 10_000, 0),
    "in UTF-16": (PAIRS.encode("utf-16"), 2),
    "in Latin-2": (PAIRS.encode("iso8859-2"), 2),
    "with names as macOS has them": (PAIRS.replace("č", "c\u030c").encode(), 2),
    "with NULs": (PAIRS.encode().replace(b"\n", b"\0"), 2),
    "of one with itself": (b"a.png a.png\n", 2),
    "of patterns": (b"*.png *.png\n", 2),
}
"""Bytes of a list of pairs, and the exit code."""


@pytest.mark.parametrize("kind", LISTS)
def test_list_of_pairs_is_read_or_named(
    scene: Path, tmp_path: Path, call: Call, kind: str
) -> None:
    content, code = LISTS[kind]
    path = tmp_path / "list.txt"
    path.write_bytes(content)
    out = shutil.copytree(scene / "out", tmp_path / "out")
    before = (out / "pairs.txt").read_bytes()
    given = ["--match-list-path", path, "--overwrite"]
    end = call("pairs", "-q", "--output-path", out, *given)
    assert_clear(end, code)
    assert path.read_bytes() == content
    assert ((out / "pairs.txt").read_bytes() == before) == (code != 0)


def jpeg_of(image: Image.Image, **options: Any) -> bytes:
    written = BytesIO()
    image.save(written, "JPEG", **options)
    return written.getvalue()


def with_size(jpeg: bytes, height: int, width: int) -> bytes:
    """Have a baseline JPEG say another size."""
    where = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:where] + struct.pack(">HH", height, width) + jpeg[where + 4 :]


def png_chunk(kind: bytes, content: bytes) -> bytes:
    check = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)


def write_unreadable(folder: Path, image: Image.Image) -> None:
    jpeg = jpeg_of(image)
    (folder / "cut.jpg").write_bytes(jpeg_of(image, progressive=True)[:3000])
    (folder / "huge.jpg").write_bytes(with_size(jpeg, 65535, 65535))
    (folder / "nothing.jpg").write_bytes(with_size(jpeg, 0, 0))
    sides = struct.pack(">IIBBBBB", 2**31 - 1, 2**31 - 1, 8, 2, 0, 0, 0)
    header = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", sides)
    (folder / "wide.png").write_bytes(header)
    (folder / "dead.png").symlink_to("/nonexistent.png")


def write_odd(folder: Path, image: Image.Image) -> None:
    """Write pictures that can be read, whatever they look like."""
    image.convert("CMYK").save(folder / "cmyk.jpg")
    image.convert("P").save(folder / "palette.png", transparency=0)
    image.save(folder / "moving.png", save_all=True, append_images=[image.rotate(9)])
    Image.new("L", (1, 9000)).save(folder / "thin.png")
    (folder / "other-format.png").write_bytes(jpeg_of(image))
    cut_exif = b"\xff\xe1\x00\x20Exif\0\0MM\0*\0\0\0\x08\xff\xff" + b"\xff" * 14
    plain = jpeg_of(image)
    (folder / "exif.jpg").write_bytes(plain[:2] + cut_exif + plain[2:])
    for name in ("-rf.png", "%s{0}.png", "$(touch pwned).png", "A.PNG"):
        shutil.copy(folder / "a.png", folder / name)


@pytest.mark.parametrize(("write", "num_lost"), [(write_unreadable, 5), (write_odd, 0)])
def test_odd_pictures_are_read_or_named(
    scene: Path,
    tmp_path: Path,
    call: Call,
    write: Callable[[Path, Image.Image], None],
    num_lost: int,
) -> None:
    photos = shutil.copytree(scene / "photos", tmp_path / "photos")
    write(photos, Image.open(photos / "a.png").convert("RGB"))
    files = [path for path in photos.rglob("*") if path.is_file()]
    before = {path: path.read_bytes() for path in files}
    out = tmp_path / "out"
    few = ["--set", "features.max_num_features=200", "--image-path", photos]
    end = call("extract", "-q", "--output-path", out, *FAST[:2], *few)
    assert_clear(end, int(num_lost > 0))
    with h5py.File(out / "features.h5") as features:
        names: list[str] = []
        features.visit(names.append)
    assert {"cut.jpg", "huge.jpg", "wide.png"}.isdisjoint(names)
    assert not num_lost or f"could not read {num_lost} of the images" in end.stderr[-1]
    assert {path: path.read_bytes() for path in files} == before
    assert not list(tmp_path.rglob("pwned"))


def replace_keypoints(file: h5py.File, make: Callable[[Any], Any]) -> None:
    """Write the keypoints of all images anew, as something else."""
    found: list[str] = []
    file.visit(lambda name: found.append(name) if name.endswith("/keypoints") else None)
    assert found
    for name in found:
        attributes = dict(file[name].attrs)
        values = make(file[name][()])
        del file[name]
        file.create_dataset(name, data=values)
        file[name].attrs.update(attributes)


STORES: dict[str, Callable[[h5py.File], None]] = {
    "half precision": lambda f: replace_keypoints(f, lambda v: v.astype("f2")),
    "complex": lambda f: replace_keypoints(f, lambda v: v.astype("c8")),
    "text": lambda f: replace_keypoints(f, lambda v: np.full(len(v), b"x", "S3")),
    "one number": lambda f: replace_keypoints(f, lambda _: 3.0),
    "no values": lambda f: replace_keypoints(f, lambda _: h5py.Empty("f4")),
}


@pytest.mark.parametrize("kind", STORES)
def test_store_of_other_types_is_named(
    scene: Path, tmp_path: Path, call: Call, kind: str
) -> None:
    out = shutil.copytree(scene / "out", tmp_path / "out")
    with h5py.File(out / "features.h5", "r+") as file:
        STORES[kind](file)
    doctor = call("doctor", "-q", out)
    assert doctor.code == 1, doctor
    assert "features.h5" in doctor.stdout
    again = call("match", "-q", "--output-path", out, "--overwrite")
    assert_clear(again, 0, 1, 2)


@pytest.mark.parametrize(("change", "code"), [
    (lambda text: b"\xef\xbb\xbf" + text, 0),
    (lambda text: text.replace(b"\n", b"\r\n"), 0),
    (lambda text: text.decode().encode("utf-16"), 1),
    (lambda text: text + b"x = " + b"[" * 2000 + b"]" * 2000, 1),
])  # fmt: skip
def test_record_that_an_editor_has_saved_is_read_or_named(
    scene: Path, tmp_path: Path, call: Call, change: Callable[[bytes], bytes], code: int
) -> None:
    out = shutil.copytree(scene / "out", tmp_path / "out")
    record = out / "config.toml"
    record.write_bytes(change(record.read_bytes()))
    end = call(*run_words(scene, out))
    assert_clear(end, code)
    assert not code or "config.toml" in end.errors[0]


def test_odd_environment_changes_nothing(scene: Path, tmp_path: Path) -> None:
    out = shutil.copytree(scene / "out", tmp_path / "out")
    odd = {
        "OMP_NUM_THREADS": "0",
        "OPENBLAS_NUM_THREADS": "x",
        "CUDA_VISIBLE_DEVICES": "",
        "TMPDIR": "/nonexistent",
        "SQLITE_TMPDIR": "/nonexistent",
        "HDF5_USE_FILE_LOCKING": "maybe",
        "COLUMNS": "-5",
        "TZ": ":/etc/passwd",
        "PYTHONOPTIMIZE": "2",
        "PYTHONWARNINGS": "error",
    }
    environment = {**os.environ, **odd}
    for name in ("HOME", "XDG_CACHE_HOME", "PATH"):
        environment.pop(name, None)
    words = [*map(str, run_words(scene, out)), "--overwrite"]
    command = [sys.executable, "-m", "colmap_affrect", *words]
    end = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False
    )
    assert (end.returncode, end.stderr) == (0, "")
    assert "registered  4 of 4 images" in end.stdout
