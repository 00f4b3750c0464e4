"""Who may import whom, the order of imports, and what a user gets; layers are in pyproject.toml."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from small_scene import write_photographs

import colmap_affrect

PACKAGE = Path(colmap_affrect.__file__).parent


def nodes() -> Iterator[tuple[str, ast.AST]]:
    """Yield the path and all nodes of the syntax tree of each file."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            yield str(path.relative_to(PACKAGE)), node


def run_python(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", *map(str, arguments)],
        cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_imports_go_down_only() -> None:
    """The layers are named in pyproject.toml, [tool.importlinter]."""
    done = run_python(Path(sys.executable).with_name("lint-imports"), "--no-cache")
    assert done.returncode == 0, done.stdout


def test_pycolmap_is_imported_and_half_pixels_are_added_at_one_place() -> None:
    importing = set()
    adding = set()
    for path, node in nodes():
        if isinstance(node, ast.Import) and any(
            item.name == "pycolmap" for item in node.names
        ):
            importing.add(path)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            sides = (node.left, node.right)
            if any(
                isinstance(side, ast.Constant) and side.value == 0.5 for side in sides
            ):
                adding.add(path)
    assert importing == {"colmap/__init__.py"}
    assert adding <= {"geometry/conventions.py"}


LIGHT = """
import sys, colmap_affrect, logging
heavy = {'numpy', 'pycolmap', 'cv2', 'h5py', 'torch', 'kornia', 'tqdm', 'filelock'}
print(sorted(heavy & set(sys.modules)), 'zlib' in sys.modules, logging.root.handlers)
"""


def test_import_is_light_and_emits_no_warning() -> None:
    done = run_python("-c", LIGHT)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "[] True []\n")


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
    done = run_python("-c", COMPRESS_EVERYTHING)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip().startswith("4.")


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


def test_scripts_may_import_pycolmap_first(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", 2)
    done = run_python("-c", PYCOLMAP_FIRST, tmp_path / "a.db", tmp_path / "photos")
    assert (done.returncode, done.stdout) == (0, "1\n")
