"""Photographs and a finished run for the tests of the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import on_photographs
from small_scene import write_photographs

from colmap_affrect.cli import main


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_photographs(folder, 3)
    return folder


@pytest.fixture(scope="session")
def verified(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with COLMAP's preset and its global mapper."""
    out = tmp_path_factory.mktemp("verified") / "out"
    given = [
        "run", *on_photographs(photos, out), "-q",
        "--preset", "colmap", "--mapper", "global",
        "--mapper-options", "track_min_num_views_per_track=2", "multiple_models=false",
        "--mapper-options", "mapper.bundle_adjustment.min_track_length=2",
    ]  # fmt: skip
    assert main(given) == 0
    return out
