"""Straight lines are kept beside features, and reported in px, mm and words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from line_scenes import SIZE, Building
from numpy.testing import assert_allclose, assert_array_equal

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry import lines as line_cameras
from colmap_affrect.geometry.lines import FOCALS, SHIFTS, LineLikelihood, Lines
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.line_report import LineReport, line_report

LINE_DATASETS = {
    "line_segments",
    "line_log_likelihoods",
    "line_rotations",
    "line_distortion",
}


def some_features(count: int) -> LocalFeatures:
    lafs = np.tile(np.eye(2, 3), (count, 1, 1))
    descriptors = np.ones((count, 8), np.float32)
    return LocalFeatures(lafs, np.ones(count, np.float32), descriptors)


def peaked(focal: float, shift: float, num_segments: int = 20) -> Lines:
    """Lines that say surely what they say, without any fit."""
    edges = Building(num_each=num_segments // 2, directions=(0, 1)).edges()
    distances = ((np.log(FOCALS / focal)) / 0.05)[:, None] ** 2
    distances = distances + ((SHIFTS - shift) / 0.03)[None, :] ** 2
    random = np.random.default_rng(1)
    rotations = random.normal(size=(len(FOCALS), len(SHIFTS), 3, 3))
    return Lines(
        Segments.of_image(edges, SIZE),
        LineLikelihood(60.0 - 0.5 * distances, rotations, distortion=-0.05),
    )


def few() -> Lines:
    return Lines(Segments.of_image(Building(num_each=2).edges(), SIZE), None)


def test_lines_come_back_as_written_and_stay_when_features_are_added(
    tmp_path: Path,
) -> None:
    store = FeatureStore(tmp_path / "features.h5")
    lines = peaked(0.9, 0.1)
    store.write("a.png", some_features(3), SIZE, lines=lines)
    store.write("b.png", some_features(2), SIZE, lines=few())
    store.extend("a.png", some_features(4), 1)
    read = store.lines_of(["a.png"]).get("a.png")
    assert read is not None
    assert read.likelihood is not None
    assert lines.likelihood is not None
    assert_allclose(read.segments.starts, lines.segments.starts, atol=1e-6)
    assert_allclose(read.segments.ends, lines.segments.ends, atol=1e-6)
    assert_allclose(
        read.likelihood.log_likelihoods, lines.likelihood.log_likelihoods, rtol=1e-6
    )
    assert_allclose(read.likelihood.rotations, lines.likelihood.rotations, rtol=1e-6)
    assert read.likelihood.distortion == pytest.approx(-0.05)
    assert len(store.read("a.png")) == 7
    without = store.lines_of(["b.png"]).get("b.png")
    assert without is not None
    assert without.likelihood is None
    assert len(without.segments) == 6
    store.check_all()


def test_how_a_photograph_is_stored_comes_back_with_its_lines(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path / "features.h5")
    lines = replace(peaked(0.9, 0.1), down=(-1.0, 0.0))
    store.write("a.png", some_features(3), SIZE, lines=lines)
    store.write("b.png", some_features(3), SIZE, lines=replace(few(), down=(0.0, -1.0)))
    read = store.lines_of(["a.png", "b.png"])
    assert read["a.png"].down == (-1.0, 0.0)
    assert read["b.png"].down == (0.0, -1.0)
    camera = lines.camera()
    assert camera is not None
    found = store.line_findings()["a.png"].camera
    assert found is not None
    assert_allclose(found.up, camera.up, atol=1e-6)
    again = FeatureStore(store.path).line_findings()["a.png"].camera
    assert again is not None
    assert_allclose(again.up, camera.up, atol=1e-6)


def test_stores_of_before_and_of_another_grid_have_no_lines(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path / "features.h5")
    store.write("old.png", some_features(3), SIZE)
    lines = peaked(0.9, 0.0)
    assert lines.likelihood is not None
    coarse = LineLikelihood(
        lines.likelihood.log_likelihoods[::2], lines.likelihood.rotations[::2]
    )
    store.write(
        "other.png", some_features(3), SIZE, lines=Lines(lines.segments, coarse)
    )
    assert not store.lines_of(["old.png"])
    assert not store.lines_of(["other.png"])
    with h5py.File(store.path) as file:
        assert not LINE_DATASETS & set(file["old.png"])


def test_lines_of_stores_of_before_have_no_distortion(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path / "features.h5")
    store.write("a.png", some_features(3), SIZE, lines=peaked(0.9, 0.1))
    with h5py.File(store.path, "r+") as file:
        del file["a.png/line_distortion"]
    read = store.lines_of(["a.png"])["a.png"]
    assert read.likelihood is not None
    assert read.likelihood.distortion == 0.0


def test_what_hloc_reads_of_an_image_is_numbers_as_before(tmp_path: Path) -> None:
    store = FeatureStore(tmp_path / "features.h5")
    store.write("a.png", some_features(3), SIZE, lines=peaked(0.9, 0.1))
    with h5py.File(store.path) as file:
        group = file["a.png"]
        assert set(group) > {
            *LINE_DATASETS,
            "keypoints",
            "descriptors",
            "scores",
            "image_size",
        }
        for dataset in group.values():
            assert np.issubdtype(dataset.dtype, np.number)
        assert_array_equal(group["image_size"][()], SIZE)


def test_a_report_is_in_px_of_the_photograph_and_in_mm_for_film_of_36_mm() -> None:
    report = line_report(
        peaked(1.0, 0.0).findings(), (1000, 2000)
    )  # the longer side is 2000 px
    assert report.is_known
    assert not report.is_shifted
    assert report.focal_px == pytest.approx(2000.0, rel=0.03)
    assert report.focal_mm == pytest.approx(36.0, rel=0.03)
    assert report.focal_sigma is not None
    assert 0.03 < report.focal_sigma < 0.12
    assert report.num_segments == 20
    text = report.sentence()
    assert text.startswith(
        f"the lines tell a focal length of {report.focal_px:,.0f} px (36 mm"
    )
    assert "axis" not in text


@pytest.mark.parametrize(("shift", "side"), [(0.2, "below"), (-0.2, "above")])
def test_a_shift_is_said_with_its_side(shift: float, side: str) -> None:
    report = line_report(peaked(1.0, shift).findings(), (2000, 1000))
    assert report.is_shifted
    assert report.shift_px == pytest.approx(2000.0 * shift, rel=0.1)
    assert f"px {side} the middle" in report.sentence()


def test_few_lines_and_open_focal_lengths_are_said() -> None:
    report = line_report(few().findings(), (2000, 1000))
    assert report == LineReport(num_segments=6)
    assert (
        "6 straight lines are too few to say anything, 12 are needed"
        in report.sentence()
    )
    nothing = np.zeros((len(FOCALS), len(SHIFTS)))
    rotations = np.tile(np.eye(3), (*nothing.shape, 1, 1))
    open_lines = Lines(peaked(1.0, 0.0).segments, LineLikelihood(nothing, rotations))
    said = line_report(open_lines.findings(), (2000, 1000))
    assert not said.is_known
    assert "do not tell the focal length" in said.sentence()
    assert said.focal_px == pytest.approx(2000.0 * line_cameras.USUAL_FOCAL, rel=0.03)
