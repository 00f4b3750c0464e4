"""Models that points of common photographs, or of pairs between them, join to one."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import model_poses, pose_errors, relative_pose
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.camera_priors import USUAL_SIGMA, CameraPrior
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN, ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.point_joining import (
    BY_POINTS,
    PointJoiner,
    joined_by_points,
)
from colmap_affrect.mappers.search import Search

NUM_IMAGES = 6
MOVED = pycolmap.Sim3d(
    2.0, pycolmap.Rotation3d(np.array([0.2, 0.1, 0.3])), np.array([5.0, -3.0, 1.0])
)


@pytest.fixture
def truth(tmp_path: Path) -> pycolmap.Reconstruction:
    return synthesize(
        tmp_path / "database.db", num_rigs=NUM_IMAGES, num_points3D=120, noise_px=0.3
    )


def search_of(folder: Path, graph: PairGraph) -> Search:
    """Return a search that works with the pairs of a graph."""
    task = task_with_given_cameras(folder / "database.db")
    mapper = mapper_of("sparse")
    found: Search = mapper._search(task, graph, mapper.native(task, 0), lambda _: None)
    return found


def part_of(truth: pycolmap.Reconstruction, numbers: range) -> MappedModel:
    """Return a model of some of the images, by their numbers."""
    part = pycolmap.Reconstruction(truth)
    for number, image_id in enumerate(sorted(truth.reg_image_ids())):
        if number not in numbers:
            part.deregister_frame(part.images[image_id].frame_id)
    return MappedModel(part, hypotheses=("with all pairs",))


def moved(part: MappedModel) -> MappedModel:
    part.reconstruction.transform(MOVED)
    return part


def worst_error_deg(
    model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction
) -> float:
    poses = model_poses(model)
    true = model_poses(truth)
    errors = [0.0]
    for first, second in combinations(poses, 2):
        found = relative_pose(poses[first], poses[second])
        errors += pose_errors(found, relative_pose(true[first], true[second]))
    return max(errors)


@pytest.mark.parametrize("begin", [3, 2])
def test_models_are_joined_by_pairs_between_them_and_by_common_photographs(
    truth: pycolmap.Reconstruction, tmp_path: Path, begin: int
) -> None:
    graph = PairGraph.read(tmp_path / "database.db")
    first = part_of(truth, range(3))
    second = moved(part_of(truth, range(begin, NUM_IMAGES)))
    (whole,) = joined_by_points(search_of(tmp_path, graph), [first, second])
    assert whole.reconstruction.num_reg_images() == NUM_IMAGES
    assert worst_error_deg(whole.reconstruction, truth) < 0.5
    assert whole.hypotheses == ("with all pairs", BY_POINTS)


def test_models_that_only_a_common_photograph_ties_are_joined(
    truth: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    """No pair speaks for it, nor against it; points that it sees in both models do."""
    ids = sorted(truth.reg_image_ids())
    between = {(one, two) for one in ids[:2] for two in ids[3:]}
    graph = PairGraph.read(tmp_path / "database.db").without(between)
    parts = [part_of(truth, range(3)), moved(part_of(truth, range(2, NUM_IMAGES)))]
    (whole,) = joined_by_points(search_of(tmp_path, graph), parts)
    assert whole.reconstruction.num_reg_images() == NUM_IMAGES
    assert worst_error_deg(whole.reconstruction, truth) < 0.5


def test_models_stay_apart_whose_points_agree_on_no_similarity(
    truth: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    graph = PairGraph.read(tmp_path / "database.db")
    second = part_of(truth, range(3, NUM_IMAGES))
    random = np.random.default_rng(1)
    for point in second.reconstruction.points3D.values():
        point.xyz = random.uniform(-5.0, 5.0, 3)
    parts = [part_of(truth, range(3)), second]
    assert len(joined_by_points(search_of(tmp_path, graph), parts)) == 2


def test_models_stay_apart_that_no_pair_and_no_photograph_ties(
    truth: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    ids = sorted(truth.reg_image_ids())
    between = {(one, two) for one in ids[:3] for two in ids[3:]}
    graph = PairGraph.read(tmp_path / "database.db").without(between)
    parts = [part_of(truth, range(3)), part_of(truth, range(3, NUM_IMAGES))]
    assert len(joined_by_points(search_of(tmp_path, graph), parts)) == 2


def test_a_model_without_an_image_of_its_own_is_left_as_it_is(
    truth: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    graph = PairGraph.read(tmp_path / "database.db")
    parts = [part_of(truth, range(4)), part_of(truth, range(1, 3))]
    assert joined_by_points(search_of(tmp_path, graph), parts) == parts


def test_an_unusual_lens_of_both_models_speaks_for_no_whole(tmp_path: Path) -> None:
    """What it costs counts once: it is one camera."""
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=1, num_frames_per_rig=6, num_points3D=120)
    ids = sorted(truth.reg_image_ids())
    between = {(one, two) for one in ids[:3] for two in ids[3:]}
    graph = PairGraph.read(path).without(between)
    search = search_of(tmp_path, graph)
    (camera,) = truth.cameras.values()
    unusual = CameraPrior(camera.mean_focal_length() / 4.0, USUAL_SIGMA)
    assert unusual.cost_of(camera) > MIN_SCORE_GAIN
    scorer = ModelScorer(graph, {camera.camera_id: unusual})
    joiner = PointJoiner(search.grower(graph), scorer)
    parts = part_of(truth, range(3)), part_of(truth, range(3, NUM_IMAGES))
    assert not joiner._is_better(truth, *parts)
