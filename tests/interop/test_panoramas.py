"""The command for panoramas; that of pycolmap's script is tested beside the other scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planar_scenes import write_panoramas
from synthetic import write_image

from colmap_affrect.errors import ImageError, NoModelError, OptionError
from colmap_affrect.interop import panoramas
from colmap_affrect.interop.panoramas import reconstruct_panoramas
from colmap_affrect.progress import Progress


def write_size(path: Path, width: int, height: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, np.full((height, width), 90, np.uint8))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ([(64, 32)], r"has 1 pictures; give two panoramas or more"),
        (
            [(64, 32), (64, 48)],
            r"1\.png: is 64 x 48 px, and a panorama .* is twice as wide",
        ),
        (
            [(64, 32), (80, 40)],
            r"1\.png: is 80 x 40 px, and 0\.png is 64 x 32 px; .* one size",
        ),
    ],
)
def test_pictures_that_are_no_panoramas_are_refused_before_anything_is_made(
    tmp_path: Path, sizes: list[tuple[int, int]], message: str
) -> None:
    for number, size in enumerate(sizes):
        write_size(tmp_path / "panoramas" / f"{number}.png", *size)
    with pytest.raises(ImageError, match=message):
        reconstruct_panoramas(tmp_path / "panoramas", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_folder_of_something_else_is_not_written_to(tmp_path: Path) -> None:
    for number in range(2):
        write_size(tmp_path / "panoramas" / f"{number}.png", 64, 32)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OptionError, match="exists already; give a new folder"):
        reconstruct_panoramas(tmp_path / "panoramas", tmp_path / "mine")
    with pytest.raises(OptionError, match="is in the folder of the panoramas"):
        reconstruct_panoramas(tmp_path / "panoramas", tmp_path / "panoramas" / "out")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    (tmp_path / "begun" / "database.affrect").mkdir(parents=True)
    (tmp_path / "begun" / "images").symlink_to(tmp_path / "mine")
    with pytest.raises(OptionError, match="is a symbolic link"):
        reconstruct_panoramas(tmp_path / "panoramas", tmp_path / "begun")


def test_all_stages_show_progress_and_no_model_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(2):
        write_size(tmp_path / "panoramas" / f"{number}.png", 64, 32)
    called: list[str] = []
    for name in ("extract_features", "match_exhaustive", "incremental_mapping"):

        def call(*_: Any, name: str = name, **given: Any) -> dict[int, Any]:
            shows = isinstance(given.get("progress"), Progress)
            called.append(f"{name} {shows or 'next_image_callback' in given}")
            return {}

        monkeypatch.setattr(panoramas.ours, name, call)
    monkeypatch.setattr(panoramas.pycolmap, "apply_rig_config", lambda *_: None)
    with pytest.raises(
        NoModelError, match="no two of the 2 panoramas can be registered"
    ):
        reconstruct_panoramas(
            tmp_path / "panoramas", tmp_path / "out", order="exhaustive"
        )
    assert called == [
        "extract_features True", "match_exhaustive True", "incremental_mapping True"
    ]  # fmt: skip
    assert len(list((tmp_path / "out" / "images").rglob("*.png"))) == 2 * 12


@pytest.mark.slow
def test_panoramas_are_registered_and_a_second_call_goes_on(tmp_path: Path) -> None:
    (tmp_path / "panoramas").mkdir()
    write_panoramas(tmp_path / "panoramas", 3)
    for _ in range(2):
        models = reconstruct_panoramas(tmp_path / "panoramas", tmp_path / "out")
        assert models[0].num_reg_images() == 3
