"""What cannot be trusted in a model: right ones are not doubted, and each doubt has its cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import inlier_matches
from colmap_affrect.geometry.parallax import mirrored_share
from colmap_affrect.mappers.arrivals import arrivals
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.mappers.doubts import find_doubts, without_impossible
from colmap_affrect.mappers.pair_graph import PairGraph, VerifiedPair
from colmap_affrect.project.report import Arrival


def scene(tmp_path: Path, num_images: int = 4) -> tuple[MappedModel, MappingTask]:
    """A right model of images with a camera each, and its database."""
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=num_images, num_frames_per_rig=1, num_points3D=150
    )
    path = tmp_path / "database.db"
    with open_database(path) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return MappedModel(model), MappingTask(path, tmp_path)


def last(model: MappedModel) -> pycolmap.Image:
    return model.reconstruction.images[max(model.reconstruction.reg_image_ids())]


def keep_observations(model: MappedModel, image: pycolmap.Image, number: int) -> None:
    seen = [i for i, point in enumerate(image.points2D) if point.has_point3D()]
    for index in seen[number:]:
        model.reconstruction.delete_observation(image.image_id, index)


@pytest.mark.parametrize("num_images", [2, 3, 5])
def test_right_models_are_not_doubted(tmp_path: Path, num_images: int) -> None:
    model, task = scene(tmp_path, num_images)
    doubts = find_doubts(model, task)
    assert (doubts.images, doubts.model, doubts.impossible) == ({}, (), ())
    kept = without_impossible(model, task)
    assert kept is not None
    assert (kept.reconstruction.num_reg_images(), kept.taken_out) == (num_images, {})


@pytest.mark.parametrize(
    ("focal", "distortion", "text", "impossible"),
    [
        (12.0, 0.0, "focal length is 12288 px, a view of 4.77 degrees", False),
        (500.0, 0.0, "focal length is 512000 px, a view of 0.115 degrees", True),
        (0.2, 0.0, "focal length is 205 px, a view of 136 degrees", False),
        (1.2, 1.5, "distortion", False),
        (1.2, -15.0, "distortion", True),
    ],
)
def test_cameras_that_no_lens_has(
    tmp_path: Path, focal: float, distortion: float, text: str, *, impossible: bool
) -> None:
    model, task = scene(tmp_path)
    image = last(model)
    camera = image.camera
    camera.focal_length = focal * max(camera.width, camera.height)
    camera.params = np.array([*camera.params[:3], distortion])
    doubts = find_doubts(model, task)
    assert text in doubts.images[image.name]
    assert (image.name in doubts.impossible) >= impossible
    given = task_with_given_cameras(task.database_path)
    assert text not in find_doubts(model, given).images.get(image.name, "")


@pytest.mark.parametrize(
    ("number", "doubtful", "impossible"), [(30, 0, 0), (29, 1, 0), (8, 1, 0), (7, 1, 1)]
)
def test_images_that_few_points_hold(
    tmp_path: Path, number: int, doubtful: int, impossible: int
) -> None:
    model, task = scene(tmp_path)
    image = last(model)
    keep_observations(model, image, number)
    doubts = find_doubts(model, task)
    told = {image.name: f"held by only {number} points"}
    assert doubts.images == (told if doubtful else {})
    assert len(doubts.impossible) == impossible


def test_image_that_contradicts_its_pairs_leaves_and_the_others_stay(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    image = last(model)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2, 0.05])), np.array([1.0, 2, 3]))
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    kept = without_impossible(model, task)
    assert kept is not None
    assert list(kept.taken_out) == [image.name]
    assert "of the matches of verified pairs agree with the pose" in kept.taken_out[image.name]
    assert kept.reconstruction.num_reg_images() == 3
    assert find_doubts(kept, task).images == {}


def hang_on_one_pair(task: MappingTask, part: set[int], share_wrong: float) -> tuple[int, int]:
    """Leave one pair between some images and the others, of whose matches some are wrong."""
    between = [
        ids for ids in inlier_matches(task.database_path, 1) if len(part.intersection(ids)) == 1
    ]
    with open_database(task.database_path) as database:
        for ids in between[1:]:
            database.delete_two_view_geometry(*ids)
        geometry = database.read_two_view_geometry(*between[0])
        matches = np.array(geometry.inlier_matches)
        num = round(share_wrong * len(matches))
        matches[:num, 1] = np.roll(matches[:num, 1], 5)
        geometry.inlier_matches = matches
        database.update_two_view_geometry(*between[0], geometry)
    return between[0]


@pytest.mark.parametrize(
    ("num_images", "share_wrong", "num_doubted"),
    [(5, 0.25, 2), (5, 0.05, 0), (4, 0.25, 4), (5, 0.6, 2), (5, 0.9, 2)],
)
def test_images_that_one_pair_alone_ties_to_the_others(
    tmp_path: Path, num_images: int, share_wrong: float, num_doubted: int
) -> None:
    model, task = scene(tmp_path, num_images)
    names = {i: model.reconstruction.images[i].name for i in model.reconstruction.reg_image_ids()}
    part = set(sorted(names)[-2:])
    ids = hang_on_one_pair(task, part, share_wrong)
    found = find_doubts(model, task).images
    doubted = part if num_doubted == 2 else set(names) if num_doubted else set()
    assert set(found) == {names[i] for i in doubted}
    expected = f"hangs on the pair {names[ids[0]]} and {names[ids[1]]} alone, of whose inliers only"
    assert all(expected in why for why in found.values())


def test_parts_that_weak_pairs_tie_beside_the_strongest_do_not_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graph has the strongest pairs of each image only; what it leaves out counts here."""
    model, task = scene(tmp_path, 5)
    part = set(sorted(model.reconstruction.reg_image_ids())[-2:])
    hang_on_one_pair(task, part, 0.25)
    graph = PairGraph.read(task.database_path)
    between = [pair.ids for pair in graph.pairs if len(part.intersection(pair.ids)) == 1]
    weak = next(i for i in graph.names if i not in part and i not in between[0])
    more = replace(graph.pairs[0], ids=(weak, max(part)))
    for of_weak, num_doubted in (((), 2), ((more,), 0)):
        changed = replace(graph, weak=of_weak)
        monkeypatch.setattr("colmap_affrect.mappers.doubts.graph_of", lambda _, g=changed: g)
        assert len(find_doubts(model, task).images) == num_doubted
    monkeypatch.setattr("colmap_affrect.mappers.pair_graph.MAX_PAIRS_OF_IMAGE", 1)
    strongest = PairGraph.read(task.database_path)
    assert strongest.weak
    assert len(strongest.weak) + len(strongest.pairs) == len(graph.pairs)


