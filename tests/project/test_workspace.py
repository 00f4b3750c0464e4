"""The output folder: what may be done in it, and what is on record."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_affrect.errors import OptionError, StoreError, WorkspaceError
from colmap_affrect.project.record import STAGES as ALL_STAGES
from colmap_affrect.project.record import first_difference
from colmap_affrect.project.workspace import Workspace

STAGES = tuple(stage for stage in ALL_STAGES if stage != "copy")

OPTIONS = {
    "image_path": "photos", "camera": {"mode": "auto"}, "part": {"name": "one"},
    "sigmas": (8.0, 16.0), "size": 3,
}  # fmt: skip


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


@pytest.fixture
def finished(workspace: Workspace) -> Workspace:
    """A workspace with all stages on record and something in each of their files."""
    for stage in STAGES:
        workspace.record_options(stage, {"by": stage}, recipe="default")
    files = (workspace.features, workspace.pairs, workspace.matches, workspace.guided)
    for path in (*files, workspace.database, workspace.cameras):
        path.write_bytes(path.name.encode())
    (workspace.sparse / "0").mkdir(parents=True)
    (workspace.sparse / "0" / "images.bin").write_bytes(b"model")
    workspace.report.write_text("{}")
    workspace.page.write_text("<html>")
    workspace.page_file(1).write_text("page.takePairs({})")
    return workspace


def test_record_options_puts_the_options_on_record(workspace: Workspace) -> None:
    plan = {"match": {"max_ratio": 0.8}, "extract": {}}
    workspace.record_options("extract", OPTIONS, plan=plan, recipe="default")
    workspace.record_options("pairs", {"match_list_path": ""})
    assert workspace.record() == {
        "recipe": "default",
        "planned": {"match": {"max_ratio": 0.8}},
        "extract": {**OPTIONS, "sigmas": [8.0, 16.0]},
        "pairs": {"match_list_path": ""},
    }
    assert workspace.recipe() == "default"
    assert workspace.options_on_record("match") == {"max_ratio": 0.8}
    with pytest.raises(OptionError, match="the match stage has not been run"):
        workspace.require("match")
    assert workspace.require("extract")["camera"] == {"mode": "auto"}
    assert [path.name for path in workspace.path.iterdir()] == ["config.toml"]


@pytest.mark.parametrize(("changed", "named"), [
    ({**OPTIONS, "size": 4}, "size=3, and it is 4 now"),
    ({**OPTIONS, "camera": {"mode": "single"}}, "camera.mode='auto', and it is 'single' now"),
    ({**OPTIONS, "sigmas": (8.0,)}, "sigmas=[8.0, 16.0], and it is [8.0] now"),
    ({**OPTIONS, "more": True}, "more=None, and it is True now"),
    ({**OPTIONS, "camera": {}}, "camera.mode='auto', and it is None now"),
    # The name of a part before its options.
    ({**OPTIONS, "part": {"depth": 2, "name": "two"}}, "part.name='one', and it is 'two' now"),
])  # fmt: skip
def test_record_options_with_other_options_names_the_first_that_differs(
    workspace: Workspace, changed: dict[str, object], named: str
) -> None:
    workspace.record_options("extract", OPTIONS)
    before = workspace.config.read_bytes()
    why = f"^.*the extract stage was run there with {re.escape(named)}.*--overwrite.*$"
    with pytest.raises(StoreError, match=why):
        workspace.record_options("extract", changed)
    assert workspace.config.read_bytes() == before


KEPT = {
    "extract": [],
    "pairs": ["features.h5"],
    "match": ["features.h5", "pairs.txt"],
    "verify": ["features.h5", "matches.h5", "pairs.txt"],
    "escalate": [
        "cameras.json",
        "database.db",
        "features.h5",
        "matches.h5",
        "pairs.txt",
    ],
    "guide": ["cameras.json", "database.db", "features.h5", "matches.h5", "pairs.txt"],
    "map": [
        "cameras.json",
        "database.db",
        "features.h5",
        "guided.h5",
        "matches.h5",
        "pairs.txt",
    ],
}


@pytest.mark.parametrize("stage", STAGES)
def test_record_options_with_overwrite_discards_this_stage_and_later_ones(
    finished: Workspace, stage: str
) -> None:
    finished.record_options(
        stage, {"by": "somebody else"}, recipe="default", overwrite=True
    )
    left = sorted(path.name for path in finished.path.iterdir())
    assert left == sorted(["config.toml", *KEPT[stage]])
    record = finished.record()
    earlier = STAGES[: STAGES.index(stage)]
    assert record.pop("recipe") == "default"
    # What was chosen for later stages is kept, unless everything begins anew.
    later = STAGES[len(earlier) + 1 :] if earlier else ()
    assert record.pop("planned", {}) == {name: {"by": name} for name in later}
    assert record == {
        **{name: {"by": name} for name in earlier},
        stage: {"by": "somebody else"},
    }
    assert finished.started_stages == [*earlier, stage]


def test_run_and_copy_of_a_database_keep_out_of_each_others_folder(
    finished: Workspace, tmp_path: Path
) -> None:
    with pytest.raises(
        StoreError, match="the extract stage was run there, which copy cannot"
    ):
        finished.record_options("copy", {}, overwrite=True)
    copied = Workspace(tmp_path / "copy")
    copied.path.mkdir()
    stages = ["copy", "verify", "map"]
    for stage in stages:
        copied.record_options(stage, {"by": stage})
    copied.database.write_bytes(b"copy")
    assert copied.started_stages == stages
    with pytest.raises(
        StoreError, match="the copy stage was run there, which extract cannot"
    ):
        copied.record_options("extract", {})
    copied.snapshots.mkdir()
    copied.record_options("copy", {"by": "another"}, overwrite=True)
    assert sorted(path.name for path in copied.path.iterdir()) == ["config.toml"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "name", ["database.db", "sparse/0/images.bin", "features.h5", "matches.h5"]
)
def test_results_of_somebody_else_are_refused_and_left_as_they_are(
    workspace: Workspace, name: str, overwrite: bool
) -> None:
    path = workspace.path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"SQLite format 3\0 or so")
    with pytest.raises(
        StoreError, match="was not made here, and is left as it is"
    ) as error:
        workspace.record_options("extract", OPTIONS, overwrite=overwrite)
    assert str(workspace.path / name.split("/")[0]) in str(error.value)
    assert path.read_bytes() == b"SQLite format 3\0 or so"
    assert not workspace.config.exists()


@pytest.mark.parametrize("kind", ["file", "pipe", "link to nothing"])
def test_what_is_no_folder_is_not_taken_for_one(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "out"
    if kind == "file":
        path.write_text("mine")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("nowhere")
    with pytest.raises(OptionError, match=r"out: is not a folder; give a new or an em"):
        Workspace(path).require_own()


def test_only_empty_folders_and_our_own_are_taken(tmp_path: Path) -> None:
    out = Workspace(tmp_path / "out")
    out.require_own()
    out.path.mkdir()
    for name in (
        ".gitkeep",
        "desktop.ini",
        "config.toml.1234abcd.affrect-new",
        "run.log",
    ):
        (out.path / name).touch()
    out.require_own()
    (out.path / "report.html").write_text("mine")
    with pytest.raises(
        OptionError, match=r"is not empty \(report\.html\) and was not made by"
    ):
        out.begin()
    assert (out.path / "run.log").read_text() == ""
    (out.path / "report.html").unlink()
    out.begin()
    (out.path / "report.html").write_text("ours, now")
    out.require_own()
    with pytest.raises(OptionError, match="is the folder of the photographs"):
        out.require_own(tmp_path / "out" / ".." / "out")
    out.require_own(tmp_path)


@pytest.mark.parametrize(
    "name", [".lock", "run.log", "database.db-wal", "sparse", "methods"]
)
def test_links_in_the_place_of_our_files_are_refused(tmp_path: Path, name: str) -> None:
    out = Workspace(tmp_path / "out")
    out.path.mkdir()
    (out.path / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OptionError, match=f"{name}: is a symbolic link"), out.locked():
        pytest.fail("nothing may be made")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", ["metric/cameras.bin", "0/notes.txt", "notes.txt"])
def test_models_that_somebody_put_beside_ours_are_not_removed(
    workspace: Workspace, name: str
) -> None:
    workspace.record_options("extract", {})
    foreign = workspace.sparse / name
    foreign.parent.mkdir(parents=True, exist_ok=True)
    foreign.touch()
    with pytest.raises(
        StoreError, match="was not made by this run and would be removed"
    ):
        workspace.record_options("extract", {}, overwrite=True)
    assert foreign.exists()


LOCK_AND_WAIT = """
import sys
from pathlib import Path
from colmap_affrect.project.workspace import Workspace

