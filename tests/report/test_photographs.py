"""What a report says of each photograph, and what the page has of its view."""

from __future__ import annotations

import base64
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_run import MORE, NAMES, make_run_page, small_report

from colmap_affrect.colmap import pycolmap
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import (
    ModelReader,
    Observations,
    registered_images,
)
from colmap_affrect.report.photographs import (
    PhotographReport,
    corner_distortion_px,
    photographs_of_report,
    quality_of,
)
from colmap_affrect.report.scene import View3D, radial_distortion, read_view_with_tracks
from colmap_affrect.report.verdict import verdict_of


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("run")
    make_run_page(folder)
    return Workspace(folder / "out")


@pytest.fixture(scope="module")
def model(workspace: Workspace) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(workspace.sparse / "0"))


@pytest.fixture(scope="module")
def photographs(workspace: Workspace) -> dict[str, PhotographReport]:
    report = small_report(workspace.path)
    return dict(
        photographs_of_report(
            ModelReader(workspace.sparse), NAMES, report.models, report.cameras, {}
        )
    )


def points_of(image: pycolmap.Image) -> set[int]:
    """The ids of the points that an image sees."""
    return {mark.point3D_id for mark in image.get_observation_points2D()}


def test_points_and_neighbours_of_a_photograph_are_those_of_the_model(
    photographs: dict[str, PhotographReport], model: pycolmap.Reconstruction
) -> None:
    first = photographs[NAMES[0]]
    image = model.find_image_with_name(NAMES[0])
    assert first.num_points == len(points_of(image))
    shared = {}
    for other in model.images.values():
        num_shared = len(points_of(image) & points_of(other))
        if other.name != image.name and num_shared:
            shared[other.name] = num_shared
    assert first.neighbours == shared


def test_error_and_focal_length_of_a_photograph_are_those_of_the_model(
    photographs: dict[str, PhotographReport], model: pycolmap.Reconstruction
) -> None:
    first = photographs[NAMES[0]]
    image = model.find_image_with_name(NAMES[0])
    errors = []
    for point in image.get_observation_points2D():
        place = image.project_point(model.points3D[point.point3D_id].xyz)
        errors.append(np.linalg.norm(place - point.xy))
    assert first.mean_error_px == pytest.approx(np.mean(errors), abs=1e-3)
    camera = model.cameras[image.camera_id]
    assert first.focal_px == pytest.approx(camera.mean_focal_length(), abs=0.1)
    assert (first.focal_start_px, first.focal_source) == (200.0, "exif")


def test_each_photograph_has_a_quality_and_a_model(
    photographs: dict[str, PhotographReport],
) -> None:
    assert list(photographs) == list(NAMES)
    first = photographs[NAMES[0]]
    assert (first.quality, first.model, first.probability) == ("sure", 0, 0.99)
    assert photographs[NAMES[5]].quality == "missing"


def test_a_photograph_without_a_probability_is_not_sure() -> None:
    model = ModelSummary(("a", "b"), 1, 2.0, 0.5, probabilities={"a": 0.9})
    assert [quality_of(name, model) for name in "abc"] == ["sure", "unsure", "missing"]


@pytest.mark.parametrize("factor", [0.1, -0.1])
def test_distortion_is_told_at_the_corner(factor: float) -> None:
    """Outwards where the factor is positive."""
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", 1000.0, 800, 600
    )
    camera.params = [1000.0, 400.0, 300.0, factor]
    corner_px = 500.0
    ray = float(np.asarray(camera.cam_from_img(np.array([[800.0, 600.0]])))[0, 0]) / 0.8
    moved_px = corner_distortion_px(camera)
    assert moved_px == pytest.approx(corner_px - 1000.0 * ray, abs=0.1)
    assert np.sign(moved_px) == np.sign(factor)


