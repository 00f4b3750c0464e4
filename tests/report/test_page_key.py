"""The page of a run stays while what it was made from does."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_run import small_report

from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.stage_report import StageReport, StageWarning
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.page_key import is_current, page_key
from colmap_affrect.report.run_page import RunContent, write_run_page
from colmap_affrect.report.run_report import RunReport

MARKS = {"1": {"a.jpg": np.array([3.0, 4.0])}}
NAMES = ("a.jpg", "b.jpg")
COMMANDS = ("colmap-affrect map", "colmap-affrect run")


def whole_report(folder: Path) -> RunReport:
    """A report that can be written."""
    options = {"name": "sparse", "mapper_options": {}, "random_seed": 0}
    report = small_report(folder)
    return replace(report, verification={"random_seed": 0}, mapping=options)


def key_of(workspace: Workspace, report: RunReport) -> str:
    return page_key(workspace, report, NAMES, MARKS, COMMANDS)


def changed_model(workspace: Workspace, report: RunReport) -> RunReport:
    summary = workspace.sparse / "0" / "summary.json"
    summary.write_text(json.dumps({"model": {"images.bin": "other"}}))
    return report


def changed_matches(workspace: Workspace, report: RunReport) -> RunReport:
    workspace.matches.write_bytes(b"others")
    return report


def slower(_: Workspace, report: RunReport) -> RunReport:
    stages = [replace(stage, wall_s=9.0, num_done=7) for stage in report.stages]
    return replace(report, stages=tuple(stages))


def warned(_: Workspace, report: RunReport) -> RunReport:
    gone = StageWarning("photograph_gone", "a.jpg")
    return replace(report, stages=(StageReport("map", 0.1, 1, warned=(gone,)),))


def without_a_photograph(workspace: Workspace, report: RunReport) -> RunReport:
    (workspace.path.parent / "photographs" / "a.jpg").unlink()
    return report


def updated(_: Workspace, report: RunReport) -> RunReport:
    return replace(report, versions={**installed_versions(), "numpy": "9.9"})


@pytest.mark.parametrize(
    ("change", "stays"),
    [
        (slower, True),
        (updated, False),
        (warned, False),
        (without_a_photograph, False),
        (changed_model, False),
        (changed_matches, False),
    ],
)
def test_a_page_is_current_while_nothing_that_it_shows_has_changed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[Workspace, RunReport], RunReport],
    *,
    stays: bool,
) -> None:
    report = whole_report(tmp_path)
    workspace = Workspace(tmp_path / "out")
    (workspace.sparse / "0").mkdir(parents=True)
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    (photographs / "a.jpg").touch()
    monkeypatch.setattr(Workspace, "photographs", lambda _: photographs)
    key = key_of(workspace, report)
    write_run_page(workspace, report, RunContent((), {}, key=key))
    assert is_current(workspace, key)
    report = change(workspace, report)
    assert is_current(workspace, key_of(workspace, report)) == stays


def test_marks_commands_and_files_beside_a_page_count(tmp_path: Path) -> None:
    report = whole_report(tmp_path)
    workspace = Workspace(tmp_path)
    key = key_of(workspace, report)
    assert key != page_key(workspace, report, NAMES, {}, COMMANDS)
    assert key != page_key(workspace, report, NAMES, MARKS, COMMANDS[:1])
    assert not is_current(workspace, key)  # there is none yet
    write_run_page(workspace, report, RunContent((), {}, key=key))
    assert is_current(workspace, key)
    workspace.page_file(1).touch()
    assert not is_current(workspace, key)


def test_a_page_of_a_database_that_others_may_change_is_made_again(
    tmp_path: Path,
) -> None:
    report = whole_report(tmp_path)
    workspace = Workspace(tmp_path)
    workspace.is_changed = True
    key = key_of(workspace, report)
    write_run_page(workspace, report, RunContent((), {}, key=key))
    assert not is_current(workspace, key)
