"""Which cameras have images that can tell their distortion, and how it begins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import camera_priors
from colmap_affrect.mappers.distortion import (
    MIN_REDUNDANCY,
    cameras_that_tell_distortion,
    redundancy_of,
)
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN, ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.search import Search

PARAMS = [1280.0, 512.0, 384.0, 0.0]
TRAP = -0.5  # a wrong distortion


@pytest.mark.parametrize(
    ("num_images", "num_points", "is_told"),
    [(4, 200, True), (3, 30, True), (2, 200, False)],
)
def test_several_images_of_a_camera_tell_its_distortion_and_two_do_not(
    tmp_path: Path, num_images: int, num_points: int, *, is_told: bool
) -> None:
    path = tmp_path / "database.db"
    synthesize(
        path,
        num_rigs=1,
        num_frames_per_rig=num_images,
        num_points3D=num_points,
        camera_params=PARAMS,
    )
    assert cameras_that_tell_distortion(PairGraph.read(path)) == (
        {1} if is_told else set()
    )


def test_an_image_full_of_points_of_many_others_tells_it_and_one_of_pairs_does_not() -> (
    None
):
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", 1000.0, 800, 800
    )
    middles = 100.0 * np.arange(8) + 50.0
    keypoints = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    pairs = redundancy_of(camera, keypoints, np.ones(64, np.int64))
    assert pairs == pytest.approx(64 * 0.5 - 6)
    assert pairs < MIN_REDUNDANCY < redundancy_of(camera, keypoints, np.full(64, 4))
    twice = np.repeat(keypoints, 2, axis=0)
    assert redundancy_of(camera, twice, np.ones(128, np.int64)) == pytest.approx(pairs)


def test_single_images_of_few_points_do_not(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=4, num_points3D=60)
    assert not cameras_that_tell_distortion(PairGraph.read(path))


def search_of(path: Path, record: CameraRecord) -> Search:
    """Return what makes models of a database, in which distortion stays where it begins."""
    graph = PairGraph.read(path)
    records = {camera.camera_id: record for camera in graph.cameras.values()}
    task = MappingTask(path, None, cameras=records)
    native = mapper_of("sparse").native(task, 0)
    priors = camera_priors(graph.cameras.values(), records, {})
    held = {key: replace(prior, has_distortion=False) for key, prior in priors.items()}
    adjuster = Adjuster(held, NOISE_PX, native.get_global_bundle_adjustment())
    scorer = ModelScorer(graph, held)
    return Search(adjuster, scorer, native, 6, lambda _: None)


@pytest.mark.parametrize(
    ("distortion", "source", "leaves"),
    [
        (TRAP, "guess", True),
        (0.0, "guess", False),
        (1e-4, "guess", False),  # a cost that is hardly lower is no better optimum
        (TRAP, "exif", False),  # with a known focal length, distortion is no trap
    ],
)
def test_a_model_leaves_a_distortion_that_its_points_contradict(
    tmp_path: Path, distortion: float, source: str, *, leaves: bool
) -> None:
    path = tmp_path / "database.db"
    model = synthesize(
        path, num_rigs=3, num_points3D=80, noise_px=0.4, camera_params=PARAMS
    )
    model.cameras[1].params = [*PARAMS[:3], distortion]
    search = search_of(path, CameraRecord(("a",), source, PARAMS[0], size=(1024, 768)))
    as_it_is, straight = search.costs_of_starts(model)
    assert (straight < as_it_is - MIN_SCORE_GAIN) == leaves
    found = search.from_straight_lens(model)
    assert (found is not model) == leaves
    assert found.cameras[1].params[3] == (0.0 if leaves else distortion)
    assert model.cameras[1].params[3] == distortion


@pytest.mark.parametrize(("distortion", "num_adjusted"), [(TRAP, 2), (0.0, 1)])
def test_a_straight_lens_is_adjusted_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    distortion: float,
    num_adjusted: int,
) -> None:
    path = tmp_path / "database.db"
    model = synthesize(path, num_rigs=3, num_points3D=80, camera_params=PARAMS)
    model.cameras[1].params = [*PARAMS[:3], distortion]
    record = CameraRecord(("a",), "guess", PARAMS[0], size=(1024, 768))
    search = search_of(path, record)
    costs = iter([7.0, 5.0])
    monkeypatch.setattr(Adjuster, "adjust", lambda *_: next(costs))
    expected = (7.0, 5.0) if num_adjusted == 2 else (7.0, 7.0)
    assert search.costs_of_starts(model) == expected
    assert len(list(costs)) == 2 - num_adjusted


def test_a_straight_lens_that_fewer_pairs_agree_with_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    model = synthesize(
        path, num_rigs=3, num_points3D=80, noise_px=0.4, camera_params=PARAMS
    )
    model.cameras[1].params = [*PARAMS[:3], TRAP]
    record = CameraRecord(("a",), "guess", PARAMS[0], size=(1024, 768))
    search = search_of(path, record)

    def score(_: ModelScorer, scored: pycolmap.Reconstruction) -> float:
        return 0.0 if scored is model else -2.0 * MIN_SCORE_GAIN

    monkeypatch.setattr(ModelScorer, "score", score)
    assert search.from_straight_lens(model) is model
