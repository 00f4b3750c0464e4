"""Parts of other packages that are wrong are named when they are loaded, with their package."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from colmap_affrect.errors import OptionError
from colmap_affrect.features.base import EXTRACTORS, SHAPES
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.matchers.base import MATCHERS
from colmap_affrect.options import Registry
from colmap_affrect.recipes import load_recipe
from colmap_affrect.rectifiers.base import RECTIFIERS

REGISTRIES = [EXTRACTORS, SHAPES, RECTIFIERS, MATCHERS, MAPPERS]
RIGHT = """
from typing import ClassVar, Literal
from colmap_affrect.rectifiers.base import RectifierOptions

class OwnOptions(RectifierOptions):
    name: Literal["own"] = "own"
    warps: ClassVar = "some"

class Own:
    Options = OwnOptions

    def plan(self, photograph): ...
"""
WRONG = {
    "cannot be loaded (ModuleNotFoundError: No module named 'not_there')": RIGHT.replace(
        "from typing", "import not_there\nfrom typing", 1
    ),
    "cannot be loaded (ZeroDivisionError: division by zero)": "1 / 0",
    "cannot be loaded (AttributeError: module 'own_part' has no attribute 'Own')": "",
    "has no class 'Options' with the base RectifierOptions": RIGHT.replace(
        "Options = Own", "x = Own"
    ),
    "the name in its options is 'other'": RIGHT.replace('"own"', '"other"'),
    "OwnOptions must say what its 'warps' are": RIGHT.replace(
        "warps: ClassVar", "else_: ClassVar"
    ),
    "has no method 'plan'": RIGHT.replace("def plan", "def plans"),
}


def install(folder: Path, package: str, code: str, module: str = "own_part") -> None:
    """Leave a package on the path as pip does."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n"
    )
    (info / "entry_points.txt").write_text(
        f"[{RECTIFIERS.group}]\nown = {module}:Own\n"
    )
    (folder / f"{module}.py").write_text(code, encoding="utf-8")


@pytest.fixture(autouse=True)
def _path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_part", raising=False)


@pytest.mark.parametrize("problem", WRONG)
def test_wrong_part_is_named_with_its_package_and_what_is_wrong(
    problem: str, tmp_path: Path
) -> None:
    install(tmp_path, "other-affrect", WRONG[problem])
    where = "rectifier 'own' of other-affrect 1.0 (own_part:Own)"
    said = f"{where}: {problem}; mend or uninstall that package"
    with pytest.raises(OptionError, match=re.escape(said)):
        load_recipe("default", ["rectifier=own"])
    assert "own" in RECTIFIERS.names()
    assert load_recipe("default").rectifier.name == "dense-shapes", (
        "others are not touched"
    )


def test_right_part_is_taken_and_one_of_two_packages_is_not(tmp_path: Path) -> None:
    install(tmp_path, "other-affrect", RIGHT)
    assert load_recipe("default", ["rectifier=own"]).rectifier.name == "own"
    install(tmp_path, "third-affrect", RIGHT)
    packages = (
        r"other-affrect 1\.0 \(own_part:Own\), third-affrect 1\.0 \(own_part:Own\)"
    )
    with pytest.raises(
        OptionError, match=rf"{packages}: several packages have that name"
    ):
        load_recipe("default", ["rectifier=own"])


@pytest.mark.parametrize("registry", REGISTRIES, ids=lambda registry: registry.kind)
def test_parts_of_this_package_have_what_is_asked_of_those_of_others(
    registry: Registry[object],
) -> None:
    for name in registry.built_in:
        assert registry.problem(registry.part(name), name) == ""
