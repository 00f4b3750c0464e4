"""Inputs that change between two runs: the second equals a fresh run, and a line says why."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from command import FAST, Call
from results import hdf5_content, results
from small_scene import IMAGE_SIZE, NAMES, photograph, write_photographs
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.errors import StoreError
from colmap_affrect.images.reading import read_gray
from colmap_affrect.interop.pycolmap_api import extract_features
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages import extract as extract_stage

pytestmark = pytest.mark.long

FIRST, SECOND = NAMES[:2]


def repaint(path: Path) -> None:
    """Cover a third of an image, whose size and format stay the same."""
    image = read_gray(path).copy()
    image[:, : image.shape[1] // 3] = 0
    write_image(path, image)


# Changes of a folder with photos, masks, pairs.txt and source.db.


def same_size_and_time(scene: Path) -> None:
    """As programs do that keep the time of what they change."""
    path = scene / "photos" / FIRST
    before = path.read_bytes()
    there = path.stat()
    write_image(path, photograph((0.3, 0.1, 0.0), 4.0))
    path.write_bytes(path.read_bytes()[: len(before)].ljust(len(before), b"\0"))
    os.utime(path, ns=(there.st_atime_ns, there.st_mtime_ns))


def output_inside(scene: Path) -> None:
    """As inspect leaves it, and other runs."""
    for inner, record, text in (
        (
            "look",
            "run.log",
            "2026-01-01 00:00:00,000 INFO colmap-affrect 0.1: inspect a.png",
        ),
        ("side/other run", "config.toml", "format_version = 6\n"),
    ):
        folder = scene / "photos" / inner
        folder.mkdir()
        (folder / record).write_text(text, encoding="utf-8")
        shutil.copy(scene / "photos" / FIRST, folder / "drawing.png")


def list_changed(scene: Path) -> None:
    path = scene / "pairs.txt"
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([lines[0], lines[2], lines[3]]) + "\n", encoding="utf-8")


def source_changed(scene: Path) -> None:
    with pycolmap.Database.open(str(scene / "source.db")) as database:
        camera = database.read_all_cameras()[0]
        camera.params = [123.0, *camera.params[1:]]
        camera.has_prior_focal_length = True
        database.update_camera(camera)


MASKS = [*FAST, "--mask-path", "{scene}/masks"]
LISTED = [*FAST, "--match-list-path", "{scene}/pairs.txt"]
GIVEN = [*FAST[:2], "--from-database", "{scene}/source.db"]
ADDED = photograph((0.2, -0.2, 0.3), 3.0)
CHANGES: list[tuple[list[str], Callable[[Path], object], str]] = [
    (
        FAST,
        same_size_and_time,
        "1 changed (a.png); all that hangs on them is made again",
    ),
    (
        FAST,
        lambda at: (at / "photos" / SECOND).write_bytes(b"\x89PNG"),
        "1 changed (b c.png)",
    ),
    (
        FAST,
        lambda at: (at / "photos" / FIRST).rename(at / "photos" / "x.png"),
        "1 gone (a.png)",
    ),
    (FAST, lambda at: write_image(at / "photos" / "0.png", ADDED), ""),
    (FAST, output_inside, ""),
    (MASKS, lambda at: repaint(at / "masks" / f"{FIRST}.png"), "1 changed (a.png)"),
    (
        LISTED,
        list_changed,
        "1 pairs are not listed any more, such as a.png and side/č.png",
    ),
    (GIVEN, source_changed, "cameras are given otherwise"),
]


def write_scene(scene: Path) -> None:
    write_photographs(scene / "photos")
    lines = [f"{NAMES[0]}\t{name}" for name in NAMES[1:]] + ["\t".join(NAMES[2:])]
    (scene / "pairs.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name in NAMES:
        (scene / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(
            scene / "masks" / f"{name}.png", np.full(IMAGE_SIZE[::-1], 255, np.uint8)
        )
    image_ids(scene / "source.db")  # makes it
    pycolmap.import_images(
        scene / "source.db", scene / "photos", pycolmap.CameraMode.PER_IMAGE
    )


def by_sorted_names(found: dict[str, Any]) -> dict[str, Any]:
    """Turn pairs round whose image with the smaller id has the larger name: it was added later."""
    turned = {
        tuple(sorted(pair)): sorted(map(tuple, np.asarray(rows)[:, ::step].tolist()))
        for pair, rows in found["inliers"].items()
        for step in (1 if pair[0] < pair[1] else -1,)
    }
    raw = {tuple(sorted(pair)): count for pair, count in found["raw matches"].items()}
    return {**found, "inliers": turned, "raw matches": raw}


@pytest.mark.long
@pytest.mark.parametrize(("options", "change", "line"), CHANGES)
def test_run_after_a_change_equals_a_fresh_one(
    tmp_path: Path,
    call: Call,
    options: list[str],
    change: Callable[[Path], object],
    line: str,
) -> None:
    def run(out: Path) -> str:
        """Run, and return the warnings."""
        paths = [
            "--image-path",
            tmp_path / "photos",
            "--output-path",
            out,
            "--max-failures",
            4,
        ]
        ended = call("run", *paths, *(word.format(scene=tmp_path) for word in options))
        assert ended.code in (0, 3), ended.stderr
        return "\n".join(line for line in ended.stderr if line.startswith("WARNING: "))

    write_scene(tmp_path)
    folders = tmp_path / "out", tmp_path / "fresh"
    run(folders[0])
    change(tmp_path)
    warnings = run(folders[0])
    assert line in warnings
    assert line or "made again" not in warnings
    run(folders[1])
    again, fresh = (by_sorted_names(results(out)) for out in folders)
    assert again == fresh
    reports = [json.loads((out / "report.json").read_text()) for out in folders]
    for key in (
        "status",
        "images_total",
        "unregistered",
        "num_pairs",
        "num_verified_pairs",
    ):
        assert reports[0][key] == reports[1][key]


Stage = Callable[..., list[str]]


@pytest.fixture
def stage(tmp_path: Path, call: Call) -> Stage:
    """Run a stage on ``photos``; return what was done and the lines of stderr."""

    def run_stage(name: str, *arguments: object) -> list[str]:
        given = (
            ["--image-path", tmp_path / "photos", *FAST] if name == "extract" else []
        )
        ended = call(name, "--output-path", tmp_path / "out", *given, "-q", *arguments)
        return [ended.stdout.partition(" in ")[0], *ended.stderr]

    write_photographs(tmp_path / "photos", 3)
    return run_stage


def test_stages_after_extract_ask_for_what_a_change_took_away(
    tmp_path: Path, stage: Stage
) -> None:
    assert stage("extract") == ["extract: 3 done"]
    assert stage("extract") == ["extract: 0 done, 3 already there"]
    stage("pairs"), stage("match")
    repaint(tmp_path / "photos" / FIRST)
    assert stage("extract") == ["extract: 1 done, 2 already there, 1 with a warning"]
    assert "photographs have changed; run 'colmap-affrect pairs'" in stage("match")[-1]


def test_photograph_that_was_only_touched_is_read_once_more(
    tmp_path: Path, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage("extract")
    (tmp_path / "photos" / FIRST).touch()
    assert stage("extract") == ["extract: 0 done, 3 already there"]
    monkeypatch.setattr("colmap_affrect.project.record.file_sha256", None)
    assert stage("extract") == ["extract: 0 done, 3 already there"]


def cameras_of(path: Path) -> set[tuple[object, ...]]:
    with pycolmap.Database.open(str(path)) as database:
        cameras = database.read_all_cameras()
    return {(camera.camera_id, camera.model_name, *camera.params) for camera in cameras}


def test_other_cameras_extract_and_match_nothing_anew(
    tmp_path: Path, stage: Stage
) -> None:
    for name in ("extract", "pairs", "match"):
        stage(name)
    out = tmp_path / "out"
    before = [hdf5_content(out / name) for name in ("features.h5", "matches.h5")]
    assert len(cameras_of(out / "database.db")) == 3
    said = stage(
        "extract", "--camera-mode", "single", "--camera-params", "400,400,200,150"
    )
    assert said[0] == "extract: 0 done, 3 already there, 1 with a warning"
    log = (out / "run.log").read_text(encoding="utf-8")
    assert "cameras are given otherwise; all that hangs on them is made again" in log
    assert cameras_of(out / "database.db") == {
        (1, "PINHOLE", 400.0, 400.0, 200.0, 150.0)
    }
    stage("pairs")
    assert stage("match") == ["match: 0 done, 3 already there"]
    assert [
        hdf5_content(out / name) for name in ("features.h5", "matches.h5")
    ] == before


@pytest.mark.long
def test_run_with_other_cameras_equals_a_fresh_one(tmp_path: Path, call: Call) -> None:
    write_photographs(tmp_path / "photos")
    folders = tmp_path / "out", tmp_path / "fresh"
    for out, mode in zip(
        (folders[0], *folders), ("per-image", "single", "single"), strict=True
    ):
        given = ["--image-path", tmp_path / "photos", "--output-path", out, *FAST]
        assert call("run", *given, "--camera-mode", mode).code == 0
    assert results(folders[0]) == results(folders[1])
    assert len(cameras_of(folders[0] / "database.db")) == 1


def test_other_folder_with_none_of_the_photographs_is_refused(
    tmp_path: Path, stage: Stage
) -> None:
    stage("extract")
    store = FeatureStore(Workspace(tmp_path / "out").features)
    before = store.contents()
    for name in ("a.png", "other.png"):
        other = tmp_path / name
        other.mkdir()
        write_image(other / name, photograph((0.3, 0.1, 0.0), 4.0))
        refused = stage("extract", "--image-path", other)
        assert f"none of the photographs in {other} is one of them" in refused[-1]
    assert store.contents() == before


def test_photographs_that_moved_or_are_gone_are_named_by_map(
    tmp_path: Path, stage: Stage
) -> None:
    for name in ("extract", "pairs", "match", "verify"):
        stage(name)
    (tmp_path / "photos" / FIRST).rename(tmp_path / "away.png")
    assert f"{FIRST} has features, and is gone" in stage("map")[-1]
    (tmp_path / "photos").rename(tmp_path / "moved")
    assert "no such folder; give the folder of the photographs" in stage("map")[-1]


def test_changed_photograph_of_a_users_database_is_named(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", 2)
    extract_features(
        tmp_path / "own.db", tmp_path / "photos", extraction_options=FAST[1]
    )
    repaint(tmp_path / "photos" / FIRST)
    with pytest.raises(
        StoreError, match=r"own\.db: since it was made, 1 changed \(a\.png\); use"
    ):
        extract_features(
            tmp_path / "own.db", tmp_path / "photos", extraction_options=FAST[1]
        )


@pytest.mark.long
@pytest.mark.parametrize(
    "step", ["match_store.MatchStore.remove", "feature_store.FeatureStore.remove"]
)
def test_changes_are_found_again_by_a_run_that_was_killed_while_it_forgot(
    tmp_path: Path, stage: Stage, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    stage("extract"), stage("pairs"), stage("match")
    repaint(tmp_path / "photos" / FIRST)
    (tmp_path / "photos" / SECOND).unlink()

    with monkeypatch.context() as patch:
        patch.setattr(
            f"colmap_affrect.project.{step}", Mock(side_effect=KeyboardInterrupt)
        )
        with pytest.raises(KeyboardInterrupt):  # of which the process makes one line
            stage("extract")
    assert stage("extract")[0] == "extract: 1 done, 1 already there, 1 with a warning"
    folders = tmp_path / "out", tmp_path / "fresh"
    for out in folders:
        for name in ("extract", "pairs", "match"):
            stage(name, "--output-path", out)
    for name in ("features.h5", "matches.h5"):
        again, fresh = (hdf5_content(out / name) for out in folders)
        assert again == fresh


@pytest.mark.long
@pytest.mark.parametrize("before", ["_extract_missing", "write_images_and_keypoints"])
def test_a_photograph_that_vanishes_while_a_run_works_is_left_out(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, before: str
) -> None:
    photos = tmp_path / "photos"
    write_photographs(photos)
    lost = Path(shutil.copy(photos / "a.png", photos / "z.png"))
    usual = getattr(extract_stage, before)

    def vanish(*given: object, **named: object) -> object:
        lost.unlink(missing_ok=True)
        return usual(*given, **named)

    monkeypatch.setattr(extract_stage, before, vanish)
    run = [
        "run",
        "--image-path",
        photos,
        "--output-path",
        tmp_path / "out",
        *FAST,
        "--json",
    ]
    done = call(*run)
    assert done.code == 1
    assert done.errors[0].startswith("error: could not read 1 of the images: z.png; ")
    assert done.report["images_registered"] == 4


@pytest.mark.parametrize("name", ["_extract_missing", "write_images_and_keypoints"])
def test_a_folder_that_vanishes_while_a_run_works_is_one_line(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    photos = tmp_path / "photos"
    write_photographs(photos)
    usual = getattr(extract_stage, name)

    def vanish(*given: object, **named: object) -> object:
        photos.rename(tmp_path / "gone")
        return usual(*given, **named)

    monkeypatch.setattr(extract_stage, name, vanish)
    done = call("run", "--image-path", photos, "--output-path", tmp_path / "out", *FAST)
    assert (done.code, len(done.errors)) == (2, 1)
    assert done.errors[0].startswith(f"error: {photos}: no such folder")
