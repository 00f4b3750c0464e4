"""Which images share a camera before pairs are verified, and which one they get."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from numpy.testing import assert_allclose
from photographs_with_exif import BODY, LENS_50, write_photograph

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import (
    CameraRecord,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.colmap.database import camera_matrix, open_database
from colmap_affrect.colmap.image_import import import_images, record_cameras
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.errors import OptionError
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.session.view_graph import ViewGraph

WIDE = {**BODY, "FocalLengthIn35mmFilm": 28}
LONG = {**BODY, "FocalLengthIn35mmFilm": 80}
DIAGONAL = (90**2 + 60**2) ** 0.5
WIDE_PX = 28 / 43.27 * DIAGONAL
LONG_PX = 80 / 43.27 * DIAGONAL


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Wide ones of one camera, one of them turned; a long one; a scan; all in two folders."""
    folder = tmp_path / "photos"
    write_photograph(folder / "a.jpg", (90, 60), WIDE)
    write_photograph(folder / "b.jpg", (90, 60), {**WIDE, "Orientation": 3})
    write_photograph(folder / "c.jpg", (90, 60), LONG)
    write_photograph(folder / "side" / "d.jpg", (60, 90), WIDE)
    write_photograph(folder / "side" / "e.jpg", (60, 90), WIDE)
    write_photograph(folder / "side" / "f.png", (60, 90), {})
    return folder


NAMES = ["a.jpg", "b.jpg", "c.jpg", "side/d.jpg", "side/e.jpg", "side/f.png"]


def imported(
    path: Path, photos: Path, names: list[str], **options: object
) -> list[str]:
    """Import images, and return for each the first image with the same camera."""
    assert import_images(path, photos, names, CameraOptions(**options)) == []
    return sharing(path)


