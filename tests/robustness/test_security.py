"""Nothing executes what it reads, and nothing is written outside the output folder."""

from __future__ import annotations

import os
import re
from pathlib import Path

import h5py
import pytest
from command import FAST, Call
from small_scene import write_photographs

import colmap_affrect

PACKAGE = Path(colmap_affrect.__file__).parent


def test_no_source_can_load_code_with_data() -> None:
    # Ruff's rules of flake8-bandit forbid eval, pickle and shells; what they do not know is here.
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        loads = re.findall(r"(?:torch|np)\.load\(.*|format.read_array\(.*", source)
        assert all(re.search("allow_pickle=False|weights_only=True", line) for line in loads), path
        assert not re.search(r"trust_remote_code=True|import (joblib|cloudpickle)", source), path
        # Workers unpickle what the command that leads them sends, and nothing that a file holds.
        assert path.name == "cluster.py" or not re.search("noqa.*S(102|30[127]|60[245])", source)


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