def test_images_that_several_pairs_contradict_hang_on_none(tmp_path: Path) -> None:
    model, task = scene(tmp_path, 6)
    part = set(sorted(model.reconstruction.reg_image_ids())[-2:])
    between = [
        ids for ids in inlier_matches(task.database_path, 1) if len(part.intersection(ids)) == 1
    ]
    with open_database(task.database_path) as database:
        for ids in between[:2]:
            geometry = database.read_two_view_geometry(*ids)
            matches = np.array(geometry.inlier_matches)
            matches[:, 1] = np.roll(matches[:, 1], 5)
            geometry.inlier_matches = matches
            database.update_two_view_geometry(*ids, geometry)
        for ids in between[2:]:
            database.delete_two_view_geometry(*ids)
    found = find_doubts(model, task).images
    assert set(found) >= {model.reconstruction.images[i].name for i in part}
    why = "none of the 2 pairs that tie it to the others agrees well"
    assert all(why in found[model.reconstruction.images[i].name] for i in part)


def test_guided_matches_of_a_pair_do_not_tell_whether_it_ties_images_well(tmp_path: Path) -> None:
    """Neither for nor against: guided ones are where the geometry wants them, or on repetitions."""
    model, task = scene(tmp_path, 5)
    part = set(sorted(model.reconstruction.reg_image_ids())[-2:])
    ids = hang_on_one_pair(task, part, 0.25)
    matches = inlier_matches(task.database_path, 1)[ids]
    wrong = round(0.25 * len(matches))
    assert find_doubts(model, replace(task, guided={ids: matches[wrong:]})).images.keys()
    assert find_doubts(model, replace(task, guided={ids: matches[:wrong]})).images == {}
    assert find_doubts(model, replace(task, guided={ids: matches})).images.keys()


