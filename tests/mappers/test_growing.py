"""Growing a model: when all of it is adjusted, what makes a first pair, and restarts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import SEED, mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FAST, NOISE_PX, Adjuster
from colmap_affrect.mappers.camera_priors import camera_priors
from colmap_affrect.mappers.growing import Grower
from colmap_affrect.mappers.pair_graph import PairGraph, poses_of

NUM_IMAGES = 15


class Recorder(Adjuster):
    """Notes of each adjustment how many images the model has, and whether all are adjusted."""

    calls: list[tuple[int, bool]] = []  # noqa: RUF012 - one list for all tests, cleared by each

    def adjust(
        self,
        model: pycolmap.Reconstruction,
        max_iterations: int,
        *given: Any,
        **more: Any,
    ) -> float:
        is_global = not given or given[0] is None
        if max_iterations == FAST:
            self.calls.append((model.num_reg_images(), is_global))
        return super().adjust(model, max_iterations, *given, **more)


def grower_of(path: Path, init_min_num_inliers: int = 1) -> Grower:
    """What grows models of a database, and records its adjustments."""
    Recorder.calls.clear()
    task = task_with_given_cameras(path)
    graph = PairGraph.read(path)
    mapper = mapper_of("sparse", init_min_num_inliers=init_min_num_inliers)
    native = mapper.native(task, SEED)
    priors = camera_priors(graph.cameras.values(), task.cameras, {})
    refining = native.get_global_bundle_adjustment()
    adjuster = Recorder(priors, NOISE_PX, refining, frozenset(priors))
    return Grower(graph, adjuster, native, lambda _: None)


def test_a_stopped_model_takes_no_more_images(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db", num_rigs=4, num_points3D=150)
    grower = grower_of(tmp_path / "database.db")
    grown = {pair.ids: grower.grow(pair.ids) for pair in grower.graph.pairs}
    first = next(ids for ids, model in grown.items() if model)
    whole = grown[first]
    assert whole is not None
    assert whole.num_reg_images() == 4
    grower.stop()
    stopped = grower.grow(first)
    assert stopped is not None
    assert stopped.num_reg_images() == 3  # its next image is the last one


def test_all_is_adjusted_after_each_of_ten_images_and_then_as_the_model_grows(
    tmp_path: Path,
) -> None:
    synthesize(tmp_path / "database.db", num_rigs=NUM_IMAGES, num_points3D=80)
    grower = grower_of(tmp_path / "database.db")
    models = (grower.grow(pair.ids) for pair in grower.graph.pairs)
    model = next(model for model in models if model)
    assert model.num_reg_images() == NUM_IMAGES
    sizes = [size for size, is_global in Recorder.calls if is_global]
    assert sizes[:9] == list(range(2, 11))
    assert sizes[9:] == [12, 14]  # 1.15 times as many as before
    assert [size for size, is_global in Recorder.calls if not is_global] == [11, 13, 15]


@pytest.mark.parametrize(
    ("num_points", "makes_a_model"), [(40, True), (16, True), (8, False)]
)
def test_a_first_pair_needs_ten_points(
    tmp_path: Path, num_points: int, *, makes_a_model: bool
) -> None:
    synthesize(tmp_path / "database.db", num_rigs=2, num_points3D=num_points)
    grower = grower_of(tmp_path / "database.db")
    grower.graph = PairGraph.read(tmp_path / "database.db", 1)
    (pair,) = grower.graph.pairs
    assert (grower.grow(pair.ids) is not None) == makes_a_model


@pytest.mark.parametrize(("num_points", "least"), [(30, 24), (200, 40)])
def test_a_first_pair_may_have_four_fifths_of_the_inliers_of_the_strongest_where_all_have_few(
    tmp_path: Path, num_points: int, least: int
) -> None:
    synthesize(tmp_path / "database.db", num_rigs=2, num_points3D=num_points)
    grower = grower_of(tmp_path / "database.db", init_min_num_inliers=40)
    assert max(len(pair.matches) for pair in grower.graph.pairs) == num_points
    assert grower._options_of_first().init_min_num_inliers == least


def test_a_restart_keeps_poses_and_finds_points_anew(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=4, num_points3D=80)
    grower = grower_of(tmp_path / "database.db")
    found = grower.restart_from(truth)
    assert found is not truth
    assert found.num_points3D() > 70
    for image_id, (rotation, _) in poses_of(truth).items():
        np.testing.assert_allclose(poses_of(found)[image_id][0], rotation, atol=1e-3)


def test_images_of_a_model_stay_when_others_are_registered(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=4, num_points3D=80)
    grower = grower_of(tmp_path / "database.db")
    part = pycolmap.Reconstruction(truth)
    last = max(truth.reg_image_ids())
    part.deregister_frame(part.images[last].frame_id)
    pose = poses_of(truth)[last]
    cameras = {last: truth.images[last].camera}
    whole = grower.register_at({last: pose}, cameras, part)
    assert whole is part
    assert whole.num_reg_images() == 4
    np.testing.assert_allclose(poses_of(whole)[last][0], pose[0], atol=1e-3)
