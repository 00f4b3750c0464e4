"""The order of imports that keeps Python's zlib and pycolmap's from killing the process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from small_scene import write_photographs

COMPRESS_EVERYTHING = """
import colmap_affrect.colmap
import gzip, io, zlib
import cv2
import numpy as np

data = bytes(range(256)) * 64
assert zlib.decompress(zlib.compress(data)) == data
assert gzip.decompress(gzip.compress(data)) == data
stored = io.BytesIO()
np.savez_compressed(stored, ramp=np.arange(1000))
stored.seek(0)
assert np.load(stored)["ramp"].sum() == 499500
image = np.arange(64 * 48, dtype=np.uint16).astype(np.uint8).reshape(48, 64)
encoded, png = cv2.imencode(".png", image)
assert encoded and (cv2.imdecode(png, cv2.IMREAD_UNCHANGED) == image).all()
from colmap_affrect.colmap import pycolmap
print(pycolmap.__version__)
"""


PYCOLMAP_FIRST = """
import pycolmap
import sys
import colmap_affrect
database_path, image_path = sys.argv[1:]
colmap_affrect.extract_features(
    database_path, image_path, extraction_options="unrectified-rootsift"
)
colmap_affrect.match_exhaustive(database_path)
with pycolmap.Database.open(database_path) as database:
    print(database.num_verified_image_pairs())
"""


def run_python(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_scripts_may_import_pycolmap_first(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", 2)
    done = run_python(PYCOLMAP_FIRST, tmp_path / "a.db", tmp_path / "photos")
    assert (done.returncode, done.stdout) == (0, "1\n")


EVALUATE = """
import pycolmap
from pathlib import Path
import colmap_affrect
try:
    colmap_affrect.evaluate('evd', Path('EVD'), Path('out'))
except colmap_affrect.AffrectError as error:
    print(error)
"""


@pytest.mark.long
def test_what_ends_with_pictures_is_refused_after_pycolmap() -> None:
    done = run_python(EVALUATE)
    assert done.returncode == 0, done.stderr
    assert 'put "import colmap_affrect" before "import pycolmap"' in done.stdout


def test_zlib_works_after_the_import_of_pycolmap() -> None:
    done = run_python(COMPRESS_EVERYTHING)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith("4.")
    assert done.stderr == ""
