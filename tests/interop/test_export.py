"""Exported models: read back by hand, in the conventions of the programs that they are for."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command import Call
from exported_model import write_model, write_photographs
from filelock import FileLock

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError, ImageError, OptionError, WorkspaceError
from colmap_affrect.interop.export import FORMATS, export


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    return write_model(tmp_path / "model")


def projected(
    model: pycolmap.Reconstruction, name: str, point: np.ndarray
) -> np.ndarray:
    image = model.find_image_with_name(name)
    return model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)


@pytest.mark.usefixtures("model")
def test_points_and_text_hold_the_model(tmp_path: Path) -> None:
    export(tmp_path / "model", tmp_path / "out", ["ply", "text"])
    text = pycolmap.Reconstruction(tmp_path / "out" / "text")
    assert (text.num_reg_images(), text.num_points3D()) == (4, 60)
    ply = (tmp_path / "out" / "points3D.ply").read_bytes()
    assert ply.startswith(b"ply")
    assert b"element vertex 60" in ply


@pytest.mark.usefixtures("model")
def test_transforms_are_of_cameras_that_look_along_minus_z_with_y_up(
    tmp_path: Path,
) -> None:
    write_photographs(tmp_path / "photos")
    formats = ["undistorted", "nerfstudio"]
    written = export(
        tmp_path / "model", tmp_path / "out", formats, image_path=tmp_path / "photos"
    )
    dense = written["undistorted"]
    flat = pycolmap.Reconstruction(dense / "sparse")
    content = json.loads(written["nerfstudio"].read_text())
    frames = content["frames"]
    (low, high) = np.array(content["aabb"])
    assert len(frames) == 4
    point = np.array([0.4, -0.3, 6.0])
    for frame in frames:
        assert (dense / frame["file_path"]).is_file()
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ [*point, 1.0]
        u = frame["cx"] + frame["fl_x"] * x / -z
        v = frame["cy"] - frame["fl_y"] * y / -z
        name = frame["file_path"].removeprefix("images/")
        np.testing.assert_allclose([u, v], projected(flat, name, point), atol=1e-6)
    assert pycolmap.Reconstruction(dense / "sparse" / "0").num_points3D() == 60
    xyz = np.array([point.xyz for point in flat.points3D.values()])
    np.testing.assert_allclose((low + high) / 2, np.median(xyz, axis=0))
    poses = np.array([frame["transform_matrix"] for frame in frames])
    far = np.linalg.norm(poses[:, :3, 3] - (low + high) / 2, axis=1).mean()
    np.testing.assert_allclose((high - low) * 1.32, far)
    up = poses[:, :3, 1].mean(axis=0)
    np.testing.assert_allclose(content["up"], up / np.linalg.norm(up))


def test_table_has_harmless_cells(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 160, 120)
    )
    east = np.array(
        [[0, -1, 0], [0, 0, -1], [1, 0, 0]], float
    )  # right is south, down is down
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(east), -east @ np.array([1000.0, 20.0, 5.0])
    )
    image = pycolmap.Image(name="=1+1.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pose)
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    written = export(tmp_path / "model", tmp_path / "out", ["cameras"])
    (row,) = csv.DictReader(written["cameras"].read_text().splitlines())
    assert row["name"] == "'=1+1.png"
    assert row["focal_px"] == "100.0"
    values = {
        key: float(value)
        for key, value in row.items()
        if key in ["x", "y", "z", "qx", "qy", "qz", "qw"]
    }
    center = np.array([values[key] for key in "xyz"])
    np.testing.assert_allclose(center, [1000.0, 20.0, 5.0])
    turned = pycolmap.Rotation3d(
        np.array([values[f"q{key}"] for key in "xyzw"])
    )  # world_from_cam
    np.testing.assert_allclose(
        turned * np.array([0.0, 0.0, 1.0]), [1.0, 0.0, 0.0], atol=1e-12
    )
    seen = np.array([5.0, 6.0, 7.0])  # in the camera: right, down, forward
    np.testing.assert_allclose(turned * seen + center, [1007.0, 15.0, -1.0])


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    write_model(tmp_path / "model", "OPENCV")
    with pytest.raises(OptionError, match="did you mean 'nerfstudio'"):
        export(tmp_path / "model", tmp_path / "out", ["nerfstudios"])
    with pytest.raises(OptionError, match="--image-path: give the folder"):
        export(tmp_path / "model", tmp_path / "out", ["undistorted"])
    (tmp_path / "photos").mkdir()
    with pytest.raises(ImageError, match=r"a\.png: no such photograph"):
        export(
            tmp_path / "model",
            tmp_path / "out",
            ["undistorted"],
            image_path=tmp_path / "photos",
        )
    export(tmp_path / "model", tmp_path / "out", ["cameras"])
    with pytest.raises(OptionError, match="exists, and is left as it is"):
        export(tmp_path / "model", tmp_path / "out", ["cameras"])


def test_command_names_what_it_wrote(tmp_path: Path, call: Call) -> None:
    write_model(tmp_path / "model")
    done = call(
        "export", "--model-path", tmp_path / "model", "--output-path", tmp_path / "out"
    )
    assert (done.code, done.stderr) == (0, [])
    assert [line.split()[0] for line in done.stdout.splitlines()] == [
        "ply",
        "text",
        "cameras",
    ]
    assert all(Path(line.split()[1]).exists() for line in done.stdout.splitlines())
    help_text = call("export", "--help").stdout
    assert all(name in help_text for name in FORMATS)


def test_native_writers_that_fail_are_one_line_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_model(tmp_path / "model")

    def fail(*_: object) -> None:
        raise ValueError("[ply.cc:382] Check failed: is_open()")

    for form, method in (("ply", "export_PLY"), ("text", "write_text")):
        with monkeypatch.context() as patch:
            patch.setattr(pycolmap.Reconstruction, method, fail)
            with pytest.raises(
                WorkspaceError, match=r"out.*: cannot be written \(\[ply\.cc:382\]"
            ):
                export(tmp_path / "model", tmp_path / "out", [form])
        assert not (tmp_path / "out").exists()


def test_undistortion_that_ends_its_process_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_model(tmp_path / "model")
    write_photographs(tmp_path / "photos")
    ended = subprocess.CompletedProcess([], -signal.SIGABRT, b"")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: ended)
    given = {"image_path": tmp_path / "photos"}
    why = r"dense: cannot be written \(COLMAP was ended by SIGABRT\)"
    with pytest.raises(WorkspaceError, match=why):
        export(tmp_path / "model", tmp_path / "out", ["undistorted"], **given)
    assert not (tmp_path / "out").exists()


def test_a_model_that_a_run_is_about_to_replace_is_not_called_damaged(
    tmp_path: Path,
) -> None:
    (tmp_path / "out" / "sparse").mkdir(parents=True)
    model = tmp_path / "out" / "sparse" / "0"
    with FileLock(tmp_path / "out" / ".lock"):
        for given in (model, tmp_path / "out" / "sparse", tmp_path / "out"):
            with pytest.raises(
                WorkspaceError, match="another colmap-affrect is writing this"
            ):
                export(given, tmp_path / "new", ["ply"])
        write_model(model)
        export(model, tmp_path / "new", ["ply"])
    shutil.rmtree(model)
    with pytest.raises(OptionError, match="no such folder"):
        export(model, tmp_path / "newer", ["ply"])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("name", ["images.bin", "frames.bin", "points3D.txt"])
def test_pipes_among_the_files_of_a_model_are_refused(
    tmp_path: Path, name: str
) -> None:
    write_model(tmp_path / "model")
    (tmp_path / "model" / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / "model" / name)
    with pytest.raises(AffrectError, match="is not a file, but a pipe"):
        export(tmp_path / "model", tmp_path / "out", ["ply"])


@pytest.mark.long
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid(), reason="only root mounts disks"
)
@pytest.mark.parametrize(
    "limit", ["size=64k", "size=300k", "nr_inodes=4", "nr_inodes=15"]
)
@pytest.mark.parametrize(
    "form", ["ply", "text", "undistorted", "nerfstudio", "cameras"]
)
def test_small_disks_are_one_line(
    tmp_path: Path, call: Call, limit: str, form: str
) -> None:
    write_model(tmp_path / "model")
    write_photographs(tmp_path / "photos")
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", limit, "none", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        given = [
            "--model-path",
            tmp_path / "model",
            "--image-path",
            tmp_path / "photos",
        ]
        done = call("export", *given, "--output-path", disk / "new", "--format", form)
        assert done.code in (0, 1)
        assert len(done.stderr) == done.code
        assert all("cannot be written (No space left" in line for line in done.stderr)
        assert not done.code or not list(disk.iterdir())
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.parametrize(("name", "why"), [
    ("IMG 1.png", "a blank"), (" a.png", "a blank"), ("a.png ", "a blank"),
    ("a\u3000b.png", "a blank"), ("a\u00a0b.png", "a blank"), ("line\nbreak.png", "a blank"),
    ("#1.png", "begins as a comment"), ("a\u200bb.png", "characters that do not print"),
    ("", "it is empty"),
])  # fmt: skip
def test_text_is_refused_where_colmap_could_not_read_the_names(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, why: str
) -> None:
    model = write_model(tmp_path / "model")
    model.images[1].name = name
    model.write(tmp_path / "model")
    with pytest.raises(
        OptionError, match=f"text: COLMAP could not read back the names .*{why}"
    ):
        export(tmp_path / "model", tmp_path / "out", ["text", "ply"])
    assert not (tmp_path / "out").exists()
    assert [*export(tmp_path / "model", tmp_path / "out")] == ["ply", "cameras"]
    assert "text: left out, COLMAP could not read back the names" in caplog.text
    with pytest.raises(OptionError, match="mvsnet: COLMAP could not read back"):
        export(tmp_path / "model", tmp_path / "out2", "mvsnet", image_path=tmp_path)
    assert not (tmp_path / "out2").exists()


@pytest.mark.usefixtures("model")
def test_output_folder_of_a_run_is_taken_for_its_model(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos")
    out = tmp_path / "run"
    out.mkdir()
    (out / "sparse").mkdir()
    (tmp_path / "model").rename(out / "sparse" / "0")
    written = export(
        out,
        tmp_path / "new",
        ["cameras", "undistorted"],
        image_path=tmp_path / "photos",
    )
    assert (written["undistorted"] / "images" / "a.png").exists()
