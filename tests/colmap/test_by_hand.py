"""Tie points, rejected pairs and photographs that are left out: tables, and the mapped copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import write_images
from small_comparison import IMAGE_SIZE, write_scene
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import NOTHING, ByHand, read_marks, triangulated
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import OptionError

NAMES = ["old/a.jpg", "b.jpg", "c.png"]
ROWS = "p,a.jpg,10.5,20\np,b,30,40.25\nq,c.png,1,2\n"


def marked(path: Path, text: str) -> dict[str, dict[str, list[float]]]:
    path.write_text(text, encoding="utf-8")
    found: dict[str, dict[str, list[float]]] = {}
    for point, marks in read_marks(path, NAMES).items():
        found[point] = {name: mark.tolist() for name, mark in marks.items()}
    return found


@pytest.mark.parametrize("text", [
    ROWS,
    "point,photograph,x,y\n" + ROWS,
    "Marker,Camera,X,Y\n" + ROWS,
    "y,image,x,point\n20,a,10.5,p\n40.25,b.jpg,30,p\n2,c,1,q\n",
    "point,image,px,py,x,y,z\np,a.jpg,10.5,20,7,8,9\np,b.jpg,30,40.25,,,\nq,c.png,1,2,,,\n",
])  # fmt: skip
def test_tables_may_have_any_order_of_columns_and_short_names(
    tmp_path: Path, text: str
) -> None:
    expected = {
        "p": {"old/a.jpg": [10.5, 20.0], "b.jpg": [30.0, 40.25]},
        "q": {"c.png": [1.0, 2.0]},
    }
    assert marked(tmp_path / "marks.csv", text) == expected


@pytest.mark.parametrize(("text", "words"), [
    ("p,d.jpg,1,2\n", "line 1: no such photograph, d.jpg"),
    ("p,a.jpg,1,two\n", "line 1: x and y must be numbers"),
    ("point,photograph,x,y\n,a.jpg,1,2\n", "line 2: must name a point and a photograph"),
    ("p,a.jpg,1,2\n", "no point is marked in two photographs"),
    ("p,a.jpg,1,2\np,c,4,5\np,a,9,2\n", "line 3: p is at 1, 2 of old/a.jpg already"),
    ("point,photograph,x,y,colour\np,a,1,2,red\n", "unknown column 'colour'"),
])  # fmt: skip
def test_what_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(OptionError, match=words):
        marked(tmp_path / "marks.csv", text)


@pytest.mark.parametrize("cells", ["nan,2", "1,inf", "-inf,2", "NaN,NaN"])
def test_marks_are_finite(tmp_path: Path, cells: str) -> None:
    with pytest.raises(
        OptionError, match="line 2: x and y must be finite numbers of px"
    ):
        marked(tmp_path / "marks.csv", f"p,a,1,2\np,b,{cells}\n")


@pytest.mark.parametrize("cells", ["644,2", "1,484", "-4,2", "1e308,2", "5,-3.5"])
def test_marks_outside_of_their_photograph_are_refused(
    tmp_path: Path, database: Path, cells: str
) -> None:
    (tmp_path / "marks.csv").write_text(f"p,a,-1,481.5\np,b,{cells}\n")
    by_hand = ByHand(tie_points_path=tmp_path / "marks.csv")
    words = r"line 2: .* is outside of b\.jpg, which is 640 x 480 px; give px of the photograph"
    with pytest.raises(OptionError, match=words):
        by_hand.marks(NAMES, lambda _: (640, 480))
    with pytest.raises(OptionError, match=words):
        by_hand.copy_database(database, tmp_path / "mapped.db")
    assert not (tmp_path / "mapped.db").exists()


def test_names_that_several_photographs_have_are_refused(tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text("p,a,1,2\np,b,1,2\n")
    with pytest.raises(OptionError, match="no such photograph, a "):
        read_marks(tmp_path / "marks.csv", ["1/a.jpg", "2/a.jpg", "b.jpg"])


def test_a_whole_name_is_not_the_short_one_of_another(tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text("p,a.jpg,1,2\np,old/a.jpg,3,4\n")
    (found,) = read_marks(tmp_path / "marks.csv", ["a.jpg", "old/a.jpg"]).values()
    assert found["a.jpg"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "by_hand", [ByHand(left_out=("x.jpg",)), ByHand(rejected=(("b.jpg", "x"),))]
)
def test_photographs_that_are_not_there_are_refused(by_hand: ByHand) -> None:
    with pytest.raises(OptionError, match="no such photograph"):
        by_hand.marks(NAMES)


def test_digests_tell_what_is_said(tmp_path: Path) -> None:
    table = tmp_path / "marks.csv"
    table.write_text(ROWS)
    said = [
        ByHand(tie_points_path=table),
        ByHand(left_out=("b.jpg",)),
        ByHand(rejected=(("b.jpg", "c.png"),)),
    ]
    digests = [by_hand.digest() for by_hand in said]
    table.write_text(ROWS + "q,b,5,6\n")
    assert not NOTHING.digest()
    assert len({*digests, said[0].digest()}) == 4


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Three images with four keypoints each, in another number of columns, and all pairs."""
    path = tmp_path / "database.db"
    with open_database(path) as made:
        camera = pycolmap.Camera.create_from_model_name(
            1, "SIMPLE_PINHOLE", 500.0, 640, 480
        )
        write_images(made, camera, NAMES)
        for image_id, columns in ((1, 6), (2, 4)):
            made.write_keypoints(image_id, np.full((4, columns), 7.0, np.float32))
        for pair in [(1, 2), (1, 3), (2, 3)]:
            geometry = pycolmap.TwoViewGeometry(
                inlier_matches=np.zeros((1, 2), np.uint32)
            )
            made.write_two_view_geometry(*pair, geometry)
    return path


