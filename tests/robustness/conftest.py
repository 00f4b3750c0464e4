"""A finished run that the campaign attacks."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from campaign import run_words
from command import run_in_process_of_its_own
from posed_photographs import write_extreme_views

from colmap_affrect.colmap import pycolmap

HANGING_S = 60


@pytest.fixture
def ends_in_time() -> Iterator[None]:
    """End the process of the tests when a command does not come to an end."""
    signal.alarm(HANGING_S)
    yield
    signal.alarm(0)


@pytest.fixture(scope="session")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small scene in ``out``, and what commands need beside it.

    These are ``photos``; the model as it is and with a lens that distorts;
    files of hloc; a dataset.
    """
    folder = tmp_path_factory.mktemp("scene")
    shutil.copytree(photos, folder / "photos")
    (folder / "photos" / "b c.png").rename(
        folder / "photos" / "b-c.png"
    )  # text has no blanks
    files = [
        "--features-path",
        folder / "features.h5",
        "--matches-path",
        folder / "matches.h5",
    ]
    out = folder / "out"
    for words in (
        run_words(folder, out),
        ["export-h5", "--database-path", out / "database.db", *files],
    ):
        assert run_in_process_of_its_own(*words).code == 0
    shutil.copy(out / "database.db", folder / "any.db")
    shutil.copy(out / "features.h5", folder / "described.h5")
    for name in ("plain", "lens"):
        model = pycolmap.Reconstruction(out / "sparse" / "0")
        for camera in model.cameras.values() if name == "lens" else ():
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [300.0, 160.0, 120.0, 0.05]
        (folder / name).mkdir()
        model.write(folder / name)
    write_extreme_views(folder / "pairs", ["cafe"])
    return folder