def test_agreement_of_a_pair_is_measured_once_however_many_images_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, task = scene(tmp_path, 6)
    images = [model.reconstruction.images[i] for i in sorted(model.reconstruction.reg_image_ids())]
    for number, image in enumerate(images[4:], 1):
        turn = pycolmap.Rotation3d(0.1 * number * np.array([1.0, 2.0, 0.5]))
        wrong = pycolmap.Rigid3d(turn, np.array([1.0, 2.0, 3.0])) * image.cam_from_world()
        image.frame.set_cam_from_world(image.camera_id, wrong)
    measured = []

    def agreement(graph: PairGraph, pair: VerifiedPair, *given: object) -> float:
        measured.append(pair.ids)
        return agreement_of(graph, pair, *given)

    agreement_of = PairGraph.agreement
    monkeypatch.setattr(PairGraph, "agreement", agreement)
    kept = without_impossible(model, task)
    assert kept is not None
    assert sorted(kept.taken_out) == [image.name for image in images[4:]]
    assert len(measured) == len(set(measured)) > 10


def test_nothing_is_left_of_a_pair_that_loses_an_image(tmp_path: Path) -> None:
    model, task = scene(tmp_path, 2)
    keep_observations(model, last(model), 3)
    assert without_impossible(model, task) is None


def test_two_of_more_photographs_are_no_model(tmp_path: Path) -> None:
    model, task = scene(tmp_path, 3)
    model.reconstruction.deregister_frame(last(model).frame_id)
    assert find_doubts(model, task).model == (
        "only 2 of 3 photographs, which no third one confirms",
    )


def write_keypoints(model: MappedModel, task: MappingTask, points_of: object) -> None:
    """Give each image other keypoints, of the same number."""
    with open_database(task.database_path) as database:
        for image_id in sorted(model.reconstruction.reg_image_ids()):
            points = points_of(model.reconstruction.images[image_id])
            database.update_keypoints(image_id, points.astype(np.float32))


def mismatch_one_pair(task: MappingTask, num: int) -> None:
    """Let a few matches of one pair be the only ones, and wrong."""
    ids = min(inlier_matches(task.database_path, 1))
    with open_database(task.database_path) as database:
        geometry = database.read_two_view_geometry(*ids)
        matches = np.array(geometry.inlier_matches)
        matches[:, 1] = np.roll(matches[:, 1], 7)
        geometry.inlier_matches = matches[:num]
        database.update_two_view_geometry(*ids, geometry)


@pytest.mark.parametrize("has_wrong_pair", [False, True])
def test_camera_that_only_turned(tmp_path: Path, *, has_wrong_pair: bool) -> None:
    model, task = scene(tmp_path)
    if has_wrong_pair:
        mismatch_one_pair(task, 20)
    first = model.reconstruction.images[min(model.reconstruction.reg_image_ids())]
    pose, rng = first.cam_from_world(), np.random.default_rng(3)

    def turned(image: pycolmap.Image) -> np.ndarray:
        matrix = pycolmap.Rotation3d(rng.uniform(-0.15, 0.15, 3)).matrix()
        size = np.array([image.camera.width, image.camera.height])
        points = np.array([point.xy for point in image.points2D], np.float64)
        for index, point in enumerate(image.points2D):
            if point.has_point3D():
                ray = matrix @ (pose * model.reconstruction.point3D(point.point3D_id).xyz)
                points[index] = 0.9 * size.max() * ray[:2] / ray[2] + size / 2
        return points

    write_keypoints(model, task, turned)
    (doubt,) = find_doubts(model, task).model
    assert doubt.startswith("no parallax: the camera only turned")