@pytest.mark.parametrize(("name", "extra"), [
    ("SIMPLE_RADIAL", [0.08]), ("RADIAL", [-0.1, 0.02]), ("SIMPLE_PINHOLE", []),
])  # fmt: skip
def test_radial_distortion_of_cameras_is_found(name: str, extra: list[float]) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, name, 900.0, 800, 600)
    camera.params = [900.0, 390.0, 310.0, *extra]
    expected = [*extra, 0.0, 0.0][:2]
    assert radial_distortion(camera) == pytest.approx(expected, abs=1e-4)


def view_of_run(workspace: Workspace, max_num_observations: int) -> View3D:
    """The view of its largest model, with who sees its points."""
    reader = ModelReader(workspace.sparse)
    return read_view_with_tracks(reader, 0, {}, max_num_observations)


def decoded(view: View3D) -> list[tuple[np.ndarray, list[tuple[int, np.ndarray]]]]:
    """Return the points of a view, with (row of the camera, px) of who sees each."""
    data = base64.b64decode(view.points)
    quantised = np.frombuffer(data, "<u2", 3 * view.num_points).reshape(-1, 3)
    places = quantised / 32767.5 - 1.0
    data = base64.b64decode(view.tracks)
    counts = np.frombuffer(data, "<u2", view.num_points)
    total = int(counts.sum())
    rows = np.frombuffer(data, "<u2", total, 2 * view.num_points)
    shares = np.frombuffer(data, "<u2", 2 * total, 2 * (view.num_points + total))
    shares = shares.reshape(-1, 2) / 65535.0
    found = []
    start = 0
    for place, count in zip(places, counts.tolist(), strict=True):
        seers = []
        for at in range(start, start + count):
            size = np.array(view.looks[rows[at]]["size"])
            seers.append((int(rows[at]), shares[at] * size))
        found.append((place, seers))
        start += count
    return found


def test_the_page_projects_points_to_where_photographs_see_them(
    workspace: Workspace, model: pycolmap.Reconstruction
) -> None:
    """By what its script has: pose, focal length, axis, radial distortion."""
    view = view_of_run(workspace, 10_000)
    points = decoded(view)
    num_seers = sum(len(seers) for _, seers in points)
    assert num_seers == sum(len(points_of(image)) for image in model.images.values())
    errors = []
    for place, seers in points:
        for row, seen in seers:
            look = view.looks[row]
            rotation = np.array(look["rotation"]).reshape(3, 3)
            x, y, z = rotation @ (place - look["center"])
            squared = (x / z) ** 2 + (y / z) ** 2
            scale = 1.0 + squared * (look["radial"][0] + squared * look["radial"][1])
            projected = np.array([x / z, y / z]) * scale * look["focal"] + look["axis"]
            errors.append(np.linalg.norm(projected - seen))
    assert np.median(errors) < 0.5
    assert np.percentile(errors, 95) < 1.5


def test_a_page_has_at_most_so_many_observations(workspace: Workspace) -> None:
    whole = decoded(view_of_run(workspace, 10_000))
    some = decoded(view_of_run(workspace, 100))
    counts = [len(seers) for _, seers in some]
    assert 90 <= sum(counts) <= 100
    for (_, few), (_, all_of_them) in zip(some, whole, strict=True):
        if few:
            assert [row for row, _ in few] == [row for row, _ in all_of_them]


def test_observations_are_those_of_pycolmap(
    workspace: Workspace, model: pycolmap.Reconstruction
) -> None:
    """Its own come one by one."""
    seen = ModelReader(workspace.sparse).observations(0)
    for row, image in enumerate(registered_images(model)):
        marks = image.get_observation_points2D()
        is_own = seen.rows == row
        assert seen.names[row] == image.name
        ids = seen.point_ids[is_own].tolist()
        assert ids == [mark.point3D_id for mark in marks]
        assert len(ids) > 10
        places = np.array([mark.xy for mark in marks])
        np.testing.assert_array_equal(seen.places[is_own], places)
        projected = [image.project_point(model.points3D[i].xyz) for i in ids]
        errors_px = np.linalg.norm(np.array(projected) - places, axis=1)
        np.testing.assert_allclose(seen.errors_px[is_own], errors_px, atol=1e-9)


