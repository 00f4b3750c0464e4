"""How sure a model is of its photographs: right ones are sure, and each doubt has its cause."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import synthesize, write_images

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.geometry.parallax import mirrored_share
from colmap_affrect.mappers import reliability_features
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.camera_priors import EXIF_SIGMA, CameraPrior
from colmap_affrect.mappers.other_cameras import OtherPose
from colmap_affrect.mappers.pair_graph import VerifiedPair
from colmap_affrect.mappers.reliability import TERMS, confidence, score_images
from colmap_affrect.mappers.reliability_features import ReliabilityFeatures, features_of
from colmap_affrect.project.reasons import SENTENCES, Doubt, DoubtCode
from colmap_affrect.project.report import DOUBTFUL, SURE


def scene(tmp_path: Path, num_images: int = 5) -> tuple[MappedModel, MappingTask]:
    """A right model of images with a camera each that somebody knows, and its database."""
    path = tmp_path / "database.db"
    model = synthesize(path, seed=5, num_rigs=num_images, num_points3D=250)
    records = {
        image.camera_id: CameraRecord(
            (image.name,), "exif", image.camera.mean_focal_length()
        )
        for image in model.images.values()
    }
    return MappedModel(model), MappingTask(path, tmp_path, cameras=records)


def set_focal_length(task: MappingTask, camera_id: int, focal_px: float) -> None:
    """Write another focal length into the database."""
    with open_database(task.database_path) as database:
        camera = database.read_camera(camera_id)
        camera.params = [focal_px, *camera.params[1:]]
        database.update_camera(camera)


def last(mapped: MappedModel) -> pycolmap.Image:
    return mapped.reconstruction.images[max(mapped.reconstruction.reg_image_ids())]


@pytest.mark.parametrize("num_images", [3, 6])
def test_right_models_are_sure(tmp_path: Path, num_images: int) -> None:
    found = score_images(*scene(tmp_path, num_images))
    assert len(found) == num_images
    assert min(one.probability for one in found.values()) >= SURE


def test_image_that_contradicts_its_pairs_is_doubted_and_the_others_are_not(
    tmp_path: Path,
) -> None:
    mapped, task = scene(tmp_path)
    image = last(mapped)
    turn = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.1, 0.2, 0.05])), np.array([1.0, 2, 3])
    )
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    found = score_images(mapped, task)
    assert [name for name, one in found.items() if one.probability < DOUBTFUL] == [
        image.name
    ]
    features = features_of(mapped, task)[image.name]
    assert features.agreement < 0.2
    assert features.log_likelihood_ratio < 0.0


def test_an_image_from_the_same_viewpoint_does_not_agree_with_a_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third photograph is in a wrong place; the others are from one viewpoint."""
    mapped, task = scene(tmp_path, 3)
    image = last(mapped)
    turn = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.1, 0.2, 0.05])), np.array([1.0, 2, 3])
    )
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    first, second, _ = sorted(mapped.reconstruction.reg_image_ids())
    name = mapped.reconstruction.images[first].name
    assert features_of(mapped, task)[name].agreement > 0.4
    monkeypatch.setattr(
        reliability_features, "same_viewpoint_pairs", lambda *_: {(first, second)}
    )
    assert features_of(mapped, task)[name].agreement < 0.2


