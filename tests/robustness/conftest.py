"""What the tests of this folder share."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import FAST, Call, Ended
from results import Undisturbed, run_undisturbed
from small_scene import write_photographs


@pytest.fixture
def run_images(call: Call, tmp_path: Path) -> Call:
    """Run all stages on a folder, with fast features and the scene's cameras, report as JSON."""

    def run(images: Path, *arguments: object) -> Ended:
        fixed = ["--image-path", images, "--output-path", tmp_path / "out", "--json"]
        return call("run", *fixed, *(arguments or FAST))

    return run


@pytest.fixture(scope="session")
def undisturbed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """A finished run of the small scene, fast features; nothing may be changed in it."""
    return run_undisturbed(photos, tmp_path_factory.mktemp("undisturbed") / "out", FAST)


@pytest.fixture
def trio(tmp_path: Path) -> Path:
    """Three photographs in a folder of their own, to be mixed with others."""
    write_photographs(tmp_path / "trio", 3)
    return tmp_path / "trio"