def test_the_copy_has_tie_points_behind_the_keypoints(
    tmp_path: Path, database: Path
) -> None:
    (tmp_path / "marks.csv").write_text(ROWS + "q,b.jpg,5,6\n")
    by_hand = ByHand(tie_points_path=tmp_path / "marks.csv")
    indices = by_hand.copy_database(database, tmp_path / "mapped.db")
    assert indices == {"p": {"old/a.jpg": 4, "b.jpg": 4}, "q": {"c.png": 0, "b.jpg": 5}}
    with open_database(tmp_path / "mapped.db") as copy:
        found = [copy.read_keypoints(image_id) for image_id in (1, 2, 3)]
        assert copy.num_matched_image_pairs() == 0
        assert len(copy.read_two_view_geometry_num_inliers()[0]) == 3
    assert found[0].tolist() == [[7.0] * 6] * 4 + [[10.5, 20.0, 3.0, 0.0, 0.0, 3.0]]
    assert found[1][4:].tolist() == [[30.0, 40.25, 3.0, 0.0], [5.0, 6.0, 3.0, 0.0]]
    assert found[2][:, :2].tolist() == [[1.0, 2.0]]


def test_the_copy_lacks_rejected_pairs_and_those_of_images_left_out(
    tmp_path: Path, database: Path
) -> None:
    by_hand = ByHand(rejected=(("b.jpg", "old/a.jpg"),), left_out=("c.png",))
    by_hand.copy_database(database, tmp_path / "mapped.db")
    with open_database(tmp_path / "mapped.db") as copy:
        assert not len(copy.read_two_view_geometry_num_inliers()[0])
    with open_database(database) as original:
        assert len(original.read_two_view_geometry_num_inliers()[0]) == 3


def test_marks_are_triangulated_where_they_are_in_space() -> None:
    place = np.array([0.4, -0.3, 5.0])
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 500.0, 640, 480)
    camera.params = [500.0, 300.0, 250.0, 0.1]
    model.add_camera_with_trivial_rig(camera)
    for image_id, x in ((1, 0.0), (2, 1.0)):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.1 * x, 0.0]))
        image = pycolmap.Image(name=f"{image_id}", camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pose)
    marks = {i: np.array(model.images[i].project_point(place)) for i in (1, 2)}
    found = triangulated(model, marks)
    assert found is not None
    np.testing.assert_allclose(found, place, atol=1e-9)