def add_mirrored_copy(
    model: MappedModel, task: MappingTask, ids: tuple[int, int], share_right: float = 1.0
) -> list[str]:
    """Let image ``ids[1]`` have the keypoints of a smaller mirrored copy of the other, too.

    Of its own only a share stays right. Returns the names of both.
    """
    image, copy = (model.reconstruction.images[image_id] for image_id in ids)
    camera = copy.camera
    with open_database(task.database_path) as database:
        points = 0.75 * database.read_keypoints(image.image_id)[:, :2]
        camera.width, camera.height = int(0.75 * camera.width), int(0.75 * camera.height)
        database.update_camera(camera)
        points[:, 0] = camera.width - points[:, 0]
        old = database.read_keypoints(copy.image_id)[:, :2]
        old[int(share_right * len(old)) :] += 40.0 * np.array([1.0, -0.6])
        database.update_keypoints(copy.image_id, np.vstack([old, points, old]))
    return [image.name, copy.name]


def test_mirrored_copies_that_the_others_support_alike(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    names = " and ".join(sorted(add_mirrored_copy(model, task, (4, 1))))
    doubts = find_doubts(model, task)
    assert doubts.model == (f"{names} are mirrored copies of one photograph",)
    assert doubts.impossible == ()


def test_mirrored_copy_leaves_and_the_photograph_stays(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    photograph, copy = add_mirrored_copy(model, task, (4, 1), share_right=0.55)
    kept = without_impossible(model, task)
    assert kept is not None
    assert list(kept.taken_out) == [copy]
    assert f"mirrored copy of {photograph}" in kept.taken_out[copy]
    doubts = find_doubts(kept, task)
    assert (doubts.images, doubts.model) == ({}, ())


def test_copies_of_a_set_that_is_mirrored_as_a_whole_do_not_tell_of_each_other(
    tmp_path: Path,
) -> None:
    model, task = scene(tmp_path)
    add_mirrored_copy(model, task, (4, 1), share_right=0.55)
    add_mirrored_copy(model, task, (3, 2))
    doubts = find_doubts(model, task)
    assert doubts.impossible == ()
    assert any("mirrored copies" in text for text in doubts.model)


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


def test_views_from_nearly_one_place(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    for image_id in model.reconstruction.reg_image_ids():
        image = model.reconstruction.images[image_id]
        pose, center = image.cam_from_world(), image.projection_center()
        far = np.array([40.0, -30, 20]) + 0.01 * center
        rotation = pose.rotation
        image.frame.set_cam_from_world(
            image.camera_id, pycolmap.Rigid3d(rotation, -(rotation.matrix() @ far))
        )
    assert any(text.startswith("hardly any parallax") for text in find_doubts(model, task).model)


def move_near(images: list[pycolmap.Image], share: float) -> None:
    """Bring cameras towards the first of them, all but this share of the way."""
    center = images[0].projection_center()
    for image in images[1:]:
        rotation = image.cam_from_world().rotation
        near = center + share * (image.projection_center() - center)
        pose = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ near))
        image.frame.set_cam_from_world(image.camera_id, pose)


@pytest.mark.parametrize(("share", "num_doubted"), [(0.001, 4), (0.3, 0)])
def test_images_of_nearly_one_place(tmp_path: Path, share: float, num_doubted: int) -> None:
    model, task = scene(tmp_path, 6)
    images = sorted(
        (model.reconstruction.images[i] for i in model.reconstruction.reg_image_ids()),
        key=lambda image: image.name,
    )
    move_near(images[:4], share)
    reasons = find_doubts(model, task).images
    doubted = [name for name, text in reasons.items() if "nearly the same place as" in text]
    assert doubted == [image.name for image in images[:num_doubted]]


@pytest.mark.parametrize(("num_beside", "is_doubted"), [(0, True), (1, True), (2, False)])
def test_image_that_others_see_from_the_other_side(
    tmp_path: Path, num_beside: int, *, is_doubted: bool
) -> None:
    model, task = scene(tmp_path, 6)
    reconstruction = model.reconstruction
    images = [reconstruction.images[i] for i in sorted(reconstruction.reg_image_ids())]
    middle = np.mean([point.xyz for point in reconstruction.points3D.values()], axis=0)
    for number, image in enumerate(images):
        is_beside = number >= len(images) - 1 - num_beside
        far = np.array([0.3 * number, 0.0, 60.0 if is_beside else -60.0])
        rotation = image.cam_from_world().rotation
        center = middle + far
        pose = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ center))
        image.frame.set_cam_from_world(image.camera_id, pose)
        if is_beside and image is not images[-1]:
            keep_observations(model, image, 40)
    reason = find_doubts(model, task).images.get(images[-1].name, "")
    assert ("most points are seen from directions 1" in reason) == is_doubted


