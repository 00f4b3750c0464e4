"""The one door for what is written outside of a work folder."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import colmap_affrect
from colmap_affrect.errors import OptionError
from colmap_affrect.project import outputs
from colmap_affrect.project.outputs import (
    new_results,
    refuse_photographs,
    temporary_folder,
)
from colmap_affrect.project.workspace import Workspace

PACKAGE = Path(colmap_affrect.__file__).parent


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


def write_all(paths: list[Path]) -> None:
    for path in paths:
        if path.suffix:
            path.write_text("new")
        else:
            path.mkdir()
            (path / "inside.txt").write_text("new")


def make(*targets: Path, then: Callable[[], object]) -> None:
    with new_results(*targets) as made:
        write_all(made)
        then()


def test_results_appear_together(tmp_path: Path) -> None:
    targets = [tmp_path / "out" / "a.txt", tmp_path / "out" / "b", tmp_path / "c.txt"]
    with new_results(*targets) as made:
        write_all(made)
        assert not any(target.exists() for target in targets)
    assert content(tmp_path) == {
        "out": b"", "out/a.txt": b"new", "out/b": b"", "out/b/inside.txt": b"new", "c.txt": b"new",
    }  # fmt: skip


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_failure_takes_away_what_was_made_and_nothing_else(
    tmp_path: Path, error: type
) -> None:
    def save_and_fail() -> None:
        (tmp_path / "new" / "of the user.txt").write_text("mine")
        raise error

    with pytest.raises(error):
        make(tmp_path / "new" / "a.txt", tmp_path / "b.txt", then=save_and_fail)
    assert content(tmp_path) == {"new": b"", "new/of the user.txt": b"mine"}


@pytest.mark.parametrize("name", ["a.txt", "b"])
def test_what_comes_to_be_there_meanwhile_stays_and_nothing_is_half_there(
    tmp_path: Path, name: str
) -> None:
    targets = [tmp_path / other for other in ("c.txt", "d", "a.txt", "b")]
    with pytest.raises(OptionError, match="exists, and is left"):
        make(*targets, then=lambda: (tmp_path / name).write_text("mine"))
    assert content(tmp_path) == {name: b"mine"}


@pytest.mark.parametrize(("prepare", "why"), [
    (lambda path: path.symlink_to("elsewhere.txt"), "is a symbolic link"),
    (lambda path: path.write_text("mine"), "exists, and is left"),
])  # fmt: skip
def test_what_is_in_the_way_is_refused_before_anything_is_made(
    tmp_path: Path, prepare: Callable[[Path], None], why: str
) -> None:
    prepare(tmp_path / "a.txt")
    before = content(tmp_path)
    with pytest.raises(OptionError, match=why), new_results(tmp_path / "a.txt"):
        pytest.fail("nothing may be made")
    assert content(tmp_path) == before


def test_nothing_is_made_beside_the_models_of_a_run(tmp_path: Path) -> None:
    Workspace(tmp_path).begin()
    with pytest.raises(OptionError, match="lies beside the models of a run"):
        make(tmp_path / "sparse" / "metric", then=list)


def test_among_photographs_only_work_folders_are_written(tmp_path: Path) -> None:
    photographs = tmp_path / "photographs"
    names = ["a.png", "side/b.png", "../c.png"]
    for name in names[:2]:
        (photographs / name).parent.mkdir(parents=True, exist_ok=True)
        (photographs / name).touch()
    work = Workspace(photographs / "out")
    refuse_photographs(tmp_path / "photographs2", names)
    (tmp_path / "link").symlink_to(photographs)
    for target in (photographs, work.path / "export", tmp_path / "link"):
        with pytest.raises(OptionError, match="lies in the folder of the photographs"):
            refuse_photographs(target / "a.ply", names)
    work.begin()
    refuse_photographs(work.path / "export" / "a.ply", names)


def test_folder_that_another_process_tidies_up_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    removed = []

    class Late(outputs.FileLock):
        def __enter__(self) -> Late:
            lock = super().__enter__()
            if not removed:
                removed.append(Path(self.lock_file).parent)
                shutil.rmtree(removed[0])
            return lock

    monkeypatch.setattr(outputs, "FileLock", Late)
    with temporary_folder(tmp_path) as folder:
        assert folder.is_dir()
        assert folder != removed[0]
    assert list(tmp_path.iterdir()) == []


def test_temporary_folders_of_killed_processes_are_removed_and_no_others(
    tmp_path: Path,
) -> None:
    (tmp_path / ".affrect-killed" / "sub").mkdir(parents=True)
    (tmp_path / ".affrect-killed" / ".lock").touch()
    (tmp_path / ".affrect-of-somebody").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / ".affrect-link").symlink_to(tmp_path / "elsewhere")
    with temporary_folder(tmp_path) as first, temporary_folder(tmp_path) as second:
        assert first != second
        assert first.is_dir()
        assert not (tmp_path / ".affrect-killed").exists()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {".affrect-link", ".affrect-of-somebody", "elsewhere"}
    assert not list((tmp_path / "elsewhere").iterdir())


OUTSIDE = ("interop", "comparison", "evaluation", "report", "cli", "images/conversion.py",
           "colmap/old_databases.py")  # fmt: skip
"""Where results are made for other folders than those of runs."""

CHANGING = {
    "copy", "copy2", "copyfile", "copytree", "export_PLY", "hardlink_to", "imwrite", "link",
    "mkdir", "move", "rename", "rmdir", "rmtree", "savefig", "symlink_to", "touch", "unlink",
    "write_bytes", "write_model", "write_text",
}  # fmt: skip

BY_THE_DOOR = {
    "align.py", "pycolmap_api.py", "export.py", "hdf5.py",
    "conversion.py", "line_pictures.py", "method_run.py", "printed_report.py",
}  # fmt: skip
"""Write where the door lets them."""

IN_WORK_FOLDERS = {
    "worker.py", "method_run.py", "evaluate.py", "__init__.py", "run_results.py",
    "drawn.py", "map_again.py",
}  # fmt: skip
"""Write where the door has refused folders of others, and links."""


def changes(call: ast.Call) -> bool:
    """Tell whether a call changes files: by its name, or as an open for writing."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    values = [*call.args, *(word.value for word in call.keywords)]
    texts = [value.value for value in values if isinstance(value, ast.Constant)]
    if name in ("open", "File"):
        return any(isinstance(text, str) and set("wax+") & set(text) for text in texts)
    if name == "replace":  # of a path, not of a text
        return len(call.args) == 1 and not call.keywords
    # shutil.copy, not the copy of an array
    return name in CHANGING and not (name == "copy" and not values)


def test_nothing_else_writes_outside_of_work_folders() -> None:
    places = [PACKAGE / place for place in OUTSIDE]
    writing = {
        file.name
        for place in places
        for file in (place.rglob("*.py") if place.is_dir() else [place])
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and changes(node)
    }
    assert writing <= BY_THE_DOOR | IN_WORK_FOLDERS
