"""A command that finds everything done reads neither models nor the rows of the database."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
from verified import CAMERAS, copy_of

from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import AffrectError
from colmap_affrect.pipeline import run
from colmap_affrect.pipeline.single_stages import (
    map_images,
    match,
    verify,
)
from colmap_affrect.project import record
from colmap_affrect.project.regular_files import sha256_of_regular
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import kept_figures
from colmap_affrect.report import photographs as photographs_module
from colmap_affrect.report.kept_figures import figures_digest
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.run_report import RunReport


@pytest.fixture(scope="module")
def finished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A run, and a command that has found everything done; nothing may be changed."""
    path = tmp_path_factory.mktemp("idle") / "out"
    run(photos, path, recipe="unrectified-rootsift", cameras=CAMERAS, page=False)
    map_again(Workspace(path))
    return Workspace(path)


def map_again(workspace: Workspace) -> RunReport:
    return map_images(workspace.path, page=False)


@pytest.fixture
def copy(finished: Workspace, tmp_path: Path) -> Workspace:
    """A copy, which has other times: it is sealed again."""
    copied = copy_of(finished, tmp_path / "copy")
    map_again(copied)
    return copied


def digest_on_record(workspace: Workspace) -> str:
    return workspace.seal.read_text().splitlines()[0]


def test_an_idle_command_reads_neither_models_nor_rows(
    copy: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = json.loads(copy.report.read_text())
    monkeypatch.setattr(ModelReader, "model", None)
    monkeypatch.setattr("colmap_affrect.session.view_graph.rows_digest", None)
    monkeypatch.setattr("colmap_affrect.session.view_graph._read_inliers", None)
    report = map_again(copy)
    assert report.photographs["a.png"].num_points > 30
    assert len(report.photographs["a.png"].neighbours) == 3
    after = json.loads(copy.report.read_text())
    assert after["photographs"] == before["photographs"]
    assert after["made_from"] == before["made_from"] != ""


def test_an_idle_run_looks_at_no_pair_and_reads_a_model_once(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Levels of the recipe differ in the size of photographs, which pairs are verified by."""

    def again() -> RunReport:
        return run(
            photos, tmp_path / "out", recipe="default", cameras=CAMERAS, page=False
        )

    before = again()
    hashed = list[str]()

    def sha256(path: Path) -> str:
        hashed.append(path.name)
        return sha256_of_regular(path)

    record._sha256.cache_clear()
    monkeypatch.setattr(record, "sha256_of_regular", sha256)
    for name in (
        "project.match_store.MatchStore.levels",
        "session.view_graph.rows_digest",
        "session.view_graph._read_inliers",
        "stages.guide.weakly_connected_images",
    ):
        monkeypatch.setattr(f"colmap_affrect.{name}", None)
    after = again()
    assert hashed.count("points3D.bin") == len(after.models) == 1
    assert after.guided == before.guided


def edited(workspace: Workspace) -> None:
    content = json.loads(workspace.report.read_text())
    content["photographs"]["a.png"]["num_points"] = 1
    workspace.report.write_text(json.dumps(content))


def cut(workspace: Workspace) -> None:
    workspace.report.write_text(workspace.report.read_text()[:-9])


def of_other_versions(workspace: Workspace) -> None:
    content = json.loads(workspace.report.read_text())
    content["made_from"] = "of another version"
    workspace.report.write_text(json.dumps(content))


def without_digest(workspace: Workspace) -> None:
    content = json.loads(workspace.report.read_text())
    del content["made_from"]
    workspace.report.write_text(json.dumps(content))


@pytest.mark.parametrize("change", [edited, cut, of_other_versions, without_digest])
def test_figures_of_a_report_that_is_not_of_these_models_are_counted_again(
    copy: Workspace, monkeypatch: pytest.MonkeyPatch, change
) -> None:
    before = json.loads(copy.report.read_text())
    counted = list[int]()
    of_model = photographs_module._of_model

    def count(reader: ModelReader, number: int) -> object:
        counted.append(number)
        return of_model(reader, number)

    monkeypatch.setattr(photographs_module, "_of_model", count)
    change(copy)
    map_again(copy)
    assert counted == [0]
    after = json.loads(copy.report.read_text())
    assert after["photographs"] == before["photographs"]
    map_again(copy)
    assert counted == [0]


def test_figures_of_other_models_are_counted_again(copy: Workspace) -> None:
    content = json.loads(copy.report.read_text())
    expected = deepcopy(content["photographs"])
    photographs = kept_figures._PHOTOGRAPHS.validate_python(content["photographs"])
    for name, photograph in photographs.items():
        photographs[name] = replace(photograph, num_points=7)
        content["photographs"][name]["num_points"] = 7
    content["made_from"] = figures_digest("other models", photographs)
    copy.report.write_text(json.dumps(content))
    assert kept_figures.kept_figures(copy.report, "other models")
    map_again(copy)
    assert json.loads(copy.report.read_text())["photographs"] == expected


def test_figures_that_lack_a_model_are_counted_again(
    copy: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = json.loads(copy.report.read_text())["photographs"]

    def unreadable(*_: object) -> NoReturn:
        raise AffrectError("too many files are open")

    copy.report.unlink()
    with monkeypatch.context() as patched:
        patched.setattr(ModelReader, "observations", unreadable)
        map_again(copy)
    assert json.loads(copy.report.read_text())["photographs"] != expected
    map_again(copy)
    assert json.loads(copy.report.read_text())["photographs"] == expected


def test_each_command_leaves_the_digest_of_the_rows_that_there_are(
    copy: Workspace,
) -> None:
    digests = set()
    for command in (
        lambda: map_again(copy),
        lambda: match(copy.path),
        lambda: verify(copy.path),
        lambda: verify(copy.path, {"max_error_px": 2.0}, overwrite=True),
        lambda: match(copy.path, {"name": "nearest", "max_ratio": 0.7}, overwrite=True),
        lambda: verify(copy.path, {"max_error_px": 2.0}),
        lambda: map_again(copy),
    ):
        command()
        digests.add(digest_on_record(copy))
        assert digest_on_record(copy) == rows_digest(copy.database)
    assert len(digests) > 2


def test_a_seal_that_somebody_has_edited_says_nothing_of_the_rows(
    copy: Workspace,
) -> None:
    digest, *others = copy.seal.read_text().splitlines()
    copy.seal.write_text("\n".join(["0" * len(digest), *others]))
    report = map_again(copy)
    assert report.stages[-1].num_kept == 1  # models stay
    assert digest_on_record(copy) == digest == rows_digest(copy.database)


def test_a_command_that_fails_leaves_the_digest_of_what_it_has_changed(
    copy: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object, **__: object) -> None:
        with open_database(copy.database) as database:
            database.clear_two_view_geometries()
        raise AffrectError("no more")

    monkeypatch.setattr("colmap_affrect.pipeline.single_stages.verify_pairs", failing)
    with pytest.raises(AffrectError, match="no more"):
        verify(copy.path)
    assert digest_on_record(copy) == rows_digest(copy.database)