def test_matches_below_a_painted_mask_are_left_out_and_verified_anew(
    tmp_path: Path,
) -> None:
    names = ["a.png", "b.png", "c.png"]
    write_scene(tmp_path / "all.db", names)
    (tmp_path / "masks").mkdir()
    mask = np.full((IMAGE_SIZE[1], IMAGE_SIZE[0]), 255, np.uint8)
    mask[:, : IMAGE_SIZE[0] // 2] = 0
    write_image(tmp_path / "masks" / "a.png.png", mask)
    by_hand = ByHand(masks_path=tmp_path / "masks")
    by_hand.copy_database(tmp_path / "all.db", tmp_path / "mapped.db")
    num_kept = {}
    with (
        open_database(tmp_path / "all.db") as before,
        open_database(tmp_path / "mapped.db") as after,
    ):
        ids = {image.name: image.image_id for image in before.read_all_images()}
        keypoints = before.read_keypoints(ids["a.png"])
        for first, second in (
            ("a.png", "b.png"),
            ("a.png", "c.png"),
            ("b.png", "c.png"),
        ):
            pair = (ids[first], ids[second])
            known = before.read_two_view_geometry(*pair).inlier_matches
            if first == "a.png":
                assert not after.exists_two_view_geometry(*pair)
                kept = after.read_matches(*pair)
                is_right = keypoints[known[:, 0], 0] >= IMAGE_SIZE[0] // 2
                assert {*map(tuple, kept)} == {*map(tuple, known[is_right])}
                num_kept[pair] = len(kept)
            else:
                now = after.read_two_view_geometry(*pair).inlier_matches
                assert np.array_equal(now, known)
    assert all(num_kept.values())
    digest = by_hand.digest()
    write_image(tmp_path / "masks" / "a.png.png", 255 - mask)
    assert by_hand.digest() != digest


def test_photographs_that_are_left_out_get_no_tie_points(
    tmp_path: Path, database: Path
) -> None:
    table = tmp_path / "marks.csv"
    table.write_text("p,a,1,2\np,b,3,4\np,c,5,6\n", encoding="utf-8")
    by_hand = ByHand(tie_points_path=table, left_out=("b.jpg",))
    found = by_hand.copy_database(database, tmp_path / "mapped.db")
    assert found["p"].keys() == {"old/a.jpg", "c.png"}


def test_what_is_said_differs_by_pairs_and_by_photographs_and_not_by_their_order() -> (
    None
):
    said = [
        ByHand(),
        ByHand(left_out=("a.jpg",)),
        ByHand(left_out=("b.jpg",)),
        ByHand(rejected=(("a.jpg", "b.jpg"),)),
        ByHand(rejected=(("a.jpg", "c.jpg"),)),
    ]
    assert len({one.digest() for one in said}) == len(said)
    both = ByHand(left_out=("a.jpg", "b.jpg"))
    assert both.digest() == ByHand(left_out=("b.jpg", "a.jpg")).digest()


def test_marks_whose_rays_meet_behind_the_cameras_have_no_position() -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", 800.0, 1000, 600
    )
    model.add_camera_with_trivial_rig(camera)
    for image_id, x in ((1, -1.0), (2, 1.0)):
        image = pycolmap.Image(f"{image_id}.jpg", np.zeros((1, 2)), 1, image_id)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.0, 0.0]))
        model.add_image_with_trivial_frame(image, pose)
    left, right = np.array([300.0, 300.0]), np.array([700.0, 300.0])
    assert triangulated(model, {1: left, 2: right}) is None
    assert triangulated(model, {1: right, 2: left}) == pytest.approx([0.0, 0.0, 4.0])
