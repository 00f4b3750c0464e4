"""Alignment undoes a similarity that is known, and refuses what leaves it open."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command import Call
from exported_model import write_model

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.interop.align import Reference, _not_fitting, align
from colmap_affrect.interop.consensus import agreeing, similarity

ORIGIN = (49.5, 15.25, 300.0)
WGS84 = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
TRUE_FROM_OLD = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(np.array([0.3, -1.2, 0.7])), np.array([10.0, -4.0, 2.0])
)


def on_earth(place: np.ndarray, origin: tuple[float, ...]) -> list[float]:
    """Latitude, longitude and altitude."""
    return WGS84.enu_to_ellipsoid(place[None], *origin)[0].tolist()


def centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.projection_center() for image in model.images.values()}


def true_centers(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {name: TRUE_FROM_OLD * center for name, center in centers(model).items()}


def marks(model: pycolmap.Reconstruction) -> list[str]:
    """Rows of three control points, each marked in two photographs of its own choice."""
    rows = ["point,image,px,py,x,y,z"]
    for name, point_id, pair in (
        ("p", 1, (0, 1)),
        ("q", 20, (1, 2)),
        ("r", 40, (3, 0)),
    ):
        place = model.points3D[point_id].xyz
        true = ",".join(map(str, TRUE_FROM_OLD * place))
        for index, cells in zip(pair, (true, ",,"), strict=True):
            image = model.images[index + 1]
            x, y = image.points2D[point_id - 1].xy
            rows.append(f"{name},{image.name},{x},{y},{cells}")
    return rows


def test_control_points_give_scale_rotation_and_place(tmp_path: Path) -> None:
    model = write_model(tmp_path / "model")
    table = tmp_path / "points.csv"
    table.write_text("\n".join(marks(model)))
    done = align(tmp_path / "model", tmp_path / "new", Reference(points_path=table))
    assert done.scale == pytest.approx(2.5, rel=1e-6)
    assert max(done.residuals.values()) < 1e-5
    new = pycolmap.Reconstruction(tmp_path / "new")
    for name, center in centers(new).items():
        np.testing.assert_allclose(center, true_centers(model)[name], atol=1e-5)
    assert not (tmp_path / "new" / "georeference.json").exists()


@pytest.mark.parametrize(("origin", "precision_m"), [
    (ORIGIN, 1e-4), ((-17.0, 180.0, 5.0), 1e-4), ((-90.0, 77.0, 2800.0), 0.01),
])  # fmt: skip
def test_positions_on_earth_become_metres_east_north_and_up(
    tmp_path: Path, origin: tuple[float, ...], precision_m: float
) -> None:
    """Also on both sides of 180 degrees, and round a pole, where latitudes are less precise."""
    model = write_model(tmp_path / "model")
    table = tmp_path / "positions.csv"
    rows = ["name,latitude,longitude,altitude"]
    for name, place in true_centers(model).items():
        rows.append(",".join([name, *map(repr, on_earth(place, origin))]))
    table.write_text("\n".join(rows))
    done = align(tmp_path / "model", tmp_path / "new", Reference(positions_path=table))
    assert done.scale == pytest.approx(2.5, rel=precision_m)
    new = pycolmap.Reconstruction(tmp_path / "new")
    kept = json.loads((tmp_path / "new" / "georeference.json").read_text())
    found_origin = tuple(kept[key] for key in ("latitude", "longitude", "altitude"))
    middle = WGS84.ellipsoid_to_ecef(np.array([origin, found_origin]))
    assert np.linalg.norm(middle[0] - middle[1]) < 100.0
    for name, true in true_centers(model).items():
        expected = WGS84.ellipsoid_to_ecef(np.array([on_earth(true, origin)]))
        found = on_earth(centers(new)[name], found_origin)
        found_in_space = WGS84.ellipsoid_to_ecef(np.array([found]))
        np.testing.assert_allclose(found_in_space, expected, atol=precision_m)


def test_positions_of_a_database_are_taken_from_its_priors(tmp_path: Path) -> None:
    model = write_model(tmp_path / "model")
    with pycolmap.Database.open(tmp_path / "gps.db") as database:
        database.write_camera(model.cameras[1])
        for name, true in true_centers(model).items():
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=1))
            image = database.read_image(image_id)
            database.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=np.array(on_earth(true, ORIGIN)),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
                )
            )
    reference = Reference(gps_database=tmp_path / "gps.db")
    assert align(
        tmp_path / "model", tmp_path / "new", reference
    ).scale == pytest.approx(2.5)


@pytest.mark.parametrize("wrong_row", [None, 4])
def test_places_in_a_plane_through_the_origin_are_as_good_as_others(
    wrong_row: int | None,
) -> None:
    # Of one height, as in many a table; the first is the origin itself.
    after = np.random.default_rng(3).normal(size=(7, 3)) * [40.0, 25.0, 0.0]
    after[0] = 0.0
    old_from_true = TRUE_FROM_OLD.inverse()
    before = np.array([old_from_true * place for place in after])
    found = similarity(before, after)
    assert found is not None
    np.testing.assert_allclose(found.matrix(), TRUE_FROM_OLD.matrix(), atol=1e-9)
    back = similarity(after, before)
    assert back is not None
    np.testing.assert_allclose(back.matrix(), old_from_true.matrix(), atol=1e-9)
    if wrong_row is not None:
        after[wrong_row, :2] += 300.0
    expected = np.arange(7) != (-1 if wrong_row is None else wrong_row)
    np.testing.assert_array_equal(agreeing(before, after, 0.1), expected)


def test_places_on_a_line_leave_the_similarity_open() -> None:
    line = np.outer(np.arange(4.0), [1.0, 2.0, 0.5])
    assert similarity(line, 2.0 * line) is None


WRONG = {
    "nowhere": [0.0, 0.0, 0.0],
    "no latitude": [96.0, 15.25, 300.0],
    "swapped": [15.25, 49.5, 300.0],
    "a street further on": [49.502, 15.25, 300.0],
}
"""Positions that receivers and people write down."""


def write_gps(path: Path, places: dict[str, list[float]]) -> None:
    """Write a database of photographs with positions."""
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 150.0, 160, 120)
        database.write_camera(camera)
        for name, place in places.items():
            image_id = database.write_image(pycolmap.Image(name=name, camera_id=1))
            prior = pycolmap.PosePrior(
                corr_data_id=database.read_image(image_id).data_id,
                position=np.array(place),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
            )
            database.write_pose_prior(prior)


def ring(folder: Path) -> dict[str, list[float]]:
    """Write a model of nine photographs round a place; return their positions, 2 m wrong or so."""
    rng = np.random.default_rng(5)
    model = write_model(folder)
    for number in range(5, 10):
        turned = pycolmap.Rotation3d(np.array([0.0, 0.7 * number, 0.0]))
        center = np.array([3.0 * np.sin(number), 0.3 * number, 3.0 * np.cos(number)])
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        pose = pycolmap.Rigid3d(turned, -turned.matrix() @ center)
        model.add_image_with_trivial_frame(image, pose)
    model.write(folder)
    places = {name: 20.0 * place for name, place in true_centers(model).items()}
    errors = rng.normal(0.0, 2.0, (len(places), 3))
    return {
        name: on_earth(place + error, ORIGIN)
        for (name, place), error in zip(places.items(), errors, strict=True)
    }


@pytest.mark.parametrize("kinds", [
    [], ["nowhere", "nowhere"], ["no latitude"], ["swapped", "nowhere"], ["a street further on"],
    ["nowhere", "no latitude", "swapped", "a street further on"],
])  # fmt: skip
def test_positions_that_are_wrong_are_left_out_and_named(
    tmp_path: Path, call: Call, kinds: list[str]
) -> None:
    places = ring(tmp_path / "model")
    wrong = dict(zip(places, kinds, strict=False))
    write_gps(
        tmp_path / "gps.db",
        places | {name: WRONG[kind] for name, kind in wrong.items()},
    )
    given = ["--model-path", tmp_path / "model", "--output-path", tmp_path / "new"]
    done = call("align", *given, "--gps", tmp_path / "gps.db")
    assert (done.code, done.stderr) == (0, [])
    lines = done.stdout.splitlines()
    assert float(lines[0].split()[1]) == pytest.approx(50.0, rel=0.1)
    left_out = {
        line.split()[2].rstrip(":") for line in lines if line.startswith("left out")
    }
    assert left_out == wrong.keys()
    new = centers(pycolmap.Reconstruction(tmp_path / "new"))
    assert max(np.linalg.norm(center) for center in new.values()) < 300


@pytest.mark.parametrize(("error_m", "is_said"), [(50.0, False), (300.0, True)])
def test_places_that_are_off_by_as_much_as_they_spread_are_doubtful(
    tmp_path: Path, *, error_m: float, is_said: bool
) -> None:
    """As GPS of photographs of something small; these spread 150 m."""
    ring(tmp_path / "model")
    rng = np.random.default_rng(1)
    model = pycolmap.Reconstruction(tmp_path / "model")
    rows = ["name,x,y,z"]
    for name, place in true_centers(model).items():
        wrong = 20.0 * place + rng.normal(0.0, error_m, 3)
        rows.append(",".join([name, *map(str, wrong)]))
    table = tmp_path / "positions.csv"
    table.write_text("\n".join(rows))
    done = align(tmp_path / "model", tmp_path / "new", Reference(positions_path=table))
    assert 100.0 < done.spread < 900.0
    assert done.contradicts_itself == is_said
    assert ("doubtful" in done.summary()) == is_said


PLACES = np.array(
    [[11.0, 7, 5], [19, 7, 6], [19, 13, 5], [11, 12, 7], [14, 9, 9], [17, 11, 8]]
)
"""Of photographs in a model; the first four are within 8 of each other."""


@pytest.mark.parametrize(("distance", "agrees"), [(30.0, True), (300.0, False)])
def test_of_four_places_one_is_wrong_that_is_ten_times_as_far_as_the_others_spread(
    distance: float, *, agrees: bool
) -> None:
    four = PLACES[:4]
    moved = four.copy()
    moved[2] += [0.0, distance, 0.0]
    assert agreeing(four, moved, 0.0).tolist() == [True, True, agrees, True]


@pytest.mark.parametrize(("distance", "is_wrong"), [(0.05, False), (0.5, True)])
def test_a_position_of_a_table_may_be_off_by_a_fiftieth_of_how_far_all_spread(
    distance: float, *, is_wrong: bool
) -> None:
    names = "abcdef"
    old = dict(zip(names, PLACES, strict=True))
    true = {**old, "c": old["c"] + [0.0, 0.0, distance]}
    left_out = _not_fitting(old, true, is_on_earth=False)
    assert set(left_out) == ({"c"} if is_wrong else set())


@pytest.mark.long
@pytest.mark.parametrize("count", [4, 5, 6, 9, 30])
def test_honest_positions_all_count(count: int) -> None:
    """Few places fit some similarity well by chance: the others are not wrong for that."""
    rng = np.random.default_rng(count)
    for _ in range(20):
        before = rng.normal(0.0, 10.0, (count, 3))
        after = before * 3.0 + rng.normal(0.0, 3.0, (count, 3))
        assert agreeing(before, after, 10.0).all()
        after[1] = [1e6, 0.0, 0.0]
        assert agreeing(before, after, 10.0).tolist() == [
            True,
            False,
            *[True] * (count - 2),
        ]


def test_distances_of_photographs_and_marked_points_give_the_scale(
    tmp_path: Path, call: Call
) -> None:
    model = write_model(tmp_path / "model")
    table = tmp_path / "points.csv"
    table.write_text("\n".join(marks(model)))
    true = true_centers(model)
    length = np.linalg.norm(true["a.png"] - true["d.png"])
    between = np.linalg.norm(model.points3D[1].xyz - model.points3D[40].xyz) * 2.5
    done = call(
        "align", "--model-path", tmp_path / "model", "--output-path", tmp_path / "new",
        "--points", table, "--distance", f"a.png,d.png,{length}", "--distance", f"p,r,{between}",
    )  # fmt: skip
    assert (done.code, done.stderr) == (0, [])
    assert done.stdout.startswith("scale       2.5 metres")
    new = centers(pycolmap.Reconstruction(tmp_path / "new"))
    assert np.linalg.norm(new["a.png"] - new["d.png"]) == pytest.approx(length)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("name,x,y,z\na.png,0,0,0\nb.png,1,1,1\nd.png,2,2,2", "lie on one line"),
        ("name,x,y,z\na.png,0,0,0\nb.png,1,1,1", "of 2 photographs"),
        ("name,x,y,z\na.png,0,0\nb.png,1,1,1", "line 2: z is missing"),
        ("name,x,y\na.png,0,nan\n", "y is not finite"),
        ("name,x,h\n", "unknown column 'h'"),
        ("name;x;y;z\na.png;1,5;2;3\n", "separate cells by commas"),
    ],
)
def test_positions_that_leave_the_model_open_are_refused(
    tmp_path: Path, rows: str, message: str
) -> None:
    write_model(tmp_path / "model")
    table = tmp_path / "positions.csv"
    table.write_text(rows)
    with pytest.raises(OptionError, match=message):
        align(tmp_path / "model", tmp_path / "new", Reference(positions_path=table))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("cells", ["164,5", "5,-4", "1e308,5", "nan,5"])
def test_marks_outside_of_their_photograph_are_refused(
    tmp_path: Path, cells: str
) -> None:
    write_model(tmp_path / "model")
    table = tmp_path / "points.csv"
    table.write_text(f"point,image,px,py,x,y,z\np,a.png,{cells},1,2,3\n")
    with pytest.raises(
        OptionError, match=r"line 2: (.* is outside of a\.png|px is not finite)"
    ):
        align(tmp_path / "model", tmp_path / "new", Reference(points_path=table))


def test_nothing_is_overwritten_and_no_model_is_said(tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    reference = Reference(distances=(("a.png", "b.png", 1.0),))
    with pytest.raises(OptionError, match="exists, and is left"):
        align(tmp_path / "model", tmp_path / "model", reference)
    with pytest.raises(AffrectError, match="not a COLMAP model"):
        align(tmp_path, tmp_path / "new", reference)
    wrong = Reference(positions_path=tmp_path / "x", distances=reference.distances)
    with pytest.raises(OptionError, match="leave it out"):
        align(tmp_path / "model", tmp_path / "new", wrong)


def test_names_may_begin_with_a_hyphen_and_hold_commas(
    tmp_path: Path, call: Call
) -> None:
    model = write_model(tmp_path / "model")
    model.find_image_with_name("a.png").name = "-rf.png"
    model.find_image_with_name("b.png").name = "b,c.png"
    model.write(tmp_path / "model")
    known = ["align", "--model-path", tmp_path / "model", "--output-path"]
    for number, given in enumerate(['-rf.png,"b,c.png",2', '"b,c.png",-rf.png,2']):
        done = call(*known, tmp_path / f"new{number}", "--distance", given)
        assert (done.code, done.stderr) == (0, [])
    refused = call(*known, tmp_path / "new", "--distance", "-rf.png,b,c.png,2")
    assert refused.code == 2
    assert (
        "give A,B,METRES, a name that holds a comma in double quotes"
        in refused.errors[0]
    )
