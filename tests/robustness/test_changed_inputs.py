"""Inputs that change between two runs: the second equals a fresh run, and a line says why."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import FAST, Call
from results import hdf5_content, results
from small_scene import IMAGE_SIZE, NAMES, photograph, write_photographs
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.errors import StaleStoreError
from colmap_affrect.images.reading import read_gray
from colmap_affrect.interop.pycolmap_api import extract_features
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace

FIRST, SECOND = NAMES[:2]


@dataclass(frozen=True)
class Scene:
    """All that a run reads, below one folder."""

    path: Path

    @property
    def photos(self) -> Path:
        return self.path / "photos"

    @property
    def out(self) -> Path:
        return self.path / "out"

    def file(self, name: str) -> Path:
        return self.path / name

    def repaint(self, name: str) -> None:
        """Cover a third of an image, whose size and format stay the same."""
        path = self.path / name
        image = read_gray(path).copy()
        image[:, : image.shape[1] // 3] = 0
        write_image(path, image)


def write_scene(scene: Scene) -> None:
    write_photographs(scene.photos)
    lines = [f"{NAMES[0]}\t{name}" for name in NAMES[1:]] + ["\t".join(NAMES[2:])]
    scene.file("pairs.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name in NAMES:
        (scene.file("masks") / name).parent.mkdir(parents=True, exist_ok=True)
        white = np.full(IMAGE_SIZE[::-1], 255, np.uint8)
        write_image(scene.file("masks") / f"{name}.png", white)
    image_ids(scene.file("source.db"))  # makes it
    pycolmap.import_images(scene.file("source.db"), scene.photos, pycolmap.CameraMode.PER_IMAGE)


def masks(scene: Scene) -> list[object]:
    return [*FAST, "--mask-path", scene.file("masks")]


def pairs(scene: Scene) -> list[object]:
    return [*FAST, "--match-list-path", scene.file("pairs.txt")]


def source(scene: Scene) -> list[object]:
    return [*FAST[:2], "--from-database", scene.file("source.db")]


def plain(_: Scene) -> list[object]:
    return list(FAST)


ARGUMENTS = {kind.__name__: kind for kind in (plain, masks, pairs, source)}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scene]:
    """Finished runs by the kind of their arguments, made when they are first asked for."""
    scene = Scene(tmp_path_factory.mktemp("scene"))
    write_scene(scene)
    return {"": scene}


def same_size_and_time(scene: Scene) -> None:
    """As programs do that keep the time of what they change."""
    path = scene.photos / FIRST
    before, there = path.read_bytes(), path.stat()
    write_image(path, photograph((0.3, 0.1, 0.0), 4.0))
    changed = path.read_bytes()[: len(before)].ljust(len(before), b"\0")
    path.write_bytes(changed)
    os.utime(path, ns=(there.st_atime_ns, there.st_mtime_ns))


def name(scene: Scene) -> None:
    (scene.photos / FIRST).rename(scene.photos / "renamed.png")


def added(scene: Scene) -> None:
    write_image(scene.photos / "0.png", photograph((0.2, -0.2, 0.3), 3.0))


def damaged(scene: Scene) -> None:
    (scene.photos / SECOND).write_bytes(b"\x89PNG, once")


def mask_painted(scene: Scene) -> None:
    scene.repaint(f"masks/{FIRST}.png")


def list_changed(scene: Scene) -> None:
    path = scene.file("pairs.txt")
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([lines[0], lines[2], lines[3]]) + "\n", encoding="utf-8")


def source_changed(scene: Scene) -> None:
    with pycolmap.Database.open(str(scene.file("source.db"))) as database:
        camera = database.read_all_cameras()[0]
        camera.params = [123.0, *camera.params[1:]]
        camera.has_prior_focal_length = True
        database.update_camera(camera)


def output_inside(scene: Scene) -> None:
    """As inspect leaves it, and other runs."""
    for inner, record, text in (
        ("look", "run.log", "2026-01-01 00:00:00,000 INFO colmap-affrect 0.1: inspect a.png"),
        ("side/other run", "config.toml", "format_version = 6\n"),
    ):
        folder = scene.photos / inner
        folder.mkdir()
        (folder / record).write_text(text, encoding="utf-8")
        shutil.copy(scene.photos / FIRST, folder / "drawing.png")


GONE_OR_CHANGED = "all that hangs on them is made again"
CHANGES: list[tuple[str, Callable[[Scene], None], str]] = [
    ("plain", same_size_and_time, f"1 changed (a.png); {GONE_OR_CHANGED}"),
    ("plain", damaged, "1 changed (b c.png)"),
    ("plain", name, "1 gone (a.png)"),
    ("plain", added, ""),
    ("plain", output_inside, ""),
    ("masks", mask_painted, "1 changed (a.png)"),
    ("pairs", list_changed, "1 pairs are not listed any more, such as a.png and side/č.png"),
    ("source", source_changed, "cameras are given by other files"),
]


def run(call: Call, kind: str, scene: Scene, out: Path) -> str:
    """Run, and return the warnings."""
    paths = ["--image-path", scene.photos, "--output-path", out, "--max-failures", 4]
    ended = call("run", *paths, *ARGUMENTS[kind](scene))
    assert ended.code in (0, 3), ended.stderr
    return "\n".join(line for line in ended.stderr if line.startswith("WARNING: "))


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
@pytest.mark.parametrize(("kind", "change", "line"), CHANGES)
def test_run_after_a_change_equals_a_fresh_one(
    finished: dict[str, Scene],
    tmp_path: Path,
    call: Call,
    kind: str,
    change: Callable[[Scene], None],
    line: str,
) -> None:
    if kind not in finished:
        scene = Scene(
            shutil.copytree(finished[""].path, finished[""].path.with_name(f"run of {kind}"))
        )
        run(call, kind, scene, scene.out)
        finished[kind] = scene
    scene = Scene(shutil.copytree(finished[kind].path, tmp_path / "scene"))
    change(scene)
    told = run(call, kind, scene, scene.out)
    assert line in told
    assert line or "made again" not in told
    run(call, kind, scene, scene.file("fresh"))
    again, fresh = results(scene.out), results(scene.file("fresh"))
    assert by_sorted_names(again) == by_sorted_names(fresh)
    reports = [
        json.loads((p / "report.json").read_text()) for p in (scene.out, scene.file("fresh"))
    ]
    for key in ("status", "images_total", "unregistered", "num_pairs", "num_verified_pairs"):
        assert reports[0][key] == reports[1][key]


def extracted(call: Call, scene: Scene, *arguments: object) -> list[str]:
    """Extract, and return what was written to stderr."""
    paths = ["--image-path", scene.photos, "--output-path", scene.out]
    ended = call("extract", *paths, *FAST, "-q", *arguments)
    return [ended.stdout.partition(" in ")[0], *ended.stderr]


def test_stages_after_extract_ask_for_what_a_change_took_away(tmp_path: Path, call: Call) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 2)
    assert extracted(call, scene) == ["extract: 2 done"]
    assert extracted(call, scene) == ["extract: 0 done, 2 already there"]
    assert [call(stage, "--output-path", scene.out).code for stage in ("pairs", "match")] == [0, 0]
    scene.repaint(f"photos/{FIRST}")
    assert extracted(call, scene) == ["extract: 1 done, 1 already there, 1 with a warning"]
    refused = call("match", "--output-path", scene.out)
    assert refused.code == 1
    assert "the photographs have changed; run 'colmap-affrect pairs'" in refused.errors[0]


def test_photograph_that_was_only_touched_is_read_once_more(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 2)
    extracted(call, scene)
    (scene.photos / FIRST).touch()
    assert extracted(call, scene) == ["extract: 0 done, 2 already there"]
    monkeypatch.setattr("colmap_affrect.project.contents.file_sha256", None)
    assert extracted(call, scene) == ["extract: 0 done, 2 already there"]


def test_other_folder_with_none_of_the_photographs_is_refused(tmp_path: Path, call: Call) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 2)
    extracted(call, scene)
    before = FeatureStore(Workspace(scene.out).features).contents()
    for name in ("a.png", "other.png"):
        other = Scene(tmp_path / name)
        other.photos.mkdir(parents=True)
        write_image(other.photos / name, photograph((0.3, 0.1, 0.0), 4.0))
        refused = extracted(call, scene, "--image-path", other.photos)
        assert f"none of the photographs in {other.photos} is one of them" in refused[-1]
    assert FeatureStore(Workspace(scene.out).features).contents() == before


def test_photographs_that_moved_or_are_gone_are_named_by_map(tmp_path: Path, call: Call) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 3)
    for stage in ("extract", "pairs", "match", "verify"):
        paths = ["--image-path", scene.photos, *FAST] if stage == "extract" else []
        assert call(stage, "--output-path", scene.out, *paths).code == 0
    (scene.photos / FIRST).rename(tmp_path / "away.png")
    assert f"{FIRST} has features, and is gone" in call("map", "--output-path", scene.out).errors[0]
    scene.photos.rename(tmp_path / "moved")
    refused = call("map", "--output-path", scene.out)
    assert "no such folder; if the photographs have moved, run extract again" in refused.errors[0]


def test_changed_photograph_of_a_users_database_is_named(tmp_path: Path) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 2)
    extract_features(scene.file("own.db"), scene.photos, extraction_options=FAST[1])
    scene.repaint(f"photos/{FIRST}")
    with pytest.raises(
        StaleStoreError, match=r"own\.db: since it was made, 1 changed \(a\.png\); use"
    ):
        extract_features(scene.file("own.db"), scene.photos, extraction_options=FAST[1])


@pytest.mark.parametrize("step", ["MatchStore.remove", "FeatureStore.remove"])
def test_changes_are_found_again_by_a_run_that_was_killed_while_it_forgot(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    scene = Scene(tmp_path)
    write_photographs(scene.photos, 3)
    extracted(call, scene)
    for stage in ("pairs", "match"):
        assert call(stage, "--output-path", scene.out).code == 0
    scene.repaint(f"photos/{FIRST}")
    (scene.photos / SECOND).unlink()

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"colmap_affrect.project.stores.{step}", killed)
        assert extracted(call, scene)[-1].startswith("interrupted")
    assert extracted(call, scene)[0] == "extract: 1 done, 1 already there, 1 with a warning"
    for out in (scene.out, scene.file("fresh")):
        extracted(call, scene, "--output-path", out)
        for stage in ("pairs", "match"):
            assert call(stage, "--output-path", out).code == 0
    for name in ("features.h5", "matches.h5"):
        assert hdf5_content(scene.out / name) == hdf5_content(scene.file("fresh") / name)