def test_what_no_pose_changes_is_found_once_for_a_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where many images leave a large model, it is scored as many times."""
    mapped, task = scene(tmp_path)
    found = list[float]()
    ratio_of = reliability_features.pure_rotation_ratio

    def counted(*arguments: Any) -> float:
        found.append(ratio_of(*arguments))
        return found[-1]

    monkeypatch.setattr(reliability_features, "pure_rotation_ratio", counted)
    first = features_of(mapped, task)
    num_found = len(found)
    again = features_of(mapped, task)
    assert len(found) == num_found > 0
    for name, one in first.items():
        assert one.pure_rotation_ratio == again[name].pure_rotation_ratio


def test_every_term_takes_from_the_probability_and_says_why(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    good = features_of(mapped, task)[last(mapped).name]
    bad = {
        "log-likelihood ratio": (
            replace(good, log_likelihood_ratio=-20.0),
            "disagree with this position",
        ),
        "agreement": (replace(good, agreement=0.1), "only 10% of the matches"),
        "three-view points": (
            replace(good, num_three_view_points=0),
            "none of its points is seen by two other",
        ),
        "focal observability": (
            replace(good, focal_growth=0.001),
            "any focal length fits",
        ),
        "parallax": (
            replace(good, pure_rotation_ratio=1.0),
            "only turned explains 100% of the matches",
        ),
        "mirrored copy": (
            replace(good, mirrored_original="c.jpg"),
            "mirrored copy of c.jpg",
        ),
        "focal spread": (
            replace(good, focal_spread=1.65),
            "are up to 1.65 times apart",
        ),
    }
    assert bad.keys() == TERMS.keys()
    for name, (features, text) in bad.items():
        assert TERMS[name].value(features) < TERMS[name].value(good)
        assert text in TERMS[name].reason(features).text()
        assert confidence(features).probability <= confidence(good).probability


GOOD = ReliabilityFeatures(
    log_likelihood_ratio=30.0,
    agreement=0.98,
    num_three_view_points=100,
    focal_growth=0.5,
    focal_px=1000.0,
    fitting_focal_px=0.0,
    pure_rotation_ratio=0.2,
    mirrored_original="",
    focal_spread=1.0,
    tie_point_log_odds=0.0,
    cut_pair="",
    num_cut_pair_inliers=0,
)


@pytest.mark.parametrize(("term", "values", "expected"), [
    ("log-likelihood ratio", {"log_likelihood_ratio": 6.0}, 1.10),
    ("log-likelihood ratio", {"log_likelihood_ratio": -6.0}, -1.10),
    ("three-view points", {"num_three_view_points": 100}, 4.62),
    ("three-view points", {"num_three_view_points": 5000}, 5.71),
    ("focal observability", {"focal_growth": 0.1}, -2.30),
    ("focal observability", {"focal_growth": 0.0}, -5.81),
    ("focal observability", {"focal_growth": 20.0}, 0.0),
    ("parallax", {"pure_rotation_ratio": 0.1}, -0.5),
    ("parallax", {"pure_rotation_ratio": 0.8}, -0.8),
    ("focal spread", {"focal_spread": 1.3}, -0.26),
    ("focal spread", {"focal_spread": 9.0}, -0.5),
])  # fmt: skip
def test_terms_are_those_that_the_weights_were_fitted_to(
    term: str, values: dict[str, float], expected: float
) -> None:
    features = replace(GOOD, **values)
    assert TERMS[term].value(features) == pytest.approx(expected, abs=0.01)


def test_any_number_of_tie_points_has_a_probability() -> None:
    contradicted = confidence(replace(GOOD, tie_point_log_odds=-5000.0))
    confirmed = confidence(replace(GOOD, tie_point_log_odds=5000.0))
    assert contradicted.probability == 0.0
    assert confirmed.probability > confidence(GOOD).probability


def test_two_reasons_are_said_and_no_small_ones() -> None:
    doubted = replace(
        GOOD, log_likelihood_ratio=-20.0, agreement=0.2, mirrored_original="c.jpg"
    )
    assert len(confidence(doubted).reasons) == 2
    small = replace(GOOD, log_likelihood_ratio=-20.0, num_three_view_points=60)
    assert [doubt.code for doubt in confidence(small).reasons] == ["matches_disagree"]
    both = confidence(replace(small, num_three_view_points=3)).reasons
    assert [doubt.code for doubt in both] == [
        "matches_disagree",
        "few_three_view_points",
    ]


def test_a_cut_pair_counts_by_its_inliers() -> None:
    probabilities = []
    for num_inliers in (15, 35, 55, 100):
        features = replace(
            GOOD, cut_pair="a.jpg - b.jpg", num_cut_pair_inliers=num_inliers
        )
        probabilities.append(
            confidence(features).probability / confidence(GOOD).probability
        )
    assert probabilities == pytest.approx([0.12, 0.5, 0.88, 1.0], abs=0.01)


def test_uncertain_directions_take_as_much_as_they_miss_the_limit_of_right_poses() -> (
    None
):
    probabilities = []
    for sigma_deg in (0.0, 1.0, 3.0, 6.0, 60.0):
        features = replace(GOOD, direction_sigma_deg=sigma_deg)
        probabilities.append(
            confidence(features).probability / confidence(GOOD).probability
        )
    assert probabilities == pytest.approx([1.0, 1.0, 0.94, 0.5, 0.007], abs=0.005)
    at_one_place = confidence(replace(GOOD, direction_sigma_deg=6.0))
    assert at_one_place.reasons == (Doubt("near_others", {"sigma_deg": 6.0}),)
    assert at_one_place.gain < 0.1  # more matches do not help
    unclear = confidence(replace(GOOD, axis_turn_deg=6.0))
    assert unclear.probability == pytest.approx(at_one_place.probability)
    assert unclear.reasons == (Doubt("principal_point_open", {"turn_deg": 6.0}),)
    both = confidence(replace(GOOD, direction_sigma_deg=4.8, axis_turn_deg=3.6))
    assert both.probability == pytest.approx(at_one_place.probability)
    far_off = confidence(replace(GOOD, direction_sigma_deg=60.0))
    assert far_off.probability < 0.01
    assert far_off.of_evidence == pytest.approx(confidence(GOOD).probability)


NAMED = "the given focal length does not fit, 1000 px: 910 px does"


@pytest.mark.parametrize(
    ("pose", "share"),
    [
        (OtherPose(0.5, 1.0), 1.0),  # with other cameras it stands where it does
        (OtherPose(0.5, 6.0), 0.75),
        (OtherPose(0.5, 60.0), 0.5),
        (OtherPose(0.01, 60.0), 0.99),
        (OtherPose(1.0, 60.0), 0.007),
    ],
)
def test_other_cameras_take_as_much_as_they_are_likely_and_turn_a_pose(
    pose: OtherPose, share: float
) -> None:
    before = confidence(GOOD).probability
    shared = confidence(replace(GOOD, with_other_cameras=pose))
    given = confidence(replace(GOOD, with_free_focals=pose))
    assert shared.probability / before == pytest.approx(share, abs=0.01)
    assert given.probability == pytest.approx(shared.probability)
    differ = confidence(replace(GOOD, with_other_cameras=replace(pose, is_shared=True)))
    assert differ.probability == pytest.approx(shared.probability)
    named = confidence(replace(GOOD, with_free_focals=pose, fitting_focal_px=910.2))
    first = {one.reasons[0].text() for one in (shared, differ, given, named)}
    codes: tuple[DoubtCode, ...] = ("camera_shared", "cameras_differ", "focal_unknown")
    said = {SENTENCES[code].format(turn_deg=60.0) for code in codes} | {NAMED}
    assert (first == said) == (share <= 0.5)


def test_a_cut_pair_casts_doubt_on_the_smaller_of_two_components(
    tmp_path: Path,
) -> None:
    mapped, task = scene(tmp_path, 5)
    ids = sorted(mapped.reconstruction.reg_image_ids())
    with open_database(task.database_path) as database:
        for one, two in itertools.product(ids[:3], ids[3:]):
            if (one, two) == (ids[1], ids[4]):
                num = len(database.read_two_view_geometry(one, two).inlier_matches)
            else:
                database.delete_two_view_geometry(one, two)
    names = [mapped.reconstruction.images[i].name for i in ids]
    found = features_of(mapped, task)
    assert [bool(found[name].cut_pair) for name in names] == [False] * 3 + [True] * 2
    assert found[names[3]].cut_pair == f"{names[1]} - {names[4]}"
    assert found[names[3]].num_cut_pair_inliers == num
    alone, few = (
        confidence(replace(found[names[3]], num_cut_pair_inliers=num))
        for num in (200, 29)
    )
    assert few.probability < DOUBTFUL < alone.probability - 0.3
    edge = {"num_inliers": 29, "pair": f"{names[1]} - {names[4]}"}
    assert Doubt("tied_by_one_pair", edge) in few.reasons
    assert few.gain > 0.5


def test_camera_that_only_turned(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    first = mapped.reconstruction.images[min(mapped.reconstruction.reg_image_ids())]
    pose = first.cam_from_world()
    rng = np.random.default_rng(3)

    def turned(image: pycolmap.Image) -> np.ndarray:
        matrix = pycolmap.Rotation3d(rng.uniform(-0.15, 0.15, 3)).matrix()
        size = np.array([image.camera.width, image.camera.height])
        points = np.array([point.xy for point in image.points2D], np.float64)
        for index, point in enumerate(image.points2D):
            if point.has_point3D():
                ray = matrix @ (
                    pose * mapped.reconstruction.point3D(point.point3D_id).xyz
                )
                points[index] = 0.9 * size.max() * ray[:2] / ray[2] + size / 2
        return points

    assert (
        max(one.pure_rotation_ratio for one in features_of(mapped, task).values()) < 0.3
    )
    with open_database(task.database_path) as database:
        for image_id, image in mapped.reconstruction.images.items():
            database.update_keypoints(image_id, turned(image).astype(np.float32))
    assert (
        min(
            one.pure_rotation_ratio
            for one in features_of(mapped, replace(task, graphs={})).values()
        )
        > 0.9
    )


def test_only_focal_lengths_that_the_model_tells_are_compared(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    camera = last(mapped).camera
    camera.params[list(camera.focal_length_idxs())] *= 1.5
    growths = dict.fromkeys(mapped.reconstruction.cameras, 0.2)
    hardly_told = dict.fromkeys(mapped.reconstruction.cameras, 0.01)
    for growths_of_all, zoom in ((growths, 1.5), (hardly_told, 1.0)):
        found = features_of(mapped, task, growths_of_all)
        assert [one.focal_spread for one in found.values()] == pytest.approx([zoom] * 5)
    # Where it was found that its middle is elsewhere, nothing is wrong with a part.
    camera.params[list(camera.principal_point_idxs())] += 60.0
    found = features_of(mapped, task, growths)
    assert [one.focal_spread for one in found.values()] == pytest.approx([1.0] * 5)


def add_mirrored_copy(
    mapped: MappedModel, task: MappingTask, ids: tuple[int, int]
) -> None:
    """Let image ``ids[1]`` have the keypoints of a smaller mirrored copy of the other, too.

    Of its own only half stay right.
    """
    image, copy = (mapped.reconstruction.images[image_id] for image_id in ids)
    camera = copy.camera
    with open_database(task.database_path) as database:
        points = 0.75 * database.read_keypoints(image.image_id)[:, :2]
        camera.width, camera.height = (
            int(0.75 * camera.width),
            int(0.75 * camera.height),
        )
        database.update_camera(camera)
        points[:, 0] = camera.width - points[:, 0]
        old = database.read_keypoints(copy.image_id)[:, :2]
        old[int(0.55 * len(old)) :] += 40.0 * np.array([1.0, -0.6])
        database.update_keypoints(copy.image_id, np.vstack([old, points, old]))


def test_mirrored_copy_is_told_from_the_photograph(tmp_path: Path) -> None:
    mapped, task = scene(tmp_path)
    add_mirrored_copy(mapped, task, (4, 1))
    images = mapped.reconstruction.images
    features = features_of(mapped, task)
    originals = {
        name: of_image.mirrored_original for name, of_image in features.items()
    }
    assert originals.pop(images[1].name) == images[4].name
    assert set(originals.values()) == {""}


def test_the_original_of_a_mirrored_copy_is_the_one_that_photographs_without_copies_agree_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mirrored = [(1, 2), (4, 5)]
    monkeypatch.setattr(reliability_features, "_mirrored_pairs", lambda _: mirrored)
    num_matches = {(1, 3): 20, (2, 3): 10, (2, 4): 100, (3, 4): 10, (3, 5): 30}
    geometry = pycolmap.TwoViewGeometry()
    pairs = []
    for ids, num in num_matches.items():
        pairs.append(VerifiedPair(ids, np.zeros((num, 2), np.int64), geometry))
    context: Any = SimpleNamespace(
        pairs=pairs, agreements=dict.fromkeys(num_matches, 0.9)
    )
    originals = reliability_features._mirrored_originals(context)
    assert originals == {2: 1, 4: 5}


def test_dense_keypoints_are_no_mirrored_copies() -> None:
    rng = np.random.default_rng(2)
    size = (320, 240)
    smaller = (256, 192)
    few, many, others = (
        rng.uniform(0, size, (number, 2)) for number in (900, 12000, 12000)
    )
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


NUM_IMAGES = 5
STEP_DEG = 30.0
DISTANCE = 6.0
NOISE_PX = 0.3


def ring(folder: Path, views_per_point: int) -> tuple[MappedModel, MappingTask]:
    """Return a model of images around a cube that they all look at the middle of.

    Each point is seen by so many neighbours; keypoints have noise.
    """
    random = np.random.default_rng(4)
    camera = pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_RADIAL",
        width=640,
        height=480,
        params=[1500, 320, 240, 0],
    )
    record = CameraRecord(
        tuple(f"{number}.jpg" for number in range(NUM_IMAGES)), "guess", 1500.0
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    places = random.uniform(-0.7, 0.7, (600, 3))
    first = random.integers(0, NUM_IMAGES - views_per_point + 1, len(places))
    tracks = [pycolmap.Track() for _ in places]
    with open_database(folder / "database.db") as database:
        write_images(database, camera, record.names)
        for number in range(NUM_IMAGES):
            turn = pycolmap.Rotation3d(
                np.array([0.0, np.deg2rad(STEP_DEG * number), 0.0])
            )
            pose = pycolmap.Rigid3d(turn, np.array([0.0, 0.0, DISTANCE]))
            rows = np.flatnonzero(
                (first <= number) & (number < first + views_per_point)
            )
            pixels = np.array([camera.img_from_cam(pose * places[row]) for row in rows])
            pixels += random.normal(0.0, NOISE_PX, pixels.shape)
            image = pycolmap.Image(
                f"{number}.jpg", pixels, camera_id=1, image_id=number + 1
            )
            model.add_image_with_trivial_frame(image, pose)
            for index, row in enumerate(rows):
                tracks[row].add_element(number + 1, index)
    for place, track in zip(places, tracks, strict=True):
        model.add_point3D(place, track)
    return MappedModel(model), MappingTask(
        folder / "database.db", None, cameras={1: record}
    )


def test_points_of_many_images_tell_focal_lengths_that_nobody_knows(
    tmp_path: Path,
) -> None:
    growths = {}
    for views_per_point in (2, 4):
        folder = tmp_path / str(views_per_point)
        folder.mkdir()
        mapped, task = ring(folder, views_per_point)
        growths[views_per_point] = features_of(mapped, task)["2.jpg"].focal_growth
        known = replace(task, cameras={1: replace(task.cameras[1], source="exif")})
        assert features_of(mapped, known)["2.jpg"].focal_growth == 1.0
    assert growths[2] < 0.07 < growths[4]


@pytest.mark.parametrize("factor", [1.0, 0.8, 1.3])
def test_given_focal_lengths_are_doubted_where_the_points_say_others(
    tmp_path: Path, factor: float
) -> None:
    mapped, task = ring(tmp_path, 5)
    camera = mapped.reconstruction.cameras[1]
    camera.params = [factor * 1500.0, 320, 240, 0]
    record = replace(
        task.cameras[1],
        source="given",
        focal_px=factor * 1500.0,
        given=("focal", "distortion"),
    )
    set_focal_length(task, 1, record.focal_px)
    found = features_of(mapped, replace(task, cameras={1: record}))
    fitting = {one.fitting_focal_px for one in found.values()}
    assert len(fitting) == 1
    assert (
        fitting == {0.0}
        if factor == 1.0
        else min(fitting) == pytest.approx(1500.0, rel=0.05)
    )


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_distortion_does_not_hide_that_a_given_focal_length_is_wrong(
    tmp_path: Path, factor: float
) -> None:
    mapped, task = ring(tmp_path, 5)
    focal_px = factor * 1500.0
    mapped.reconstruction.cameras[1].params = [focal_px, 320, 240, 0]
    refining = pycolmap.BundleAdjustmentOptions()
    Adjuster({1: CameraPrior(focal_px, 0.0)}, 0.7, refining).adjust(
        mapped.reconstruction, 300
    )
    record = replace(
        task.cameras[1], source="given", focal_px=focal_px, given=("focal",)
    )
    set_focal_length(task, 1, focal_px)
    found = features_of(mapped, replace(task, cameras={1: record}))[
        "2.jpg"
    ].fitting_focal_px
    assert found == 0.0 if factor == 1.0 else found == pytest.approx(1500.0, rel=0.05)


def test_a_focal_length_that_has_left_what_exif_says_costs_by_its_deviation(
    tmp_path: Path,
) -> None:
    mapped, task = scene(tmp_path)
    name = last(mapped).name
    before = features_of(mapped, task)[name].log_likelihood_ratio
    camera = last(mapped).camera
    set_focal_length(task, camera.camera_id, 1.1 * camera.mean_focal_length())
    moved = features_of(mapped, replace(task, graphs={}))[name].log_likelihood_ratio
    expected = 0.5 * (math.log(1.1) / EXIF_SIGMA) ** 2
    assert before - moved == pytest.approx(expected, rel=1e-3)
