from __future__ import annotations

import sys
from pathlib import Path

import pytest
from small_comparison import make_comparison

from colmap_affrect.comparison.viewer import log_comparison
from colmap_affrect.errors import ComparisonError


def test_recording_has_cameras_and_points_of_all_methods(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    path = log_comparison(make_comparison(tmp_path), tmp_path)
    content = path.read_bytes()
    for entity in (b"/sift/points", b"/default/points", b"/default/cameras/e.png"):
        assert entity in content.replace(b"\\", b"")
    assert b"/sift/cameras/e.png" not in content.replace(b"\\", b"")


def test_without_rerun_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ComparisonError, match=r"colmap-affrect\[viewer\]"):
        log_comparison(make_comparison(tmp_path), tmp_path)
