"""Records of cameras come back as they were written, and are shown where there is a story."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from colmap_affrect.colmap.camera_records import (
    CameraRecord,
    notable_lines,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.errors import WorkspaceError
from colmap_affrect.project.report import ModelSummary

FROM_EXIF = CameraRecord(("a č.jpg", "b.jpg"), "exif", 812.5, size=(640, 480))
VOTED = CameraRecord(("c.jpg",), "pairs", 500.0, 480.0, 530.0, "40 pairs agree", (300, 400))


def test_records_come_back(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    assert read_camera_records(path) == {}
    write_camera_records(path, {12: VOTED, 3: FROM_EXIF})
    assert read_camera_records(path) == {3: FROM_EXIF, 12: VOTED}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["", "[]", '{"1": {}}', '{"x": 3}', '{"1": {"names": ["a"]}}'])
def test_damaged_records_are_one_clear_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(WorkspaceError, match=r"cameras\.json: damaged .*; run .*verify"):
        read_camera_records(path)


def test_report_has_the_focal_length_in_longer_sides_and_the_spread() -> None:
    model = ModelSummary((), 0, 0.0, 0.0, focals_px={"c.jpg": 470.0, "z": 9.0},
                         rival_focals_px={"c.jpg": (460.0, 560.0)})  # fmt: skip
    entry = VOTED.to_report(12, model)
    assert (entry["refined_px"], entry["rival_px"]) == (470.0, (460.0, 560.0))
    assert (entry["id"], entry["num_images"], entry["source"]) == (12, 1, "pairs")
    assert entry["focal_longer_sides"] == pytest.approx(1.25)
    assert entry["spread_px"] == [480.0, 530.0]
    known = FROM_EXIF.to_report(3, None)
    assert known["spread_px"] is known["refined_px"] is known["rival_px"] is None


def test_only_cameras_with_a_story_are_named_and_not_all() -> None:
    assert notable_lines([FROM_EXIF]) == []
    (line,) = notable_lines([FROM_EXIF, VOTED])
    assert line == "c.jpg: focal length 500 px (480 to 530), pairs: 40 pairs agree"
    (line,) = notable_lines([VOTED, replace(VOTED, names=("d", "e", "f"), focal_px=700.4)])
    assert line == "c.jpg, d, e and 1 more: focal length 500 to 700 px, pairs: 40 pairs agree"
    lines = notable_lines([replace(VOTED, why=str(index)) for index in range(9)])
    assert (len(lines), lines[-1]) == (6, "and 4 more, see report.json")
