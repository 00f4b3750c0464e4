"""Nothing executes what it reads, and nothing is written outside the output folder."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import h5py
import pytest
from command import FAST, Call
from small_scene import write_photographs

import colmap_affrect

PACKAGE = Path(colmap_affrect.__file__).parent

FORBIDDEN_NAMES = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_MODULES = {"marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}

TASKS = {"cluster.py": {"dumps", "loads"}}
"""Workers unpickle what the command that leads them sends, and nothing that a file holds."""


def dotted(node: ast.expr) -> str:
    """Name of what is called, such as ``torch.load``."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def offences(source: str) -> list[str]:
    """What executes data, or could, in the source of a module."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [item.name for item in node.names if item.name in FORBIDDEN_MODULES]
        if isinstance(node, ast.ImportFrom) and node.module in {*FORBIDDEN_MODULES, "pickle"}:
            found += [item.name for item in node.names if item.name != "UnpicklingError"]
        if isinstance(node, ast.Attribute) and dotted(node.value) == "pickle":
            found += [node.attr] * (node.attr != "UnpicklingError")
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        given = {
            item.arg: item.value.value if isinstance(item.value, ast.Constant) else "unknown"
            for item in node.keywords
        }
        wrong = (
            name in FORBIDDEN_NAMES
            or name in ("os.system", "os.popen", "subprocess.getoutput")
            or bool(given.get("shell", False))
            or bool(given.get("trust_remote_code", False))
            or bool(given.get("allow_pickle", False))
            or (name.endswith("torch.load") and given.get("weights_only") is not True)
            or (name.endswith("np.load") and given.get("allow_pickle") is not False)
        )
        found += [name] * wrong
    return found


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_module_executes_no_data(path: Path) -> None:
    assert set(offences(path.read_text(encoding="utf-8"))) == TASKS.get(path.name, set())


@pytest.mark.parametrize(
    "source",
    [
        "eval(text)",
        "pickle.loads(data)",
        "import marshal",
        "from pickle import loads",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.lib.format.read_array(stream, allow_pickle=flag)",
        "subprocess.run(command, shell=True)",
    ],
)
def test_offences_are_found(source: str) -> None:
    assert len(offences(source)) == 1


def state(folder: Path, *, without: Path) -> dict[str, tuple[bytes, int]]:
    """Content and time of all files and folders of a tree but for one of its folders."""
    return {
        str(path): (path.read_bytes() if path.is_file() else b"", path.lstat().st_mtime_ns)
        for path in folder.rglob("*")
        if path != without and without not in path.parents
    }


def test_nothing_is_written_outside_the_output_folder(tmp_path: Path, call: Call) -> None:
    photos, elsewhere, out = (tmp_path / name for name in ("photos", "elsewhere", "out"))
    write_photographs(photos, 3)
    write_photographs(elsewhere, 2)
    (photos / "link.png").symlink_to(elsewhere / "a.png")
    (photos / "linked folder").symlink_to(elsewhere)
    (photos / "..png").write_bytes((photos / "a.png").read_bytes())
    (photos / "...").mkdir()
    (photos / "....png").write_bytes((photos / "a.png").read_bytes())
    (photos / "features.h5.png").write_bytes((photos / "a.png").read_bytes())
    out.mkdir()
    before = state(tmp_path, without=out)
    ended = call("run", "--image-path", photos, "--output-path", out, "--json", *FAST)
    assert ended.code == 0, ended.stderr
    assert {"link.png", "features.h5.png"} <= set(ended.report["registered_names"])
    assert state(tmp_path, without=out) == before
    assert not any(path.is_symlink() for path in out.rglob("*"))


@pytest.mark.parametrize(
    "name", ["../elsewhere/a.png", "side/../../elsewhere/a.png", "{elsewhere}/a.png", "..", "/"]
)
def test_listed_name_that_leads_out_of_the_folder_is_refused(
    tmp_path: Path, call: Call, name: str
) -> None:
    photos, elsewhere, out = (tmp_path / name for name in ("photos", "elsewhere", "out"))
    write_photographs(photos, 3)
    write_photographs(elsewhere, 1)
    listed = tmp_path / "list.txt"
    listed.write_text(f"a.png\n{name.format(elsewhere=elsewhere)}\n", encoding="utf-8")
    out.mkdir()
    before = state(tmp_path, without=out)
    images = ["--image-path", photos, "--image-list-path", listed]
    ended = call("run", *images, "--output-path", out, *FAST)
    assert (ended.code, ended.stdout, len(ended.stderr)) == (1, "", 1)
    assert "which is not in" in ended.stderr[0]
    assert state(tmp_path, without=out) == before
    assert not (out / "features.h5").exists()


def test_features_of_somebody_else_lead_nowhere(tmp_path: Path, call: Call) -> None:
    # A group that is a link to another file, in a file of features that was tampered with.
    photos, out = tmp_path / "photos", tmp_path / "out"
    write_photographs(photos, 2)
    run = ["run", "--image-path", photos, "--output-path", out, *FAST]
    assert call(*run).code == 0
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        file.create_group("x").attrs["complete"] = True
    with h5py.File(out / "features.h5", "a") as file:
        file["zz.png"] = h5py.ExternalLink(os.fspath(tmp_path / "outside.h5"), "x")
        file["../../escaped.png"] = h5py.SoftLink("/a.png")
    before = state(tmp_path, without=out)
    assert call(*run).code == 0
    assert state(tmp_path, without=out) == before


def test_message_cannot_steer_the_terminal(tmp_path: Path, call: Call) -> None:
    ended = call("run", "--image-path", tmp_path / "\x1b[31m\nred", "--output-path", tmp_path / "o")
    assert (ended.code, len(ended.stderr)) == (1, 1)
    assert "\\x1b[31m\\nred: no such folder" in ended.stderr[0]
