"""Cameras by straight lines: made-up buildings are recovered, and chance says nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from line_scenes import SIZE, Building, arch_edges, chance_edges, turn
from numpy.testing import assert_allclose
from strategies import Array

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry import lines as line_cameras
from colmap_affrect.geometry.lines import (
    DISTORTIONS,
    FOCALS,
    SHIFTS,
    Explanation,
    LineCamera,
    LineLikelihood,
    Lines,
    line_camera,
    measure_lines,
    upright_of,
)
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.geometry.vanishing import CHANCE, VanishingFit, refined


def lines_of_edges(edges: Array) -> Lines:
    return measure_lines(Segments.of_image(edges, SIZE))


def camera_of(edges: Array, shift_sigma: float | None = None) -> LineCamera:
    camera = lines_of_edges(edges).camera(shift_sigma)
    assert camera is not None
    return camera


def angle_deg(first: Array, second: Array) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1.0, 1.0))))


def test_segments_count_from_the_middle_of_the_image_in_longer_sides() -> None:
    # The middle of 1500 x 1000 px is at (749.5, 499.5): half a pixel before the pixel 750.
    edges = np.array([[749.5, 499.5, 1499.5, 499.5], [749.5, 499.5, 749.5, 799.5]])
    segments = Segments.of_image(edges, SIZE)
    assert_allclose(segments.starts, 0.0)
    assert_allclose(
        segments.ends, [[0.5, 0.0], [0.0, 0.2]]
    )  # x right, y down, the longer first
    assert_allclose(segments.lengths, [0.5, 0.2])
    assert_allclose(segments.directions, [[1.0, 0.0], [0.0, 1.0]])


def test_only_the_longest_segments_are_kept() -> None:
    edges = np.array([[10.0, 10.0, 10.0, 20.0 + number] for number in range(300)])
    segments = Segments.of_image(edges, SIZE)
    assert len(segments) == 160
    assert_allclose(segments.lengths[[0, -1]], np.array([309.0, 150.0]) / 1500.0)
    assert len(segments.longest(7)) == 7


def test_a_line_in_pieces_counts_as_one_and_parallel_lines_count_each() -> None:
    pieces = [[100.0, 300.0, 300.0, 300.0], [400.0, 302.0, 500.0, 302.0]]
    apart = [[100.0, 600.0, 500.0, 600.0]]
    crossing = [[800.0, 200.0, 800.0, 700.0]]
    segments = Segments.of_image(np.array(pieces + apart + crossing), SIZE)
    by_length = dict(
        zip(segments.lengths.round(4).tolist(), segments.weights, strict=True)
    )
    assert by_length[round(200 / 1500, 4)] == pytest.approx(2 / 3)
    assert by_length[round(100 / 1500, 4)] == pytest.approx(1 / 3)
    assert by_length[round(400 / 1500, 4)] == pytest.approx(1.0)
    assert by_length[round(500 / 1500, 4)] == pytest.approx(1.0)


@pytest.mark.parametrize(("angle", "is_same_line"), [(0.02, True), (0.2, False)])
def test_pieces_of_a_line_have_its_direction_but_for_three_degrees(
    angle: float, *, is_same_line: bool
) -> None:
    across = 30.0 * np.cos(angle)
    down = 30.0 * np.sin(angle)
    long = [100.0, 500.0, 900.0, 500.0]
    short = [500.0 - across, 500.0 - down, 500.0 + across, 500.0 + down]
    segments = Segments.of_image(np.array([long, short]), SIZE)
    alone = [800.0 / 860.0, 60.0 / 860.0] if is_same_line else [1.0, 1.0]
    assert_allclose(segments.weights, alone, rtol=1e-6)


def test_four_segments_by_chance_are_reckoned_with_beforehand() -> None:
    building = Building(focal=1.3, noise_px=0.0)
    segments = Segments.of_image(building.edges(), SIZE)
    truth = building.rotation.T
    fit = VanishingFit(segments, truth[None], np.array([1.3]), np.zeros(1))
    num_beforehand = 3.0 + 4.0
    expected = 4.0 / (num_beforehand + segments.weights.sum())
    assert fit.shares[0, 3] == pytest.approx(expected, rel=0.4)


def test_directions_of_short_segments_are_less_sure() -> None:
    segments = Segments.of_image(
        np.array([[0.0, 0.0, 750.0, 0.0], [0.0, 0.0, 15.0, 0.0]]), SIZE
    )
    assert_allclose(segments.sigmas, np.hypot(0.008, [0.0008 / 0.5, 0.0008 / 0.01]))


def test_a_vanishing_point_lies_where_the_camera_sees_its_direction() -> None:
    # f = 0.8, axis 0.1 below the middle: (1, 2, 4) vanishes at (0.2, 0.4 + 0.1) longer sides. A
    # segment from there has an angle of zero to it, one that was turned by 90 degrees a sine of 1.
    direction = np.array([1.0, 2.0, 4.0]) / np.sqrt(21.0)
    other = np.cross(direction, [0.0, 0.0, 1.0])
    other /= np.linalg.norm(other)
    rotation = np.stack([direction, other, np.cross(direction, other)])
    at = np.array([0.2, 0.5])
    away = np.array([0.1, -0.3])
    across = np.array([0.3, 0.1])
    starts = np.stack([at + away, at + away])
    ends = np.stack([at + 2.0 * away, at + away + across])
    segments = Segments(starts, ends)
    fit = VanishingFit(segments, rotation[None], np.array([0.8]), np.array([0.1]))
    assert abs(fit.sines[0, 0, 0]) < 1e-12
    middle = away + across / 2.0
    sine = np.linalg.norm(away) / np.linalg.norm(middle)  # of the angle at the middle
    assert abs(fit.sines[0, 0, 1]) == pytest.approx(sine)
    other_sign = VanishingFit(
        segments, rotation[None], np.array([0.8]), np.array([-0.1])
    )
    assert abs(other_sign.sines[0, 0, 0]) > 0.1


def test_a_rotation_is_refined_to_the_true_one() -> None:
    building = Building(focal=1.3, noise_px=0.0)
    segments = Segments.of_image(building.edges(), SIZE)
    truth = building.rotation.T
    start = truth @ turn(0, 0.8) @ turn(1, -0.7)
    found, scores = refined(segments, start[None], np.array([1.3]), np.zeros(1), 8)
    assert np.rad2deg(np.linalg.norm(found[0] - truth)) < 0.05
    perfect = VanishingFit(segments, truth[None], np.array([1.3]), np.zeros(1)).scores()
    assert scores[0] == pytest.approx(perfect[0], rel=1e-3)


@pytest.mark.parametrize("focal", [0.55, 0.9, 1.6])
def test_the_focal_length_of_a_building_is_found_among_lines_by_chance(
    focal: float,
) -> None:
    edges = np.concatenate([Building(focal=focal).edges(3), chance_edges(40, 4)])
    camera = camera_of(edges)
    assert camera.is_known
    assert abs(np.log(camera.focal / focal)) < 0.06
    assert abs(np.log(camera.focal / focal)) < 2.0 * camera.focal_sigma
    assert camera.shift == pytest.approx(0.0, abs=0.03)


def test_rows_of_the_rotation_are_the_directions_and_up_points_up() -> None:
    building = Building(focal=1.1)
    camera = camera_of(building.edges(5))
    assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
    cosines = np.abs(camera.rotation @ building.rotation)
    assert_allclose(np.sort(cosines.max(axis=1)), 1.0, atol=1e-3)
    assert sorted(cosines.argmax(axis=1).tolist()) == [0, 1, 2]
    assert (
        angle_deg(camera.up, -building.rotation[:, 1]) < 1.5
    )  # down is the second column
    assert np.rad2deg(camera.up_sigma) < 2.0
    assert camera.up[1] < -0.9
    assert camera.up[2] == pytest.approx(-building.rotation[2, 1], abs=0.02)


@pytest.mark.parametrize("shift", [0.18, -0.12])
def test_a_shift_of_the_axis_is_found_with_its_sign(shift: float) -> None:
    edges = Building(focal=1.2, shift=shift, num_each=45, noise_px=0.2).edges(2)
    lines = lines_of_edges(edges)
    assert lines.says_shifted
    camera = lines.camera()
    assert camera is not None
    assert camera.shift == pytest.approx(shift, abs=0.05)
    assert 0.0 < camera.shift_sigma < 0.06
    assert abs(np.log(camera.focal / 1.2)) < 0.12
    explanation = lines.explanation()
    assert explanation is not None
    assert explanation.shift == pytest.approx(shift, abs=0.06)


def test_a_building_with_the_axis_in_the_middle_is_not_called_shifted() -> None:
    lines = lines_of_edges(Building(focal=1.2, num_each=45).edges(2))
    assert not lines.says_shifted
    free = lines.camera(line_cameras.SHIFTED_SIGMA)
    assert free is not None
    assert free.shift == pytest.approx(0.0, abs=0.06)


@pytest.mark.parametrize("shift", [-0.2, 0.25])
@pytest.mark.parametrize("seed", [0, 2])
def test_a_shifted_camera_is_as_likely_as_its_true_rotation_makes_it(
    shift: float, seed: int
) -> None:
    """From the rotation without a shift it was not found, and seemed as good as chance."""
    building = Building(focal=1.2, shift=shift)
    segments = Segments.of_image(building.edges(seed), SIZE)
    found = line_cameras.line_likelihood(segments)
    assert found is not None
    row = int(np.abs(FOCALS - 1.2).argmin())
    column = int(np.abs(SHIFTS - shift).argmin())
    _, scores = refined(
        segments=segments.undistorted(found.distortion),
        rotations=building.rotation.T[None],
        focals=FOCALS[[row]],
        shifts=SHIFTS[[column]],
        num_steps=10,
    )
    from_truth = float(scores[0]) / line_cameras.TEMPER
    assert found.log_likelihoods[row, column] > from_truth - 2.0
    assert found.rotations.shape == (len(FOCALS), len(SHIFTS), 3, 3)


def test_segments_are_undistorted_as_colmap_does() -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.3, 1, 1)
    camera.params = [1.3, 0.0, 0.0, -0.15 * 1.3**2]
    rays = np.array([[0.3, -0.1], [-0.25, 0.2]])
    seen = np.array([camera.img_from_cam(np.append(ray, 1.0)) for ray in rays])
    segments = Segments(seen[:1], seen[1:]).undistorted(-0.15)
    assert_allclose(segments.starts, 1.3 * rays[:1], atol=1e-6)
    assert_allclose(segments.ends, 1.3 * rays[1:], atol=1e-6)
    same = Segments(seen[:1], seen[1:])
    assert same.undistorted(0.0) is same


@pytest.mark.parametrize("distortion", [-0.15, 0.1])
def test_the_focal_length_is_found_where_a_lens_bends_lines(distortion: float) -> None:
    edges = Building(focal=1.1, distortion=distortion, num_each=40).edges(3)
    lines = lines_of_edges(edges)
    camera = lines.camera()
    assert camera is not None
    assert abs(np.log(camera.focal / 1.1)) < 0.05
    assert lines.likelihood is not None
    assert lines.likelihood.distortion == pytest.approx(distortion, abs=0.051)
    explanation = lines.explanation()
    assert explanation is not None
    assert (explanation.kinds != CHANCE).mean() > 0.95


def test_distortions_that_are_tried_are_those_of_lenses() -> None:
    assert_allclose([DISTORTIONS[0], DISTORTIONS[-1]], [-0.2, 0.2])
    assert 0.0 in DISTORTIONS
    assert_allclose(np.diff(DISTORTIONS), 0.05)


def test_segments_are_told_by_direction_and_the_horizon_is_where_it_is() -> None:
    building = Building(focal=0.9)
    edges = np.concatenate([building.edges(7), chance_edges(30, 8)])
    segments = Segments.of_image(edges, SIZE)
    lines = measure_lines(segments)
    explanation = lines.explanation()
    assert explanation is not None
    order = np.argsort(
        -np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]), kind="stable"
    )
    is_of_building = order < 75
    assert (explanation.kinds[is_of_building] != CHANCE).mean() > 0.95
    assert (explanation.kinds[~is_of_building] == CHANCE).mean() > 0.8
    true_kinds = order[is_of_building] % 3
    rows = np.abs(explanation.rotation @ building.rotation).argmax(axis=1)
    found = explanation.kinds[is_of_building]
    assert (rows[found[found >= 0]] == true_kinds[found >= 0]).mean() > 0.95
    # What lies level before the camera is seen on the horizon.
    for column in (0, 2):
        x, y, z = building.rotation[:, column]
        point = np.array([0.9 * x / z, 0.9 * y / z, 1.0])
        distance = abs(explanation.horizon @ point) / np.hypot(*explanation.horizon[:2])
        assert distance < 0.02


def test_lines_by_chance_say_nothing() -> None:
    for seed in range(3):
        camera = camera_of(chance_edges(120, seed))
        assert not camera.is_known
        assert camera.focal_sigma > 0.25
        assert 0.6 < camera.focal < 2.4
        assert np.rad2deg(camera.up_sigma) > 4.0


def test_few_lines_say_nothing_at_all() -> None:
    lines = lines_of_edges(Building(num_each=3).edges())
    assert lines.likelihood is None
    assert lines.camera() is None
    assert lines.explanation() is None
    assert not lines.says_shifted
    assert lines_of_edges(np.zeros((0, 4))).camera() is None


def test_round_arches_say_nothing() -> None:
    camera = camera_of(arch_edges(14))
    assert not camera.is_known
    assert camera.focal_sigma > 0.2


def test_a_wall_from_the_front_says_little() -> None:
    frontal = Building(rotation=turn(2, 1.0), directions=(0, 1), num_each=30)
    assert not camera_of(frontal.edges(1)).is_known


def test_the_grid_and_the_constants_are_what_was_fitted() -> None:
    assert_allclose([FOCALS[0], FOCALS[-1]], [0.4, 6.0])
    assert_allclose([SHIFTS[0], SHIFTS[-1]], [-0.3, 0.3])
    assert np.diff(np.log(FOCALS)).max() < 0.11
    # One sharp peak: what is stated is the deviation of the model and half a step of the grid.
    logs = np.full((len(FOCALS), len(SHIFTS)), -50.0)
    row = int(np.abs(FOCALS - 1.0).argmin())
    logs[row, len(SHIFTS) // 2] = 0.0
    camera = line_camera(LineLikelihood(logs, np.tile(np.eye(3), (*logs.shape, 1, 1))))
    assert camera.focal == pytest.approx(FOCALS[row])
    assert 0.03 < camera.focal_sigma < 0.08
    # Nothing known: the usual focal length, with the deviation of those that photographs have.
    nothing = LineLikelihood(
        np.zeros(logs.shape), np.tile(np.eye(3), (*logs.shape, 1, 1))
    )
    camera = line_camera(nothing)
    assert camera.focal == pytest.approx(1.2, rel=0.02)
    assert camera.focal_sigma == pytest.approx(0.5, rel=0.05)
    assert camera.shift_sigma == pytest.approx(0.02, rel=0.2)


def test_up_is_the_row_nearest_to_the_images_upright() -> None:
    rotation = np.stack([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
    assert_allclose(upright_of(rotation), [0.0, -0.8, 0.6])
    assert_allclose(upright_of(-rotation), [0.0, -0.8, 0.6])


def test_the_deviation_of_the_upright_is_that_of_all_focal_lengths_and_shifts() -> None:
    logs = np.full((len(FOCALS), len(SHIFTS)), -50.0)
    rotations = np.tile(np.eye(3), (*logs.shape, 1, 1))
    middle = len(SHIFTS) // 2
    first, second = 10, 11
    logs[[first, second], middle] = 0.0
    rotations[first, middle] = turn(0, 6.0)
    prior = -0.5 * (np.log(FOCALS / 1.2) / 0.5) ** 2
    chances = np.exp(prior[[first, second]])
    share = chances.min() / chances.sum()  # of the less likely of both
    camera = line_camera(LineLikelihood(logs, rotations))
    assert np.rad2deg(camera.up_sigma) == pytest.approx(6.0 * np.sqrt(share), rel=1e-3)


def test_horizontal_directions_vanish_on_the_horizon() -> None:
    """The camera looks down a little and rolls; its axis is above the middle."""
    rotation = turn(0, 12.0) @ turn(1, 25.0) @ turn(2, 4.0)
    explanation = Explanation(1.3, -0.15, rotation, np.zeros(0, np.int64), 9.0)
    up = explanation.up
    for direction in rotation:
        if abs(direction @ up) > 0.5:
            continue
        x, y, z = direction
        vanishing = np.array([1.3 * x, 1.3 * y - 0.15 * z, z])
        assert explanation.horizon @ vanishing == pytest.approx(0.0, abs=1e-12)
    assert (
        explanation.horizon @ [0.0, -9.0, 1.0] > 0.0 > explanation.horizon @ [0, 9, 1]
    )


def test_segments_are_of_one_line_where_either_one_says_so() -> None:
    """The middle of the second one is on the line of the first one, but not the other way."""
    directions = np.array([[0.05, 0.0], [0.05 * np.cos(0.04), 0.05 * np.sin(0.04)]])
    middles = np.array([[0.0, 0.0], [0.9, 0.005]])
    segments = Segments(middles - directions, middles + directions)
    assert_allclose(segments.weights, [0.5, 0.5])


def test_focal_lengths_are_as_likely_as_all_distortions_make_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Segments err together: three nats of them count as one."""
    turns = np.tile(np.eye(3), (len(FOCALS), 1, 1))
    of_others = np.where(np.arange(len(FOCALS)) == 5, 6.0, 0.0)

    def refined_at_once(rotations: Array, **_: Any) -> tuple[Array, Array]:
        return rotations, np.full(len(rotations), 3.0)

    monkeypatch.setattr(line_cameras, "refined", refined_at_once)
    monkeypatch.setattr(
        line_cameras,
        "_likeliest_lens",
        lambda *_: line_cameras._Lens(0.0, turns, of_others),
    )
    edges = np.array([[10.0, 10.0, 10.0, 20.0 + number] for number in range(20)])
    found = line_cameras.line_likelihood(Segments.of_image(edges, SIZE))
    assert found is not None
    assert_allclose(found.log_likelihoods[5], 3.0)
    assert_allclose(np.delete(found.log_likelihoods, 5, axis=0), 1.0)
