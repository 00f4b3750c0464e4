"""The order of imports that keeps Python's zlib and pycolmap's from killing the process."""

from __future__ import annotations

import subprocess
import sys

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


def test_zlib_works_after_the_import_of_pycolmap() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", COMPRESS_EVERYTHING],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith("4.")
    assert done.stderr == ""
