"""Models that are surely wrong: what is mapped in their place, and what is told of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import pose_errors, read_poses, relative_pose
from colmap_affrect.mappers import scored_models
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.pair_graph import PairGraph, cameras_of, poses_of
from colmap_affrect.mappers.reliability import Confidence
from colmap_affrect.mappers.wrong_models import (
    NUM_OTHER_HYPOTHESES,
    THROWN_AWAY,
    WITHOUT_FALSE_PAIRS,
    StoodOn,
    ThrownAway,
    pairs_stood_on,
    pairs_to_leave_out,
    read_thrown_away,
    write_thrown_away,
)
from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import NO_MODEL
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.map import _why_lost

NUM_IMAGES = 4
SURELY_WRONG = Confidence(0.01, (Doubt("little_agreement", {"percent": 9}),))
SURE = Confidence(0.95, ())
Score = Callable[..., Mapping[str, Confidence]]


@dataclass
class Scene:
    """A verified database, and what is true of it."""

    path: Path
    truth: pycolmap.Reconstruction

    @property
    def last(self) -> int:
        return int(max(self.truth.reg_image_ids()))

    @property
    def names(self) -> list[str]:
        return sorted(image.name for image in self.truth.images.values())


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    path = tmp_path / "database.db"
    return Scene(path, synthesize(path, num_rigs=NUM_IMAGES, num_points3D=100))


def turned(scene: Scene) -> pycolmap.Reconstruction:
    """Return a model whose last image is turned by 23 degrees: its pairs disagree."""
    model = pycolmap.Reconstruction(scene.truth)
    image = model.images[scene.last]
    turn = pycolmap.Rotation3d(np.array([0.0, 0.4, 0.0]))
    wrong = pycolmap.Rigid3d(turn, np.zeros(3)) * image.cam_from_world()
    image.frame.set_cam_from_world(image.camera_id, wrong)
    return model


@dataclass
class WrongAtFirst:
    """Makes a wrong model at first, and by some of the pairs what the sparse mapper makes."""

    scene: Scene
    tasks: list[MappingTask] = field(default_factory=list)
    sparse: Any = field(default_factory=lambda: mapper_of("sparse"))

    @property
    def options(self) -> Any:
        return self.sparse.options

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        self.tasks.append(task)
        if task.without_pairs:
            return list(self.sparse.map(task, *others))
        return [MappedModel(turned(self.scene))]


def scored_by(right: str) -> Score:
    """Return what is sure of models that a hypothesis made, and of no others."""

    def score(mapped: MappedModel, *_: Any) -> dict[str, Confidence]:
        one = SURE if right in mapped.hypotheses else SURELY_WRONG
        model = mapped.reconstruction
        return {model.images[i].name: one for i in model.reg_image_ids()}

    return score


def test_photographs_of_a_wrong_model_are_mapped_without_the_pairs_it_stood_on(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scored_models, "score_images", scored_by(WITHOUT_FALSE_PAIRS))
    mapper = WrongAtFirst(scene)
    sparse = tmp_path / "sparse"
    task = task_with_given_cameras(scene.path)
    (summary,) = map_database(mapper, task, sparse, lambda _: None)
    others = sorted(set(scene.truth.reg_image_ids()) - {scene.last})
    assert mapper.tasks[1].without_pairs == set(combinations(others, 2))
    assert WITHOUT_FALSE_PAIRS in summary.hypotheses
    poses = read_poses(sparse / "0")
    truth = {
        image.name: (m[:, :3], m[:, 3])
        for image in scene.truth.images.values()
        for m in [image.cam_from_world().matrix()]
    }
    assert len(poses) == NUM_IMAGES
    for first, second in combinations(poses, 2):
        found = relative_pose(poses[first], poses[second])
        true = relative_pose(truth[first], truth[second])
        assert max(pose_errors(found, true)) < 0.5
    assert not (sparse / THROWN_AWAY).exists()


def test_where_every_model_is_wrong_trials_end_and_each_photograph_has_a_reason(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scored_models, "score_images", scored_by("none is right"))
    mapper = WrongAtFirst(scene)
    sparse = tmp_path / "sparse"
    task = task_with_given_cameras(scene.path)
    assert map_database(mapper, task, sparse, lambda _: None) == []
    assert 2 <= len(mapper.tasks) <= 1 + NUM_OTHER_HYPOTHESES
    known = read_thrown_away(sparse)
    assert sorted(known.doubts) == scene.names
    assert list(known.doubts.values()) == NUM_IMAGES * [SURELY_WRONG.reasons]
    assert len(known.stood_on) == NUM_IMAGES * (NUM_IMAGES - 1) // 2


def test_a_mapper_that_takes_all_pairs_maps_once(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scored_models, "score_images", scored_by("none is right"))
    mapper = WrongAtFirst(scene, sparse=mapper_of("incremental"))
    task = task_with_given_cameras(scene.path)
    map_database(mapper, task, tmp_path / "sparse", lambda _: None)
    assert len(mapper.tasks) == 1


def test_a_model_stands_on_the_pairs_stood_on_with_it(scene: Scene) -> None:
    graph = PairGraph.read(scene.path)
    ids = sorted(scene.truth.reg_image_ids())

    def stood_on(model: pycolmap.Reconstruction) -> set[tuple[int, int]]:
        return pairs_stood_on(graph, poses_of(model), cameras_of(model))

    assert stood_on(scene.truth) == set(combinations(ids, 2))
    assert stood_on(turned(scene)) == set(combinations(ids[:-1], 2))
    two = turned(scene)
    for image_id in ids[1:-1]:
        two.deregister_frame(two.images[image_id].frame_id)
    assert stood_on(two) == {(ids[0], ids[-1])}  # which disagrees


def test_pairs_are_left_out_that_a_wrong_model_stood_on_or_are_of_other_images(
    scene: Scene,
) -> None:
    graph = PairGraph.read(scene.path)
    first, second, third, fourth = sorted(scene.truth.reg_image_ids())
    left_out = pairs_to_leave_out(graph, [first, second, third], {(first, second)})
    assert left_out == {
        (first, second),
        (first, fourth),
        (second, fourth),
        (third, fourth),
    }
    all_of_two = pairs_to_leave_out(graph, [first, second], {(first, second)})
    assert not all_of_two  # nothing is left to map


def test_what_a_wrong_model_stood_on_is_kept_and_damage_of_that_hinders_nothing(
    tmp_path: Path,
) -> None:
    known = ThrownAway({"a": (Doubt("few_matches"),)}, (StoodOn("a", "b", 40),))
    write_thrown_away(known, tmp_path)
    assert read_thrown_away(tmp_path) == known
    assert known.num_inliers() == {("a", "b"): 40, ("b", "a"): 40}
    (tmp_path / THROWN_AWAY).write_text("{", encoding="utf-8")
    assert read_thrown_away(tmp_path) == ThrownAway()
    assert read_thrown_away(tmp_path / "nowhere") == ThrownAway()
    write_thrown_away(ThrownAway(), tmp_path / "nowhere")


def test_models_may_be_made_anew_beside_what_is_known_of_wrong_ones(
    tmp_path: Path,
) -> None:
    workspace = Workspace(tmp_path)
    workspace.sparse.mkdir()
    write_thrown_away(ThrownAway({"a": (Doubt("few_matches"),)}), workspace.sparse)
    workspace.refuse_foreign_models()


def test_the_last_photograph_of_a_wrong_model_has_its_own_reason(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(SURELY_WRONG, reasons=(Doubt("few_matches"),))

    def score(mapped: MappedModel, *_: Any) -> dict[str, Confidence]:
        model = mapped.reconstruction
        names = sorted(model.images[i].name for i in model.reg_image_ids())
        return {name: few if name == names[-1] else SURELY_WRONG for name in names}

    monkeypatch.setattr(scored_models, "score_images", score)
    task = task_with_given_cameras(scene.path)
    (scored,) = scored_models.scored_places(MappedModel(scene.truth), task)
    reasons = {name: one.reasons for name, one in scored.taken_out.items()}
    assert sorted(reasons) == scene.names
    assert reasons[scene.names[-1]] == few.reasons


def test_photographs_of_a_wrong_model_are_told_from_those_that_were_in_none() -> None:
    known = ThrownAway({"a": SURELY_WRONG.reasons})
    pairs = {"b": 40}
    why = _why_lost("a", pairs, NO_MODEL, known)
    assert why == Missing("wrong_model", 0, pairs, SURELY_WRONG.reasons)
    assert why.fate() == f"its model was surely wrong: {SURELY_WRONG.reasons[0].text()}"
    assert _why_lost("c", pairs, NO_MODEL, known).code == "not_registered"
    assert _why_lost("a", {}, NO_MODEL, known).code == "no_verified_pair"
