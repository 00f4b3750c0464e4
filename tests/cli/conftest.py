"""Photographs and a finished run for the tests of the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import on_photographs
from small_scene import write_photographs

from colmap_affrect import progress
from colmap_affrect.cli import main


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may take seconds to load torch: the lines that say so are not counted."""
    monkeypatch.setattr(progress, "QUIET_S", 600.0)


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_photographs(folder, 3)
    return folder


@pytest.fixture(scope="session")
def verified(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with COLMAP's preset and its mapper."""
    out = tmp_path_factory.mktemp("verified") / "out"
    given = [
        "run", *on_photographs(photos, out), "-q",
        "--preset", "colmap", "--mapper", "incremental",
        "--mapper-options", "init_min_num_inliers=40", "min_model_size=3",
        "--mapper-options", "triangulation.min_angle=1.25",
    ]  # fmt: skip
    assert main(given) == 0
    return out
