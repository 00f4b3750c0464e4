"""The doctor on cameras: impossible ones, priors that pairs contradict, who shares one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from matched_scenes import in_a_box, views_around, write_views

from colmap_affrect.colmap.camera_records import CameraRecord
from colmap_affrect.colmap.camera_vote import apply_records
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import VerificationOptions, verify
from colmap_affrect.doctor import database as module
from colmap_affrect.doctor.database import examine_cameras
from colmap_affrect.doctor.findings import Finding, Findings
from colmap_affrect.progress import SILENT

WIDE = (1000, 750)
FOCAL = 1.4


def make(path: Path, focals: Sequence[float], *, shared: bool, **priors: float) -> Path:
    """Write a verified database; priors are focal lengths of cameras c1, c2, ..."""
    rng = np.random.default_rng(4)
    views = views_around(focals, rng)
    write_views(path, views, [WIDE] * len(focals), in_a_box(900, rng), 3)
    if shared:
        names = tuple(f"{index}.jpg" for index in range(len(focals)))
        apply_records(path, {1: CameraRecord(names, "guess", 1200.0, size=WIDE)})
    for name, focal in priors.items():
        set_prior(path, int(name[1:]), focal)
    verify(path, VerificationOptions())
    return path


def set_prior(path: Path, camera_id: int, focal: float) -> None:
    with open_database(path) as database:
        camera = database.read_camera(camera_id)
        camera.params = [focal, *camera.params[1:]]
        camera.has_prior_focal_length = True
        database.update_camera(camera)


def examined(path: Path) -> list[Finding]:
    findings = Findings(SILENT)
    examine_cameras(findings, Path("some.db"), path)
    return list(findings.diagnosis().findings)


@pytest.mark.parametrize("focal", [150.0, 6500.0])
def test_impossible_focal_lengths(tmp_path: Path, focal: float) -> None:
    path = tmp_path / "database.db"
    with open_database(path):
        pass
    write_views(path, views_around([1.0, 1.0], np.random.default_rng(0)), [WIDE] * 2,
                np.zeros((1, 3)), 0)  # fmt: skip
    assert examined(path) == []
    set_prior(path, 2, focal)
    (found,) = examined(path)
    assert found.severity == "warning"
    assert f"(1): 1.jpg: {focal:.0f} px, {focal / 1000:.2g}" in found.what
    assert "--cameras-path" in found.advice


def test_a_prior_that_pairs_contradict(tmp_path: Path) -> None:
    wrong = make(tmp_path / "wrong.db", [FOCAL] * 3, shared=True, c1=5000.0)
    (found,) = examined(wrong)
    assert found.severity == "warning"
    assert "0.jpg and 2 more: 5000, not 1" in found.what
    assert "--ignore-exif" in found.advice
    right = make(tmp_path / "right.db", [FOCAL] * 3, shared=True, c1=1000.0 * FOCAL)
    assert examined(right) == []


def test_one_wrong_prior_among_right_ones(tmp_path: Path) -> None:
    priors = {"c1": 1400.0, "c2": 4700.0, "c3": 1400.0}
    (found,) = examined(make(tmp_path / "database.db", [FOCAL] * 3, shared=False, **priors))
    assert "(1): 1.jpg: 4700, not 1" in found.what


def test_images_with_a_camera_each_that_share_one(tmp_path: Path) -> None:
    (found,) = examined(make(tmp_path / "database.db", [FOCAL] * 3, shared=False))
    assert found.severity == "note"
    assert found.what.endswith("share one (3): 0.jpg, 1.jpg, 2.jpg")
    assert "--focal-vote always" in found.advice


@pytest.mark.long
def test_images_that_share_a_camera_and_should_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make(tmp_path / "database.db", [0.8, 2.0, 1.2], shared=True)
    monkeypatch.setattr(module, "MIN_LOG_EVIDENCE", 0.5)  # three pairs do not say more
    (found,) = examined(path)
    assert found.severity == "warning"
    assert found.what.endswith("they do not (3): 0.jpg, 1.jpg, 2.jpg")
    assert "--camera-mode per-image" in found.advice


def test_a_database_without_pairs_or_cameras_is_no_problem(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    with open_database(path):
        pass
    assert examined(path) == []
