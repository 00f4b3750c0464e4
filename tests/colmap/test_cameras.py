"""Cameras that the user gives are read as they are meant; records of cameras come back."""

from __future__ import annotations

from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import (
    CameraRecord,
    read_camera_records,
    read_given_cameras,
    write_camera_records,
)
from colmap_affrect.errors import OptionError, WorkspaceError
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.project.report import ModelSummary


def given(path: Path, **options: object):
    return read_given_cameras(CameraOptions(cameras_path=str(path), **options))


def table(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "plates.csv"
    path.write_text("\ufeff" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_table_gives_as_much_as_is_known(tmp_path: Path) -> None:
    found = given(
        table(
            tmp_path,
            "name, focal_px, focal_mm, plate_width_mm, model, params, cx, cy, camera",
            "a.jpg, 900",
            "b č.jpg,, 210, 180,,,,, plates",
            "side/c.jpg,,,, PINHOLE, 901;902;401;301",
            'd.jpg,,,, PINHOLE, "901,902,401,301"',
            "e.jpg,,,,,, 390.5, 310",
            "",
            "f.jpg,,,, OPENCV",
        ),
        principal_point="1,2",
    )
    assert found["a.jpg"].focal_px == 900
    assert (found["a.jpg"].cx, found["a.jpg"].cy) == (1, 2)
    assert found["b č.jpg"].focal_mm == 210
    assert found["b č.jpg"].camera == "plates"
    assert found["side/c.jpg"].said == found["d.jpg"].said
    assert found["d.jpg"].params == (901, 902, 401, 301)
    assert (found["e.jpg"].cx, found["e.jpg"].cy) == (390.5, 310)
    assert (found["f.jpg"].model, found["f.jpg"].focal_px) == ("OPENCV", None)
    where = found["f.jpg"].where
    assert str(where.file.value).endswith("plates.csv")
    assert where.part == "line 8"


@pytest.mark.parametrize(("lines", "message"), [
    (["name,focal_cm", "a,3"], "plates.csv: unknown column 'focal_cm' .did you mean 'focal_"),
    ([], "must have the column 'name'"),
    (["name,focal_px", "a,3", "a,4"], "line 3: a is there twice"),
    (["name,focal_px", "a,3,4"], "line 2: has 3 cells and the first line 2; values with commas"),
    (["name,focal_px", "a,long"], "line 2: focal_px='long': should be a valid number"),
    (["name,focal_px", "a,0"], "line 2: focal_px='0': should be greater than or equal to 0.001"),
    (["name,focal_px", "a,1e-300"], "line 2: focal_px='1e-300': should be greater than or"),
    (["name,focal_px", "a,1e999"], "a finite number"),
    (["name,focal_mm", "a,50"], "line 2: focal_mm needs plate_width_mm"),
    (["name,focal_px,focal_mm", "a,5,5"], "line 2: focal_px and focal_mm say the same twice"),
    (["name,cx", "a," + "5" * 200_000], "field larger than field limit"),
    (["name,cx", "a,5"], "line 2: give both cx and cy, or none"),
    (["name,model", "a,PINHOL"], "line 2: model: PINHOL is not one of SIMPLE_PINHOLE"),
    (["name,model,params", "a,PINHOLE,1 2 3"], r"line 2: params: PINHOLE needs 4 values \(fx"),
    (
        ["name,focal_px,camera", "a,3,X", "b,,Y", "c,4,X"],
        "line 4: says something else of camera 'X' than line 2; give them two labels",
    ),
])  # fmt: skip
def test_wrong_tables_are_one_clear_line(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    with pytest.raises(OptionError, match=message) as error:
        given(table(tmp_path, *lines))
    assert "plates.csv" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("options", "message"), [
    ({"focal_length_px": -1.0}, "greater than or equal"),
    ({"focal_mm": 50.0}, "--focal-mm, --film-width-mm: one without the other; give both"),
    (
        {"params": "900,450,300,0", "focal_length_px": 5.0},
        "--camera-params, .*: params have focal length",
    ),
    ({"model": "PINHOL"}, "--camera-model, .* model: PINHOL is not one of"),
    ({"params": "0,450,300,0"}, "params: a focal length of 0 px cannot be"),
    ({"params": "1e-300,450,300,0"}, "params: a focal length of 1e-300 px cannot be"),
    ({"principal_point": "1"}, "--principal-point: cy='': should be a valid number"),
    ({"cameras_path": "nowhere.csv"}, "--cameras-path nowhere.csv: cannot be read .No such"),
])  # fmt: skip
def test_wrong_options_are_one_clear_line(
    options: dict[str, object], message: str
) -> None:
    with pytest.raises(OptionError, match=message) as error:
        read_given_cameras(CameraOptions(**options))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_cameras_of_a_model_are_read(tmp_path: Path, write: str) -> None:
    model = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_points3D=5, num_rigs=2, num_frames_per_rig=2
        )
    )
    getattr(model, write)(tmp_path)
    for path in (tmp_path, tmp_path / f"cameras.{write[6:9].replace('tex', 'txt')}"):
        found = given(path)
        assert found[""].params == ()
        for image in model.images.values():
            camera = model.cameras[image.camera_id]
            assert found[image.name].params == pytest.approx(tuple(camera.params))
            assert found[image.name].size == (camera.width, camera.height)
    for file in tmp_path.glob("points3D.*"):
        file.unlink()
    with pytest.raises(
        OptionError, match=r"^--cameras-path .*give the folder that holds cameras"
    ):
        given(tmp_path)


FROM_EXIF = CameraRecord(("a č.jpg", "b.jpg"), "exif", 812.5, size=(640, 480))
RESCALED = CameraRecord(("c.jpg",), "exif-rescaled", 500.0, "shrunk", (300, 400))


def test_records_come_back(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    assert read_camera_records(path) == {}
    write_camera_records(path, {12: RESCALED, 3: FROM_EXIF})
    assert read_camera_records(path) == {3: FROM_EXIF, 12: RESCALED}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["", "[]", '{"x": 3}'])
def test_damaged_records_are_one_clear_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(
        WorkspaceError, match=r"cameras\.json: damaged .*; run .*verify"
    ):
        read_camera_records(path)


def test_report_has_the_focal_length_in_longer_sides_and_the_refined_one() -> None:
    model = ModelSummary((), 0, 0.0, 0.0, focals_px={"c.jpg": 470.0, "z": 9.0})
    entry = RESCALED.to_report(12, model)
    assert entry["refined_px"] == 470.0
    assert (entry["id"], entry["num_images"], entry["source"]) == (
        12,
        1,
        "exif-rescaled",
    )
    assert entry["focal_longer_sides"] == pytest.approx(1.25)
    known = FROM_EXIF.to_report(3, None)
    assert known["refined_px"] is None