with Workspace(Path(sys.argv[1])).locked():
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.mark.long
def test_folder_in_use_by_another_process_is_refused_until_it_ends(
    tmp_path: Path,
) -> None:
    workspace = Workspace(tmp_path / "new" / "out")
    other = subprocess.Popen(
        [sys.executable, "-c", LOCK_AND_WAIT, str(workspace.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with other:
        assert other.stdout.readline() == "locked\n"
        with (
            pytest.raises(
                WorkspaceError, match="another colmap-affrect is working in this folder"
            ),
            workspace.locked(),
        ):
            pass
        other.stdin.close()
    with workspace.locked() as again:
        assert again is workspace


def test_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    workspace = Workspace(tmp_path / "file" / "out")
    with (
        pytest.raises(
            WorkspaceError, match=r"out: cannot be used as output folder \(Not a dir"
        ),
        workspace.locked(),
    ):
        pass


OTHER_VERSION = (
    "was made by another version of .*; use another --output-path or remove it"
)


@pytest.mark.parametrize(("text", "message"), [
    ("[extract\nx = ", r"config\.toml: damaged"),
    ('recipe = "default"\n[extract]\nimage_path = "/photos"\n', OTHER_VERSION),
    ('format_version = 1\nrecipe = "default"\n', OTHER_VERSION),
])  # fmt: skip
def test_record_that_cannot_be_gone_on_with_is_one_clear_line(
    workspace: Workspace, text: str, message: str
) -> None:
    workspace.config.write_text(text)
    for read in (
        lambda: workspace.require("extract"),
        lambda: workspace.record_options("extract", OPTIONS, overwrite=True),
    ):
        with pytest.raises(WorkspaceError, match=f"^.*{message}.*$"):
            read()


def test_branch_begins_after_the_raw_matches(
    finished: Workspace, tmp_path: Path
) -> None:
    branch = finished.branch(tmp_path / "branches" / "one")
    names = ["cameras.json", "config.toml", "features.h5", "matches.h5", "pairs.txt"]
    assert sorted(path.name for path in branch.path.iterdir()) == names
    assert branch.features.read_bytes() == b"features.h5"
    assert branch.started_stages == ["extract", "pairs", "match"]
    record = branch.record()
    assert {**record, **record["planned"]} == {
        **finished.record(),
        "planned": record["planned"],
    }
    with pytest.raises(OptionError, match="the verify stage has not been run"):
        branch.require("verify")
    branch.record_options("verify", {"by": "another seed"})
    assert finished.require("verify") == {"by": "verify"}
    assert finished.database.exists()
    # What the branch discards stays where it came from.
    branch.record_options("match", {"by": "other options"}, overwrite=True)
    assert not branch.matches.exists()
    assert finished.matches.read_bytes() == b"matches.h5"


def test_a_long_value_that_differs_is_told_by_its_beginning_and_end() -> None:
    levels = [{"rectifier": "asift", "number": number} for number in range(100)]
    why = first_difference({"escalation": levels}, {"escalation": []})
    assert why.startswith("escalation=[{'rectifier': 'asift', 'number': 0}")
    assert why.endswith("'number': 99}], and it is [] now")
    assert len(why) < 250
