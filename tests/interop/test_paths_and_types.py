"""What functions take and say in Python: paths as text, types that checkers see, argument names."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import colmap_affrect
from colmap_affrect.doctor import diagnose
from colmap_affrect.errors import (
    AffrectError,
    Option,
    OptionError,
    with_arguments,
    with_flags,
)
from colmap_affrect.interop.align import Reference, align
from colmap_affrect.interop.export import export
from colmap_affrect.interop.hdf5 import export_h5, import_h5

TAKING_PATHS: dict[str, Callable[[Any, Any], object]] = {
    "run": colmap_affrect.run,
    "map_database": colmap_affrect.map_database,
    "compare": colmap_affrect.compare,
    "evaluate": lambda a, b: colmap_affrect.evaluate("evd", a, b),
    "export_h5": lambda a, b: export_h5(a, b, b + b),
    "import_h5": lambda a, b: import_h5(a, b, b, b),
    "export": lambda a, b: export(a, b, ["ply"]),
    "align": lambda a, b: align(a, b, Reference(gps_database=a)),
    "diagnose": lambda a, b: diagnose(a, weights_path=b),
    "extract_features": lambda a, b: colmap_affrect.extract_features(b, a),
    "match_exhaustive": lambda a, _: colmap_affrect.match_exhaustive(a),
    "verify_matches": lambda a, _: colmap_affrect.verify_matches(a),
    "incremental_mapping": lambda a, b: colmap_affrect.incremental_mapping(a, "", b),
}


@pytest.mark.parametrize("name", TAKING_PATHS)
def test_paths_are_text_too_and_bytes_are_refused_in_words(
    name: str, tmp_path: Path
) -> None:
    missing = str(tmp_path / "missing")
    out = str(tmp_path / "out")
    with pytest.raises(AffrectError, match="missing"):
        TAKING_PATHS[name](missing, out)
    with pytest.raises(
        OptionError,
        match=r"^\w+(=|: )b'.*': give a path as str or os\.PathLike, not bytes$",
    ):
        TAKING_PATHS[name](missing.encode(), out.encode())


def test_options_take_both_kinds_of_paths() -> None:
    options = colmap_affrect.RunOptions(
        image_list_path="list.txt",  # type: ignore[arg-type]
        extend=colmap_affrect.Extension(model_path="model"),  # type: ignore[arg-type]
        cameras=colmap_affrect.CameraOptions(cameras_path=Path("model")),  # type: ignore[arg-type]
    )
    assert options.image_list_path == Path("list.txt")
    assert options.extend == colmap_affrect.Extension(model_path=Path("model"))
    assert (options.cameras.cameras_path, options.from_database) == ("model", None)


def test_errors_of_functions_name_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        AffrectError, "__str__", lambda error: with_arguments(error.words)
    )
    with pytest.raises(OptionError, match=r"^image_path \S+none: no such folder$"):
        export(tmp_path, tmp_path / "out", ["ply"], image_path=tmp_path / "none")
    error = AffrectError(
        "has no mask",
        where=Option("mask-path", "x"),
        advice=("use 'colmap-affrect run --set a=1' or ", Option("extend")),
    )
    says = "has no mask; use 'colmap-affrect run --set a=1' or"
    assert str(error) == f"masks.path x: {says} extend"
    assert with_flags(error.words) == f"--mask-path x: {says} --extend"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(
        OptionError, match=r"call extract_features first, or move this folder"
    ):
        colmap_affrect.match_exhaustive(tmp_path / "a.db")


SCRIPT = """
import colmap_affrect
from colmap_affrect import pycolmap
from colmap_affrect.pycolmap.panorama import reconstruct

report = colmap_affrect.run(
    "photos", "out", colmap_affrect.RunOptions(effort="low"), cameras={"mode": "single"}
)
reveal_type(report)
reveal_type(report.reconstruction())
reveal_type(pycolmap.extract_features("a.db", "photos"))
reveal_type(pycolmap.match_exhaustive("a.db"))
reveal_type(pycolmap.Reconstruction())
reveal_type(reconstruct("panoramas", "out"))
reveal_type(pycolmap.__version__)
pycolmap.no_such_name
colmap_affrect.run("photos", "out", efort="low")
colmap_affrect.CameraOptions(mod="single")
"""


@pytest.mark.long
def test_type_checkers_see_the_types(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", tmp_path, "script.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(Path(colmap_affrect.__file__).parents[1])},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    said = done.stdout.splitlines()
    lines = [line for line in said if "Revealed type" in line]
    name, keyword, field = (line for line in said if " error: " in line)
    report = "colmap_affrect.project.stage_report"
    assert [line.partition("Revealed type is ")[2] for line in lines] == [
        '"colmap_affrect.report.run_report.RunReport"',
        '"pycolmap._core.Reconstruction"',
        f'"{report}.StageReport"',
        f'"tuple[{report}.StageReport, ...]"',
        '"pycolmap._core.Reconstruction"',
        '"dict[int, pycolmap._core.Reconstruction]"',
        '"str"',
    ]
    assert "no_such_name" in name
    assert 'Unexpected keyword argument "efort"' in keyword
    assert 'Unexpected keyword argument "mod"' in field
