"""Models with the cameras of another program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exported_model import write_model, write_photographs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import OptionError
from colmap_affrect.interop.camera_models import fitted_camera
from colmap_affrect.interop.export import export

SIZE = (640, 480)


def camera_of(name: str, *params: float) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_name(3, name, 500.0, *SIZE)
    camera.params = list(params)
    return camera


@pytest.mark.parametrize(
    ("camera", "name", "most_px"),
    [
        (camera_of("SIMPLE_RADIAL", 500, 310, 250, 0.07), "RADIAL", 1e-4),
        (camera_of("SIMPLE_RADIAL", 500, 310, 250, -0.1), "FULL_OPENCV", 1e-4),
        (camera_of("PINHOLE", 500, 520, 310, 250), "OPENCV", 1e-4),
        (
            camera_of("OPENCV_FISHEYE", 300, 301, 320, 240, 0.01, 0, 0, 0),
            "RADIAL_FISHEYE",
            1.0,
        ),
    ],
)
def test_fitted_camera_does_the_same(
    camera: pycolmap.Camera, name: str, most_px: float
) -> None:
    fitted, difference_px = fitted_camera(camera, name)
    assert (fitted.model_name, fitted.camera_id, fitted.width, fitted.height) == (
        name,
        3,
        *SIZE,
    )
    assert difference_px < most_px
    random = np.random.default_rng(0)
    pixels = random.uniform((0, 0), SIZE, (50, 2))
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(50)])
    distances = np.linalg.norm(fitted.img_from_cam(rays) - pixels, axis=1)
    assert distances.max() <= difference_px + 1e-6


def test_difference_is_what_the_worst_point_of_an_image_has() -> None:
    camera = camera_of("SIMPLE_RADIAL", 500, 320, 240, 0.1)
    fitted, difference_px = fitted_camera(camera, "PINHOLE")
    corner = np.array([[0.0, 0.0]])
    ray = np.append(camera.cam_from_img(corner)[0], 1.0)
    found = fitted.img_from_cam(ray[None])[0]
    assert difference_px == pytest.approx(float(np.linalg.norm(found)), rel=0.5)
    assert difference_px > 3.0


def test_exported_text_has_the_camera_model_and_the_same_points(tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    notes: list[str] = []
    before = pycolmap.Reconstruction(tmp_path / "model")
    written = export(
        tmp_path / "model",
        tmp_path / "out",
        ["text"],
        camera_model="RADIAL",
        note=notes.append,
    )
    after = pycolmap.Reconstruction(written["text"])
    assert {camera.model_name for camera in after.cameras.values()} == {"RADIAL"}
    assert after.num_points3D() == before.num_points3D()
    (note,) = notes
    assert note.startswith("cameras: RADIAL in the place of ")
    assert note.endswith(" px apart")
    assert (
        after.compute_mean_reprojection_error()
        == before.compute_mean_reprojection_error()
    )


@pytest.mark.parametrize(
    ("formats", "name", "message"),
    [
        (["text"], "RADIALL", r"camera.model RADIALL is not one of .*RADIAL"),
        (["ply"], "RADIAL", "changes 'text' and 'cameras'"),
    ],
)
def test_wrong_camera_model_is_one_clear_line(
    tmp_path: Path, formats: list[str], name: str, message: str
) -> None:
    write_model(tmp_path / "model")
    with pytest.raises(OptionError, match=message):
        export(tmp_path / "model", tmp_path / "out", formats, camera_model=name)
    assert not (tmp_path / "out").exists()


def test_undistorted_model_is_there_as_text_for_mvsnet(tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    write_photographs(tmp_path / "photos")
    written = export(
        tmp_path / "model", tmp_path / "out", ["mvsnet"], image_path=tmp_path / "photos"
    )
    sparse = written["mvsnet"] / "sparse"
    cameras = (sparse / "cameras.txt").read_text().splitlines()
    rows = [line.split() for line in cameras if not line.startswith("#")]
    assert rows
    assert {row[1] for row in rows} == {"PINHOLE"}
    assert (sparse / "images.txt").is_file()
    assert (sparse / "points3D.txt").is_file()
    assert (written["mvsnet"] / "images").is_dir()