def test_images_whose_points_do_not_tell_their_focal_length(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    name = last(model).name
    doubts = find_doubts(model, task, (name,))
    assert list(doubts.images) == [name]
    assert "any focal length fits" in doubts.images[name]
    assert doubts.impossible == ()


def test_given_focal_length_that_does_not_fit(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    image = last(model)
    record = CameraRecord((image.name,), "given", 720.4, given=("focal",))
    given = replace(task, cameras={image.camera_id: record})
    doubts = find_doubts(model, given, (), {image.name: 910.2})
    text = "the given focal length does not fit, 720 px: 910 px does"
    assert (doubts.images, doubts.impossible) == ({image.name: text}, ())


def test_tracks_of_two_views_tie_nothing_unless_images_are_bridged(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    for point_id in sorted(model.reconstruction.point3D_ids()):
        for element in list(model.reconstruction.point3D(point_id).track.elements)[2:]:
            model.reconstruction.delete_observation(element.image_id, element.point2D_idx)
    text = "only 0 points are seen by three photographs"
    assert text in find_doubts(model, task).model
    assert text not in find_doubts(MappedModel(model.reconstruction, BRIDGES), task).model


BRIDGES = (Bridge(("camera000001_frame000001.png", "b"), ("b",), 32, 36, 0.031),)


@pytest.mark.parametrize(
    ("bridge", "text"),
    [
        ((32, 36, 0.03), None),
        ((32, 36, 0.11), "distance known to +-11% only"),
        ((32, 36, float("nan")), "distance known to"),
        ((11, 39, 0.03), "only 11 of 39 depths agree"),
    ],
)
def test_bridges_of_uncertain_scale(
    tmp_path: Path, bridge: tuple[int, int, float], text: str | None
) -> None:
    model, task = scene(tmp_path)
    name = last(model).name
    bridged = MappedModel(model.reconstruction, (Bridge(("a", name), (name,), *bridge),))
    doubts = find_doubts(bridged, task)
    assert list(doubts.images) == ([name] if text else [])
    assert text is None or text in doubts.images[name]
    assert doubts.impossible == ()


def test_how_images_came_in(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    name = last(model).name
    bridge = Bridge(("a.jpg", name), (name,), 32, 36, 0.031)
    found = arrivals(MappedModel(model.reconstruction, (bridge,)), task)
    assert found.pop(name) == Arrival("bridged", "a.jpg", 32, 36, 0.031)
    assert set(found.values()) == {Arrival("tracks")}
    assert Arrival("tracks").to_mapping() == {"how": "tracks"}


def test_image_tied_by_guided_matches_only(tmp_path: Path) -> None:
    model, task = scene(tmp_path)
    image = last(model)
    pairs = inlier_matches(task.database_path, 1)
    guided = {ids: matches for ids, matches in pairs.items() if image.image_id in ids}
    found = arrivals(model, MappingTask(task.database_path, tmp_path, guided=guided))
    assert [name for name, item in found.items() if item.how == "guided"] == [image.name]
    few = {ids: matches[:5] for ids, matches in guided.items()}
    found = arrivals(model, MappingTask(task.database_path, tmp_path, guided=few))
    assert {item.how for item in found.values()} == {"tracks"}
