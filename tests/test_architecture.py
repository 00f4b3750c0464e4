"""Who may import whom, the order of imports, and what a user gets; layers are in pyproject.toml."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from small_scene import write_photographs

import colmap_affrect

PACKAGE = Path(colmap_affrect.__file__).parent


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def nodes(path: Path) -> list[ast.AST]:
    """All nodes of the syntax tree of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def test_imports_go_down_only() -> None:
    """The layers are named in pyproject.toml, [tool.importlinter]."""
    done = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


def test_pycolmap_is_imported_at_one_site() -> None:
    sites = [
        module
        for module, path in MODULES.items()
        for node in nodes(path)
        if isinstance(node, ast.Import) and any(item.name == "pycolmap" for item in node.names)
    ]
    assert sites == ["colmap"]


def test_half_pixels_are_added_in_conventions_only() -> None:
    # 0.5 stands for other things too: these modules compute with it, and not with positions.
    users = {
        module
        for module, path in MODULES.items()
        if any(
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.Add | ast.Sub)
            and any(isinstance(s, ast.Constant) and s.value == 0.5 for s in (node.left, node.right))
            for node in nodes(path)
        )
    }
    assert users <= {"geometry.conventions"}


def test_library_neither_prints_nor_exits_outside_the_command_line() -> None:
    for module in set(MODULES) - {"cli", "cli.commands", "progress", "__main__"}:
        tree = nodes(MODULES[module])
        names = {node.id for node in tree if isinstance(node, ast.Name)}
        attributes = {node.attr for node in tree if isinstance(node, ast.Attribute)}
        assert not {"print", "SystemExit"} & names, module
        assert not {"exit", "_exit", "basicConfig"} & attributes, module


def test_public_names_are_the_promised_ones_and_load() -> None:
    for name in set(colmap_affrect.__all__) - {"__version__"}:
        assert getattr(colmap_affrect, name).__doc__.strip(), name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        colmap_affrect.nothing  # noqa: B018


def test_import_is_light_and_emits_no_warning() -> None:
    script = (
        "import sys, colmap_affrect, logging\n"
        "heavy = {'numpy', 'pycolmap', 'cv2', 'h5py', 'torch', 'kornia', 'tqdm', 'filelock'}\n"
        "print(sorted(heavy & set(sys.modules)), 'zlib' in sys.modules, logging.root.handlers)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "[] True []\n"


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