def sharing(path: Path) -> list[str]:
    with open_database(path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
    firsts: dict[int, str] = {}
    return [firsts.setdefault(image.camera_id, image.name) for image in images]


def camera_of(path: Path, name: str) -> pycolmap.Camera:
    with open_database(path) as database:
        return database.read_camera(database.read_image_with_name(name).camera_id)


SHARED = ["a.jpg", "a.jpg", "c.jpg", "side/d.jpg", "side/d.jpg", "side/f.png"]


def test_images_of_one_body_lens_focal_length_and_size_share_a_camera(
    photos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.db"
    assert imported(path, photos, NAMES) == SHARED
    assert camera_of(path, "b.jpg").focal_length == pytest.approx(WIDE_PX)
    assert camera_of(path, "side/e.jpg").focal_length == pytest.approx(WIDE_PX)
    scan = camera_of(path, "side/f.png")
    assert (scan.focal_length, scan.has_prior_focal_length) == (1.2 * 90, False)
    with open_database(path) as database:
        assert (database.num_rigs(), database.num_frames(), database.num_images()) == (
            4,
            6,
            6,
        )
    assert imported(tmp_path / "b.db", photos, NAMES, mode="per-image") == NAMES
    assert imported(tmp_path / "c.db", photos, NAMES, ignore_exif=True) == NAMES
    assert not camera_of(tmp_path / "c.db", "a.jpg").has_prior_focal_length


def test_forced_camera_takes_no_focal_length_that_its_images_contradict(
    photos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.db"
    assert imported(path, photos, NAMES[:3], mode="single") == ["a.jpg"] * 3
    assert not camera_of(path, "a.jpg").has_prior_focal_length
    initial = InitialCameras(photos, CameraOptions(mode="single"))
    _, record = initial.camera(NAMES[:3], (90, 60))
    assert record.source == "guess"
    assert record.why == f"EXIF of its images says {WIDE_PX:.0f} to {LONG_PX:.0f} px"
    # One that knows nothing does not disturb.
    _, record = initial.camera(["side/f.png", "side/d.jpg"], (60, 90))
    assert (record.source, record.focal_px) == ("exif", pytest.approx(WIDE_PX))


def test_wrong_exif_of_a_shrunk_photograph_is_rescaled_in_the_database(
    tmp_path: Path,
) -> None:
    tags = {**LENS_50, "ExifImageWidth": 4368, "ExifImageHeight": 2912}
    write_photograph(tmp_path / "photos" / "a.jpg", (728, 1092), tags)
    path = tmp_path / "a.db"
    imported(path, tmp_path / "photos", ["a.jpg"])
    camera = camera_of(path, "a.jpg")
    assert camera.focal_length == pytest.approx(50 / 35.8 * 1092)
    assert camera.has_prior_focal_length
    record_cameras(
        ViewGraph(path).cameras,
        tmp_path / "cameras.json",
        InitialCameras(tmp_path / "photos", CameraOptions()),
    )
    assert read_camera_records(tmp_path / "cameras.json")[1].source == "exif-rescaled"


@pytest.mark.parametrize(("options", "params", "given"), [
    ({"focal_length_px": 70.0}, [70, 45, 30, 0], ("focal",)),
    ({"principal_point": "40,33"}, [WIDE_PX, 40, 33, 0], ("principal-point",)),
    (
        {"model": "PINHOLE", "focal_length_px": 70.0, "principal_point": "40 33"},
        [70, 70, 40, 33],
        ("focal", "principal-point", "distortion"),
    ),
])  # fmt: skip
def test_what_is_given_stays_and_the_rest_is_as_it_would_be(
    photos: Path,
    tmp_path: Path,
    options: dict[str, object],
    params: list[float],
    given: object,
) -> None:
    path = tmp_path / "a.db"
    imported(path, photos, ["a.jpg"], **options)
    camera = camera_of(path, "a.jpg")
    assert_allclose(camera.params, params)
    assert camera.has_prior_focal_length
    _, record = InitialCameras(photos, CameraOptions(**options)).camera(
        ["a.jpg"], (90, 60)
    )
    assert record.given == given
    assert record.source == ("given" if "focal" in record.given else "exif")
    assert record.is_all_given == ("distortion" in record.given)


def test_lens_and_film_stand_where_nothing_else_is_known(photos: Path) -> None:
    lens = CameraOptions(focal_mm=50.0, film_width_mm=36.0)
    camera, record = InitialCameras(photos, lens).camera(["a.jpg"], (90, 60))
    assert (camera.focal_length, record.source) == (WIDE_PX, "exif")
    ignoring = InitialCameras(photos, lens.changed(ignore_exif=True))
    for size in ((90, 60), (60, 90)):  # the longer side is that of the film
        camera, record = ignoring.camera(["a.jpg"], size)
        assert camera.focal_length == pytest.approx(125.0)
        assert (record.source, record.given, record.why) == ("given", ("focal",), "")
    _, record = ignoring.camera(["a.jpg"], (24000, 3000))
    assert record.why.startswith("a panorama, which no camera model fits?")


def test_table_decides_who_shares_a_camera_and_the_rest_is_as_without(
    photos: Path, tmp_path: Path
) -> None:
    listed = tmp_path / "plates.csv"
    listed.write_text(
        "name,focal_mm,plate_width_mm,camera\n"
        "a.jpg,150,180,plates\nc.jpg,150,180,plates\nside/f.png,200,120,\n"
    )
    path = tmp_path / "a.db"
    found = imported(path, photos, NAMES, cameras_path=str(listed))
    assert found == [
        "a.jpg",
        "b.jpg",
        "a.jpg",
        "side/d.jpg",
        "side/d.jpg",
        "side/f.png",
    ]
    assert camera_of(path, "c.jpg").focal_length == pytest.approx(150 / 180 * 90)
    assert camera_of(path, "side/f.png").focal_length == pytest.approx(200 / 120 * 60)
    assert camera_of(path, "b.jpg").focal_length == pytest.approx(WIDE_PX)
    assert camera_of(path, "side/f.png").has_prior_focal_length


@pytest.mark.parametrize(("rows", "options", "message"), [
    (["z.jpg,70,"], {}, r"plates\.csv, line 2: z\.jpg is not in .*photos$"),
    (
        ["a.jpg,70,", "b.jpg,80,"],
        {"mode": "per-folder"},
        r"line 3: says something else than line 2, and --camera-mode per-folder .*; leave that",
    ),
    (
        [],
        {"mode": "single", "params": "70,45,30,0"},
        "^--camera-mode single: a.jpg is 90 x 60 px, side/d.jpg is 60 x 90 px.*; give .* or leave",
    ),
])  # fmt: skip
def test_cameras_that_cannot_be_are_one_clear_line(
    photos: Path,
    tmp_path: Path,
    rows: list[str],
    options: dict[str, object],
    message: str,
) -> None:
    listed = tmp_path / "plates.csv"
    listed.write_text("\n".join(["name,focal_px,camera", *rows]))
    initial = InitialCameras(photos, CameraOptions(cameras_path=str(listed), **options))
    with pytest.raises(OptionError, match=message) as error:
        initial.check(NAMES)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("rows", "options", "num_sizes", "shared"),
    [
        ([], {"mode": "single"}, 2, ["a.jpg"] * 3 + ["side/d.jpg"] * 3),
        ([], {"mode": "per-folder"}, 0, ["a.jpg"] * 3 + ["side/d.jpg"] * 3),
        (
            ["a.jpg,,X", "c.jpg,,X", "side/d.jpg,,X", "side/f.png,,X"],
            {"ignore_exif": True},
            2,
            ["a.jpg", "b.jpg", "a.jpg", "side/d.jpg", "side/e.jpg", "side/d.jpg"],
        ),
        (
            ['a.jpg,"70,45,30,0",', 'side/d.jpg,"70,30,45,0",'],
            {"mode": "single"},
            2,
            ["a.jpg"] * 3 + ["side/d.jpg"] * 3,
        ),
    ],
)
def test_images_of_several_sizes_that_should_share_a_camera_do_so_size_by_size(
    photos: Path,
    tmp_path: Path,
    rows: list[str],
    options: dict[str, object],
    num_sizes: int,
    shared: list[str],
) -> None:
    """As scans of prints, or crops, of what one camera took."""
    listed = tmp_path / "plates.csv"
    listed.write_text("\n".join(["name,params,camera", *rows]))
    given = {"cameras_path": str(listed), **options}
    found = InitialCameras(photos, CameraOptions(**given)).check(NAMES)
    assert [warning.values["num_sizes"] for warning in found] == [num_sizes] * len(
        found
    )
    assert bool(found) == bool(num_sizes)
    for warning in found:
        both = "a.jpg is 90 x 60 px, side/d.jpg is 60 x 90 px"
        assert (warning.code, warning.values["example"]) == ("several_sizes", both)
    assert imported(tmp_path / "a.db", photos, NAMES[:2], **given) == shared[:2]
    assert imported(tmp_path / "a.db", photos, NAMES, **given) == shared


def test_lens_and_film_tell_the_focal_lengths_of_scans_of_all_sizes(
    photos: Path,
) -> None:
    options = CameraOptions(
        mode="single", ignore_exif=True, focal_mm=50.0, film_width_mm=36.0
    )
    initial = InitialCameras(photos, options)
    for group, names in initial.groups(NAMES).items():
        camera, record = initial.camera(names, initial.size(names[0]))
        assert group[0] == "single"
        assert (camera.focal_length, record.source) == (pytest.approx(125.0), "given")


def test_model_must_be_of_these_images(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 90 60 71 44 31\n")
    (tmp_path / "points3D.txt").touch()
    images = "1 1 0 0 0 0 0 0 1 {}\n\n2 1 0 0 0 0 0 0 1 others.jpg\n\n"
    (tmp_path / "images.txt").write_text(images.format("c.jpg"))
    initial = InitialCameras(photos, CameraOptions(cameras_path=str(tmp_path)))
    initial.check(NAMES)  # it may have more images
    with pytest.raises(OptionError, match=r"camera 1: others\.jpg is not in"):
        initial.check(NAMES[:2])
    (tmp_path / "images.txt").write_text(images.format("side/d.jpg"))
    initial = InitialCameras(photos, CameraOptions(cameras_path=str(tmp_path)))
    with pytest.raises(
        OptionError, match=r"camera 1: is 90 x 60 px, side/d\.jpg is 60 x 90 px; give "
    ):
        initial.check(NAMES)


def test_intrinsics_before_the_import_are_those_of_the_database(
    photos: Path, tmp_path: Path
) -> None:
    listed = tmp_path / "plates.csv"
    listed.write_text("name,cx,cy\na.jpg,40,33\n")
    for number, options in enumerate(
        [
            {},
            {"cameras_path": str(listed)},
            {"mode": "per-image", "principal_point": "40,33"},
        ]
    ):
        path = tmp_path / f"{number}.db"
        imported(path, photos, NAMES, **options)
        initial = InitialCameras(photos, CameraOptions(**options))
        for name, camera in ViewGraph(path).cameras.items():
            assert_allclose(initial.matrix(name, NAMES), camera_matrix(camera))


def test_records_are_kept_and_follow_the_images_that_come_later(
    photos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.db"
    records_path = tmp_path / "cameras.json"
    initial = InitialCameras(photos, CameraOptions())
    imported(path, photos, NAMES[:1])
    record_cameras(ViewGraph(path).cameras, records_path, initial)
    (record,) = read_camera_records(records_path).values()
    assert (record.names, record.source, record.size) == (("a.jpg",), "exif", (90, 60))
    given = CameraRecord(("a.jpg",), "given", 70.0, "", (90, 60))
    write_camera_records(records_path, {1: given})
    imported(path, photos, NAMES)
    record_cameras(ViewGraph(path).cameras, records_path, initial)
    records = read_camera_records(records_path)
    assert [(r.names, r.source) for r in records.values()] == [
        (("a.jpg", "b.jpg"), "given"),
        (("c.jpg",), "exif"),
        (("side/d.jpg", "side/e.jpg"), "exif"),
        (("side/f.png",), "guess"),
    ]
    assert records[1].focal_px == 70.0


def test_lens_in_mm_is_on_record_where_nothing_tells_the_size_of_the_sensor(
    tmp_path: Path,
) -> None:
    tags = {"Make": "Nobody", "Model": "Knows", "FocalLength": 35.0}
    write_photograph(tmp_path / "photos" / "a.jpg", (90, 60), tags)
    write_photograph(
        tmp_path / "photos" / "b.jpg", (90, 60), {**tags, "FocalLengthIn35mmFilm": 50}
    )
    initial = InitialCameras(tmp_path / "photos", CameraOptions())
    records = {name: initial.camera([name], (90, 60))[1] for name in ("a.jpg", "b.jpg")}
    assert (records["a.jpg"].source, records["a.jpg"].lens_mm) == ("guess", 35.0)
    assert (records["b.jpg"].source, records["b.jpg"].lens_mm) == ("exif", 0.0)
    assert records["a.jpg"].to_report(1, None)["lens_mm"] == 35.0
    told = CameraOptions(focal_mm=35.0, film_width_mm=24.0)
    record = InitialCameras(tmp_path / "photos", told).camera(["a.jpg"], (90, 60))[1]
    assert (record.source, record.lens_mm) == ("given", 0.0)


def test_cameras_of_another_program_are_given_where_they_are_flagged(
    photos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.db"
    records_path = tmp_path / "cameras.json"
    options = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params="71,72,44,31"
    )
    with open_database(path):
        pass
    pycolmap.import_images(path, photos, pycolmap.CameraMode.SINGLE, NAMES[:1], options)
    pycolmap.import_images(path, photos, pycolmap.CameraMode.PER_IMAGE, NAMES[5:])
    record_cameras(ViewGraph(path).cameras, records_path)
    before = read_camera_records(records_path)
    assert [(r.source, r.focal_px) for r in before.values()] == [
        ("given", 71.5),
        ("guess", 108),
    ]
    records_path.unlink()
    record_cameras(
        ViewGraph(path).cameras, records_path, InitialCameras(photos, CameraOptions())
    )
    assert [r.source for r in read_camera_records(records_path).values()] == [
        "given",
        "guess",
    ]
    assert camera_of(path, "a.jpg").params.tolist() == [71, 72, 44, 31]


def test_where_one_photograph_was_cropped_a_smaller_one_of_its_body_may_be_a_crop(
    tmp_path: Path,
) -> None:
    tags = {**LENS_50, "ExifImageWidth": 4368, "ExifImageHeight": 2912}
    photos = tmp_path / "photos"
    write_photograph(photos / "a.jpg", (1092, 728), tags)
    write_photograph(photos / "b.jpg", (1092, 728), tags)
    initial = InitialCameras(photos, CameraOptions())
    assert initial.group("a.jpg") == initial.group("b.jpg")
    _, record = initial.camera(["a.jpg", "b.jpg"], (1092, 728))
    assert (record.source, record.uncropped_px) == ("exif-rescaled", 0.0)
    write_photograph(photos / "c.jpg", (1000, 800), tags)
    with_crop = InitialCameras(photos, CameraOptions())
    assert with_crop.group("a.jpg") != with_crop.group("b.jpg")
    for name, size in (("a.jpg", (1092, 728)), ("c.jpg", (1000, 800))):
        _, record = with_crop.camera([name], size)
        assert record.source == "guess"
        assert record.uncropped_px == pytest.approx(50 / 35.8 * 4368)


def test_photographs_of_one_body_with_several_shapes_are_crops_of_the_largest(
    tmp_path: Path,
) -> None:
    """Programs that crop may leave out the size that EXIF had."""
    tags = {
        **BODY,
        "FocalLength": 50.0,
        "FocalLengthIn35mmFilm": 50,
    }
    photos = tmp_path / "photos"
    for name, size in (
        ("whole.jpg", (1500, 1000)),
        ("upright.jpg", (1000, 1500)),
        ("same.jpg", (900, 600)),
    ):
        write_photograph(photos / name, size, tags)
    initial = InitialCameras(photos, CameraOptions())
    _, record = initial.camera(["same.jpg"], (900, 600))
    assert record.source == "exif"  # no other shape: it may have been shrunk
    write_photograph(photos / "cut.jpg", (800, 760), tags)
    with_crop = InitialCameras(photos, CameraOptions())
    whole_px = 50.0 / math.hypot(36.0, 24.0) * math.hypot(1500.0, 1000.0)
    for name, size in (
        ("whole.jpg", (1500, 1000)),
        ("upright.jpg", (1000, 1500)),
    ):
        _, record = with_crop.camera([name], size)
        assert record.source == "exif"
        assert record.focal_px == pytest.approx(whole_px, rel=0.01)
    for name, size in (
        ("cut.jpg", (800, 760)),
        ("same.jpg", (900, 600)),
    ):
        _, record = with_crop.camera([name], size)
        assert record.source == "guess"
        assert record.uncropped_px == pytest.approx(whole_px, rel=0.01)
        assert "others of its camera 1500 x 1000" in record.why