def test_shared_points_are_counted_for_each_pair(workspace: Workspace) -> None:
    seen = ModelReader(workspace.sparse).observations(0)
    by_row = [set(seen.point_ids[seen.rows == row]) for row in range(len(seen.names))]
    for one, two in itertools.combinations(range(len(by_row)), 2):
        assert seen.num_shared[one, two] == len(by_row[one] & by_row[two])
        assert seen.num_shared[two, one] == seen.num_shared[one, two]


def test_shared_points_of_many_photographs_are_counted_together() -> None:
    """More pairs of photographs than observations; a point is seen by up to 30 of them."""
    random = np.random.default_rng(5)
    num_images = 60
    seers = [random.permutation(num_images)[:num] for num in (30, 2, 1, 7, 30)]
    rows = np.concatenate(seers)
    ids = np.repeat([7, 3, 9, 1, 4], [len(of_point) for of_point in seers])
    order = np.lexsort([ids, rows])
    seen = Observations(
        names=tuple(map(str, range(num_images))),
        rows=rows[order],
        point_ids=ids[order],
        places=np.zeros((len(rows), 2)),
        errors_px=np.zeros(len(rows)),
    )
    expected = np.zeros((num_images, num_images), np.int64)
    for of_point in seers:
        for one, two in itertools.permutations(of_point.tolist(), 2):
            expected[one, two] += 1
    np.testing.assert_array_equal(seen.num_shared, expected)


QUALITIES_AND_HEADLINES = [
    (["sure", "sure"], "All 2 photographs are placed surely"),
    (["unsure", "doubtful"], "None of 2 photographs is placed surely, 1 unsure, 1 doubtful"),
    (["sure", "sure", "missing"], "2 of 3 photographs are placed surely, 1 not placed"),
    (["missing", "missing"], "None of 2 photographs could be placed"),
]  # fmt: skip


def test_a_headline_counts_models_apart_from_what_is_sure(tmp_path: Path) -> None:
    report = small_report(tmp_path)
    (model,) = report.models
    photographs = {
        "a": PhotographReport("sure", 0),
        "b": PhotographReport("doubtful", 1),
    }
    several = replace(report, models=(model, model))
    verdict = verdict_of(several, ["a", "b"], photographs)
    assert verdict.headline == (
        "1 of 2 photographs are placed surely, 1 doubtful; 2 models"
    )
    titles = [component.title for component in verdict.components]
    assert titles == [
        "Model in sparse/0: 1 photograph",
        "Model in sparse/1: 1 photograph",
    ]


@pytest.mark.parametrize(("qualities", "headline"), QUALITIES_AND_HEADLINES)
def test_the_headline_praises_only_what_is_sure(
    qualities: list, headline: str, tmp_path: Path
) -> None:
    names = [f"{number}.jpg" for number in range(len(qualities))]
    photographs = {}
    for name, quality in zip(names, qualities, strict=True):
        model = None if quality == "missing" else 0
        photographs[name] = PhotographReport(quality, model)
    verdict = verdict_of(small_report(tmp_path), names, photographs)
    assert verdict.headline == headline
    assert verdict.next_step == "Next: one camera."


@pytest.mark.parametrize(
    ("qualities", "begins"),
    [
        (["sure", "unsure"], "The model in sparse/0 can be used; look at the unsure"),
        (["sure", "doubtful"], "Next: look at the doubtful photographs"),
        (["sure", "missing"], "Next: more photographs."),
    ],
)
def test_photographs_are_looked_at_before_hours_are_spent_on_others(
    qualities: list, begins: str, tmp_path: Path
) -> None:
    report = replace(small_report(tmp_path), advice=(MORE,))
    photographs = {
        f"{number}.jpg": PhotographReport(quality, 0)
        for number, quality in enumerate(qualities)
    }
    verdict = verdict_of(report, [*photographs], photographs)
    assert verdict.next_step.startswith(begins)
