"""How sure a model is of its photographs: right ones are sure, and each doubt has its cause."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize, write_images

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.geometry.parallax import mirrored_share
from colmap_affrect.mappers.adjustment import Adjuster, FocalPrior
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.reliability import TERMS, judge, judged, measure
from colmap_affrect.project.report import DOUBTFUL, SURE


def scene(tmp_path: Path, num_images: int = 5) -> tuple[MappedModel, MappingTask]:
    """A right model of images with a camera each that somebody knows, and its database."""
    path = tmp_path / "database.db"
    model = synthesize(path, seed=5, num_rigs=num_images, num_points3D=250)
    records = {
        image.camera_id: CameraRecord((image.name,), "exif", image.camera.mean_focal_length())
        for image in model.images.values()
    }
    return MappedModel(model), MappingTask(path, tmp_path, cameras=records)


def last(mapped: MappedModel) -> pycolmap.Image:
    return mapped.reconstruction.images[max(mapped.reconstruction.reg_image_ids())]


@pytest.mark.parametrize("num_images", [3, 6])
def test_right_models_are_sure(tmp_path: Path, num_images: int) -> None:
    found = judge(*scene(tmp_path, num_images))
    assert len(found) == num_images
    assert min(one.probability for one in found.values()) >= SURE


def test_image_that_contradicts_its_pairs_is_doubted_and_the_others_are_not(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    image = last(mapped)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.05])), np.array([1.0, 2, 3]))
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    found = judge(mapped, task)
    assert [name for name, one in found.items() if one.probability < DOUBTFUL] == [image.name]
    measures = measure(mapped, task)[image.name]
    assert measures.agreement < 0.2
    assert measures.evidence < 0.0


def test_every_term_takes_from_the_probability_and_says_why(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    good = measure(mapped, task)[last(mapped).name]
    bad = {
        "evidence": (replace(good, evidence=-20.0), "speak against"),
        "agreement": (replace(good, agreement=0.1), "only 10% of the matches"),
        "points of three": (replace(good, num_three=0), "only 0 of its points"),
        "focal length": (replace(good, focal_growth=0.001), "any focal length fits"),
        "given focal length": (
            replace(good, focal_px=720.4, fitting_px=910.2),
            "the given focal length does not fit, 720 px: 910 px does",
        ),
        "parallax": (replace(good, turned=1.0), "only turned explains 100% of the matches"),
        "original": (replace(good, original="c.jpg"), "mirrored copy of c.jpg"),
        "one lens": (replace(good, zoom=1.65), "are up to 1.65 times apart"),
    }
    assert bad.keys() == TERMS.keys()
    for name, (measures, text) in bad.items():
        assert TERMS[name].value(measures) < TERMS[name].value(good)
        assert text in TERMS[name].reason(measures)
        assert judged(measures).probability <= judged(good).probability


def test_parts_that_one_pair_ties(tmp_path: Path) -> None:
    """The smaller part hangs on the larger one, and not the other way round."""
    mapped, task = scene(tmp_path, 5)
    ids = sorted(mapped.reconstruction.reg_image_ids())
    with open_database(task.database_path) as database:
        for one, two in itertools.product(ids[:3], ids[3:]):
            if (one, two) == (ids[1], ids[4]):
                num = len(database.read_two_view_geometry(one, two).inlier_matches)
            else:
                database.delete_two_view_geometry(one, two)
    names = [mapped.reconstruction.images[i].name for i in ids]
    found = measure(mapped, task)
    assert [bool(found[name].cut) for name in names] == [False] * 3 + [True] * 2
    assert found[names[3]].cut == f"{names[1]} - {names[4]}"
    assert found[names[3]].num_cut == num
    alone, few = (judged(replace(found[names[3]], num_cut=num)) for num in (200, 29))
    assert few.probability < DOUBTFUL < alone.probability - 0.3
    assert f"hangs on the 29 inliers of {names[1]} - {names[4]} alone" in few.reason
    assert few.gain > 0.5


def test_camera_that_only_turned(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    first = mapped.reconstruction.images[min(mapped.reconstruction.reg_image_ids())]
    pose, rng = first.cam_from_world(), np.random.default_rng(3)

    def turned(image: pycolmap.Image) -> np.ndarray:
        matrix = pycolmap.Rotation3d(rng.uniform(-0.15, 0.15, 3)).matrix()
        size = np.array([image.camera.width, image.camera.height])
        points = np.array([point.xy for point in image.points2D], np.float64)
        for index, point in enumerate(image.points2D):
            if point.has_point3D():
                ray = matrix @ (pose * mapped.reconstruction.point3D(point.point3D_id).xyz)
                points[index] = 0.9 * size.max() * ray[:2] / ray[2] + size / 2
        return points

    assert max(one.turned for one in measure(mapped, task).values()) < 0.3
    with open_database(task.database_path) as database:
        for image_id, image in mapped.reconstruction.images.items():
            database.update_keypoints(image_id, turned(image).astype(np.float32))
    assert min(one.turned for one in measure(mapped, replace(task)).values()) > 0.9


def test_only_focal_lengths_that_the_model_tells_are_compared(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    camera = last(mapped).camera
    camera.params[list(camera.focal_length_idxs())] *= 1.5
    for growth, zoom in ((0.2, 1.5), (0.01, 1.0)):
        growths = dict.fromkeys(mapped.reconstruction.cameras, growth)
        found = measure(mapped, task, growths)
        assert [one.zoom for one in found.values()] == pytest.approx([zoom] * 5)


def add_mirrored_copy(mapped: MappedModel, task: MappingTask, ids: tuple[int, int]) -> None:
    """Let image ``ids[1]`` have the keypoints of a smaller mirrored copy of the other, too.

    Of its own only half stay right.
    """
    image, copy = (mapped.reconstruction.images[image_id] for image_id in ids)
    camera = copy.camera
    with open_database(task.database_path) as database:
        points = 0.75 * database.read_keypoints(image.image_id)[:, :2]
        camera.width, camera.height = int(0.75 * camera.width), int(0.75 * camera.height)
        database.update_camera(camera)
        points[:, 0] = camera.width - points[:, 0]
        old = database.read_keypoints(copy.image_id)[:, :2]
        old[int(0.55 * len(old)) :] += 40.0 * np.array([1.0, -0.6])
        database.update_keypoints(copy.image_id, np.vstack([old, points, old]))


def test_mirrored_copy_is_told_from_the_photograph(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    add_mirrored_copy(mapped, task, (4, 1))
    images = mapped.reconstruction.images
    originals = {name: one.original for name, one in measure(mapped, task).items() if one.original}
    assert originals == {images[1].name: images[4].name}


def test_dense_keypoints_are_no_mirrored_copies() -> None:
    rng, size, smaller = np.random.default_rng(2), (320, 240), (256, 192)
    few, many, others = (rng.uniform(0, size, (number, 2)) for number in (900, 12000, 12000))
    assert mirrored_share(many, others, (size, size)) < 0.3
    assert mirrored_share(many, many, (size, size)) < 0.3
    for axis in (0, 1):
        copies = [points.copy() for points in (few, many)]
        for points in copies:
            points[:, axis] = size[axis] - points[:, axis]
        assert mirrored_share(few, copies[0], (size, size)) > 0.9
        assert mirrored_share(many, copies[1], (size, size)) > 0.9
        fewer = 0.8 * copies[0][:500]
        assert mirrored_share(few, fewer, (size, smaller)) > 0.9
        assert mirrored_share(fewer, few, (smaller, size)) > 0.9


NUM_IMAGES, STEP_DEG = 5, 30.0
DISTANCE, NOISE_PX = 6.0, 0.3


def ring(folder: Path, views_per_point: int) -> tuple[MappedModel, MappingTask]:
    """Return a model of images around a cube that they all look at the middle of.

    Each point is seen by so many neighbours; keypoints have noise.
    """
    random = np.random.default_rng(4)
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[1500, 320, 240, 0]
    )
    record = CameraRecord(tuple(f"{number}.jpg" for number in range(NUM_IMAGES)), "guess", 1500.0)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    places = random.uniform(-0.7, 0.7, (600, 3))
    first = random.integers(0, NUM_IMAGES - views_per_point + 1, len(places))
    tracks = [pycolmap.Track() for _ in places]
    with open_database(folder / "database.db") as database:
        write_images(database, camera, record.names)
        for number in range(NUM_IMAGES):
            turn = pycolmap.Rotation3d(np.array([0.0, np.deg2rad(STEP_DEG * number), 0.0]))
            pose = pycolmap.Rigid3d(turn, np.array([0.0, 0.0, DISTANCE]))
            rows = np.flatnonzero((first <= number) & (number < first + views_per_point))
            pixels = np.array([camera.img_from_cam(pose * places[row]) for row in rows])
            pixels += random.normal(0.0, NOISE_PX, pixels.shape)
            image = pycolmap.Image(f"{number}.jpg", pixels, camera_id=1, image_id=number + 1)
            model.add_image_with_trivial_frame(image, pose)
            for index, row in enumerate(rows):
                tracks[row].add_element(number + 1, index)
    for place, track in zip(places, tracks, strict=True):
        model.add_point3D(place, track)
    return MappedModel(model), MappingTask(folder / "database.db", None, cameras={1: record})


def test_points_of_many_images_tell_focal_lengths_that_nobody_knows(tmp_path: Path) -> None:
    growths = {}
    for views_per_point in (2, 4):
        folder = tmp_path / str(views_per_point)
        folder.mkdir()
        mapped, task = ring(folder, views_per_point)
        growths[views_per_point] = measure(mapped, task)["2.jpg"].focal_growth
        known = replace(task, cameras={1: replace(task.cameras[1], source="exif")})
        assert measure(mapped, known)["2.jpg"].focal_growth == 1.0
    assert growths[2] < 0.07 < growths[4]


@pytest.mark.parametrize("factor", [1.0, 0.8, 1.3])
def test_given_focal_lengths_are_doubted_where_the_points_say_others(
    tmp_path: Path, factor: float
) -> None:
    mapped, task = ring(tmp_path, 5)
    camera = mapped.reconstruction.cameras[1]
    camera.params = [factor * 1500.0, 320, 240, 0]
    record = replace(
        task.cameras[1], source="given", focal_px=factor * 1500.0, given=("focal", "distortion")
    )
    found = measure(mapped, replace(task, cameras={1: record}))
    fitting = {one.fitting_px for one in found.values()}
    assert len(fitting) == 1
    assert fitting == {0.0} if factor == 1.0 else min(fitting) == pytest.approx(1500.0, rel=0.05)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_distortion_does_not_hide_that_a_given_focal_length_is_wrong(
    tmp_path: Path, factor: float
) -> None:
    mapped, task = ring(tmp_path, 5)
    focal_px = factor * 1500.0
    mapped.reconstruction.cameras[1].params = [focal_px, 320, 240, 0]
    refining = pycolmap.BundleAdjustmentOptions()
    Adjuster({1: FocalPrior(focal_px, 0.0)}, 0.7, refining).adjust(mapped.reconstruction, 300)
    record = replace(task.cameras[1], source="given", focal_px=focal_px, given=("focal",))
    found = measure(mapped, replace(task, cameras={1: record}))["2.jpg"].fitting_px
    assert found == 0.0 if factor == 1.0 else found == pytest.approx(1500.0, rel=0.05)
