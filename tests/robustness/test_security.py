"""Nothing executes what it reads, and nothing is written outside the output folder."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import h5py
import pytest
from command import FAST, Call
from results import tree
from small_scene import write_photographs

import colmap_affrect
from colmap_affrect.project.feature_store import FeatureStore

PACKAGE = Path(colmap_affrect.__file__).parent


def test_no_source_can_load_code_with_data() -> None:
    # Ruff's rules of flake8-bandit forbid eval, pickle and shells; what they do not know is here.
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        loads = re.findall(
            r"(?:torch|np)\.load\([^)]*|format.read_array\([^)]*", source
        )
        for load in loads:
            assert re.search("allow_pickle=False|weights_only=True", load), path
        assert not re.search(
            r"trust_remote_code=True|import (joblib|cloudpickle)", source
        ), path
        # Workers unpickle what the command that leads them sends, and nothing that a file holds.
        unpickles = path.name in ("cluster.py", "worker.py")
        assert unpickles or not re.search("noqa.*S(102|30[127]|60[245])", source)


@pytest.mark.long
def test_nothing_is_written_outside_the_output_folder(
    tmp_path: Path, call: Call
) -> None:
    photos, elsewhere, out = (
        tmp_path / name for name in ("photos", "elsewhere", "out")
    )
    write_photographs(photos, 3)
    write_photographs(elsewhere, 2)
    (photos / "link.png").symlink_to(elsewhere / "a.png")
    (photos / "linked folder").symlink_to(elsewhere)
    (photos / "...").mkdir()
    for name in ("..png", ".../....png", "features.h5.png"):
        (photos / name).write_bytes((photos / "a.png").read_bytes())
    before = tree(tmp_path)
    ended = call("run", "--image-path", photos, "--output-path", out, "--json", *FAST)
    assert ended.code == 0, ended.stderr
    assert {"link.png", "features.h5.png"} <= set(ended.report["registered_names"])
    assert tree(tmp_path, out) == before
    assert not any(path.is_symlink() for path in out.rglob("*"))


def test_features_of_somebody_else_lead_nowhere(tmp_path: Path, call: Call) -> None:
    # A group that is a link to another file, in a file of features that was tampered with.
    photos = tmp_path / "photos"
    out = tmp_path / "out"
    write_photographs(photos, 2)
    run = ["run", "--image-path", photos, "--output-path", out, *FAST]
    assert call(*run).code == 0
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        file.create_group("x").attrs["content"] = ""
    with h5py.File(out / "features.h5", "a") as file:
        file["zz.png"] = h5py.ExternalLink(os.fspath(tmp_path / "outside.h5"), "x")
        file["../../escaped.png"] = h5py.SoftLink("/a.png")
    before = tree(tmp_path, out)
    assert call(*run).code == 0
    assert tree(tmp_path, out) == before


@pytest.mark.long
def test_any_name_of_a_file_comes_through_or_is_left_out_with_a_line(
    tmp_path: Path, call: Call
) -> None:
    photos = tmp_path / "photos"
    out = tmp_path / "out"
    write_photographs(photos, 2)
    image = (photos / "a.png").read_bytes()
    taken = ["\u202etxt.png", "=1+1.png", "\U0001f600 \u200d.png", "-rf.png"]
    odd = [b"\xff.png", b"new\nline.png", b"\x1b[31mred.png", b"\xfe.heic"]
    for name in [*map(os.fsencode, taken), *odd]:
        Path(os.fsdecode(os.fsencode(photos) + b"/" + name)).write_bytes(image)
    run = ["run", "--image-path", photos, "--output-path", out, *FAST]
    ended = call(*run)
    assert ended.code in (0, 3)
    warnings = "\n".join(ended.stderr)
    assert (
        "names: 2 left out, such as \\u001b[31mred.png: the name has a line break"
        in warnings
    )
    assert "1 left out, such as \\udcff.png" in warnings
    assert "*.heic: 1 left out, such as \\udcfe.heic" in warnings
    log = (out / "run.log").read_text(encoding="utf-8")
    shown = ended.stdout + warnings + log
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["images_total"] == 2 + len(taken)
    assert FeatureStore(out / "features.h5").names() == sorted(
        ["a.png", "b c.png", *taken]
    )
    ended = call(*run, "--json")
    assert set(taken) <= {
        *ended.report["registered_names"],
        *ended.report["unregistered"],
    }
    assert not any(c in shown + ended.stdout for c in "\x1b\u202e\u200d")


@pytest.mark.parametrize(("name", "code", "said"), [
    (b"\x1b[31m\nred", 2, "\\u001b[31m\\u000ared: no such folder"),
    (b"\xff", 1, "which is not UTF-8; rename that file or folder"),
])  # fmt: skip
def test_name_of_a_folder_cannot_steer_the_terminal(
    tmp_path: Path, call: Call, name: bytes, code: int, said: str
) -> None:
    photos = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    if code == 1:
        write_photographs(photos, 2)
    ended = call(
        "run", "--image-path", photos, "--output-path", tmp_path / "out", *FAST
    )
    assert (ended.code, len(ended.stderr)) == (code, 1)
    assert said in ended.errors[0]
