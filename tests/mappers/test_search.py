"""Mapping as one estimate: priors of focal lengths, evidence, models."""

from __future__ import annotations

import math
import sqlite3
import threading
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from mapping_tasks import WHOLE, mapper_of, synthesize, task_with_given_cameras
from wall_scene import views, write_scene

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.mappers import adjustment
from colmap_affrect.mappers import search as mappers_search
from colmap_affrect.mappers.adjustment import FINAL, Adjuster
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.bridging import BridgeFinder
from colmap_affrect.mappers.camera_priors import (
    EXIF_SIGMA,
    USUAL_FOCAL,
    USUAL_SIGMA,
    ZOOMS,
    CameraPrior,
    camera_prior,
    camera_priors,
)
from colmap_affrect.mappers.growing import Grower
from colmap_affrect.mappers.hypotheses import COLMAP_MODEL, PER_IMAGE_CAMERAS
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.model_score import (
    MIN_SCORE_GAIN,
    ModelScorer,
    pair_log_ratio,
)
from colmap_affrect.mappers.pair_graph import PairGraph, VerifiedPair, cameras_of
from colmap_affrect.mappers.search import Search, _Attempt, _grow_in_order, first_pairs

TRUE_FOCAL = 1280.0
SIZE = (1024, 768)
NUM_IMAGES = 4
NOISE_PX = 0.5
UNKNOWN = CameraRecord(("a",), "guess", 1000.0, size=SIZE)
Scene = tuple[Path, pycolmap.Reconstruction]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A verified database of images with a camera each, and the truth."""
    path = tmp_path_factory.mktemp("scene") / "database.db"
    return path, synthesize(
        path, num_rigs=NUM_IMAGES, num_points3D=150, noise_px=NOISE_PX
    )


@pytest.fixture
def model(scene: Scene) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(scene[1])


def task_of(scene: Scene, record: CameraRecord) -> MappingTask:
    cameras = {key: replace(record) for key in scene[1].cameras}
    return MappingTask(scene[0], None, cameras=cameras)


def focals(model: pycolmap.Reconstruction) -> list[float]:
    return [camera.mean_focal_length() for camera in model.cameras.values()]


def widen(model: pycolmap.Reconstruction, factor: float) -> None:
    """Multiply the focal lengths."""
    for camera in model.cameras.values():
        camera.params = [factor * camera.params[0], *camera.params[1:]]


def adjuster(
    model: pycolmap.Reconstruction, prior: CameraPrior, noise_px: float = NOISE_PX
) -> Adjuster:
    priors = dict.fromkeys(model.cameras, prior)
    return Adjuster(priors, noise_px, pycolmap.BundleAdjustmentOptions())


@pytest.mark.parametrize(("record", "focal_px", "sigma"), [
    (WHOLE, TRUE_FOCAL, 0.0),
    (replace(UNKNOWN, source="exif"), TRUE_FOCAL, EXIF_SIGMA),
    (UNKNOWN, USUAL_FOCAL * SIZE[0], USUAL_SIGMA),
    (None, USUAL_FOCAL * SIZE[0], USUAL_SIGMA),
])  # fmt: skip
def test_what_is_known_of_a_focal_length(
    record: CameraRecord | None, focal_px: float, sigma: float
) -> None:
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", TRUE_FOCAL, *SIZE
    )
    assert camera_prior(camera, record) == CameraPrior(focal_px, sigma)


def test_a_prior_costs_by_its_deviation_and_nothing_where_it_is_held() -> None:
    prior = CameraPrior(1000.0, 0.2)
    assert prior.cost(1000.0) == 0.0
    assert prior.cost(1000.0 * math.exp(0.4)) == pytest.approx(2.0)
    assert prior.cost(1000.0 * math.exp(-0.4)) == pytest.approx(2.0)
    assert CameraPrior(1000.0, 0.0).cost(2000.0) == 0.0


def test_adjustment_finds_focal_lengths_that_points_know(
    model: pycolmap.Reconstruction,
) -> None:
    widen(model, 1.1)
    adjuster(model, CameraPrior(USUAL_FOCAL * SIZE[0], USUAL_SIGMA)).adjust(
        model, FINAL
    )
    assert focals(model) == pytest.approx([TRUE_FOCAL] * NUM_IMAGES, rel=0.02)


def test_noisier_keypoints_leave_focal_lengths_nearer_to_the_prior(
    model: pycolmap.Reconstruction,
) -> None:
    prior = CameraPrior(0.8 * TRUE_FOCAL, 0.05)
    exact, noisy = (pycolmap.Reconstruction(model) for _ in range(2))
    adjuster(exact, prior, 0.4).adjust(exact, FINAL)
    adjuster(noisy, prior, 3.0).adjust(noisy, FINAL)
    assert np.mean(focals(noisy)) < np.mean(focals(exact)) - 0.01 * TRUE_FOCAL


def test_given_focal_lengths_stay_to_the_bit(model: pycolmap.Reconstruction) -> None:
    widen(model, 1.1)
    before = [camera.params[:3].tolist() for camera in model.cameras.values()]
    adjuster(model, CameraPrior(1.1 * TRUE_FOCAL, 0.0)).adjust(model, FINAL)
    assert [camera.params[:3].tolist() for camera in model.cameras.values()] == before


def test_an_adjustment_of_some_images_leaves_the_others_where_they_are(
    model: pycolmap.Reconstruction,
) -> None:
    *some, last = sorted(model.reg_image_ids())
    before = model.images[last].cam_from_world().matrix()
    adjuster(model, CameraPrior(TRUE_FOCAL, 0.0)).adjust(model, FINAL, some)
    assert (model.images[last].cam_from_world().matrix() == before).all()


@pytest.mark.parametrize(("agreeing", "num"), [(20, 20), (40, 40)])
def test_more_agreement_is_more_score_and_contradiction_costs_little(
    agreeing: int, num: int
) -> None:
    shares = [pair_log_ratio(agreeing * part / 4, num) for part in range(5)]
    assert shares == sorted(shares)
    assert shares[0] < 0 < shares[-1]
    assert shares[0] >= math.log(0.05)


def test_a_wrong_pose_and_an_unlikely_lens_have_a_lower_score(
    scene: Scene, model: pycolmap.Reconstruction
) -> None:
    prior = dict.fromkeys(model.cameras, CameraPrior(TRUE_FOCAL, EXIF_SIGMA))
    graph = PairGraph.read(scene[0])
    right = ModelScorer(graph, prior).score(model)
    unlikely = dict.fromkeys(model.cameras, CameraPrior(2 * TRUE_FOCAL, EXIF_SIGMA))
    assert ModelScorer(graph, unlikely).score(model) < right - 3.0
    image = model.images[max(model.reg_image_ids())]
    turned = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.0, 0.5, 0.0])), np.zeros(3)
    )
    image.frame.rig_from_world = turned * image.frame.rig_from_world
    assert ModelScorer(graph, prior).score(model) < right - 3.0


@pytest.fixture
def found(scene: Scene, tmp_path: Path) -> list[Any]:
    """Summaries of the models of cameras that nobody knows."""
    return map_database(
        mapper_of("sparse"),
        task_of(scene, UNKNOWN),
        tmp_path / "sparse",
        lambda _: None,
    )


def test_cameras_that_nobody_knows_come_out_right_and_the_same_each_time(
    scene: Scene, found: list[Any], tmp_path: Path
) -> None:
    assert [len(model.registered_names) for model in found] == [NUM_IMAGES]
    assert list(found[0].focals_px.values()) == pytest.approx(
        [TRUE_FOCAL] * NUM_IMAGES, rel=0.05
    )
    again = map_database(
        mapper_of("sparse"), task_of(scene, UNKNOWN), tmp_path / "again", lambda _: None
    )
    assert again[0].focals_px == found[0].focals_px


@pytest.mark.parametrize("keep", [True, False])
def test_given_focal_lengths_are_refined_where_that_is_asked_for(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, keep: bool
) -> None:
    held = []
    adjust = adjustment.Adjuster.adjust

    def recorded(self: Adjuster, *given: Any) -> float:
        held.append({key for key, prior in self.priors.items() if not prior.sigma})
        return adjust(self, *given)

    monkeypatch.setattr(adjustment.Adjuster, "adjust", recorded)
    mapper = mapper_of("sparse", keep_given_intrinsics=keep)
    task = task_with_given_cameras(scene[0])
    (found,) = mapper.map(task, tmp_path, 0, lambda _: None)
    assert set().union(*held) == (set(task.cameras) if keep else set())
    assert (set(focals(found.reconstruction)) == {TRUE_FOCAL}) is keep


def test_an_adjustment_of_some_images_holds_cameras_that_others_share(
    tmp_path: Path,
) -> None:
    model = write_shared(tmp_path / "database.db", TRUE_FOCAL, 150)
    (camera,) = model.cameras.values()
    widen(model, 1.05)
    before = camera.params.tolist()
    some = sorted(model.reg_image_ids())[:3]
    adjuster(model, CameraPrior(TRUE_FOCAL, USUAL_SIGMA)).adjust(model, FINAL, some)
    assert camera.params.tolist() == before


def write_shared(
    path: Path, focal_px: float, num_points: int
) -> pycolmap.Reconstruction:
    """Write verified pairs of four images that share a camera; return the truth."""
    params = [focal_px, SIZE[0] / 2, SIZE[1] / 2, 0.0]
    return synthesize(
        path, num_rigs=1, num_frames_per_rig=4, num_points3D=num_points, camera_params=params,
        noise_px=NOISE_PX,
    )  # fmt: skip


@pytest.mark.parametrize("focal_px", [700.0, 2600.0])
def test_a_camera_that_images_share_is_found_from_wide_to_long(
    tmp_path: Path, focal_px: float
) -> None:
    truth = write_shared(tmp_path / "database.db", focal_px, 600)
    (camera,) = truth.cameras
    task = MappingTask(tmp_path / "database.db", None, cameras={camera: UNKNOWN})
    model, *_ = map_database(
        mapper_of("sparse"), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 4
    assert list(model.focals_px.values()) == pytest.approx([focal_px] * 4, rel=0.03)


@pytest.mark.parametrize(
    ("options", "num_images"), [({}, 2), ({"max_focal_length_ratio": 10}, 0)]
)
def test_a_narrow_lens_makes_a_model_unless_that_is_forbidden(
    tmp_path: Path, options: dict[str, Any], num_images: int
) -> None:
    focal_px = 12.0 * SIZE[0]
    write_shared(
        tmp_path / "database.db", focal_px, 20_000
    )  # two images see the same of them
    task = MappingTask(
        tmp_path / "database.db", None, cameras={1: replace(WHOLE, focal_px=focal_px)}
    )
    found = map_database(
        mapper_of("sparse", **options), task, tmp_path / "sparse", lambda _: None
    )
    assert sum(len(model.registered_names) for model in found) == num_images


def test_features_of_three_images_confirm_a_model_until_their_points_are_gone(
    scene: Scene, model: pycolmap.Reconstruction
) -> None:
    scorer = ModelScorer(PairGraph.read(scene[0]), {})
    assert scorer.is_confirmed(model)
    before = sum(scorer.track_log_ratios(model).values())
    last = max(model.reg_image_ids())
    for index in model.images[last].get_observation_point2D_idxs():
        model.delete_observation(last, index)
    assert not scorer.is_confirmed(model)
    assert sum(scorer.track_log_ratios(model).values()) < before - 2 * MIN_SCORE_GAIN


@dataclass(frozen=True)
class RecordingSearch(Search):
    """Notes with which focal lengths models are made, in px."""

    tried_px: list[float] = field(default_factory=list)

    def with_bridges(
        self, graph: PairGraph, models: Sequence[MappedModel]
    ) -> list[MappedModel]:
        self.tried_px.append(self.adjuster.priors[1].focal_px)
        return super().with_bridges(graph, models)


def test_bridges_are_built_anew_with_a_focal_length_that_a_model_has_found(
    tmp_path: Path,
) -> None:
    """The first one is off by 15 per cent."""
    path = tmp_path / "database.db"
    matrix = np.array([[977.5, 0.0, 480.0], [0.0, 977.5, 360.0], [0.0, 0.0, 1.0]])
    write_scene(path, views(4), [(0, 1), (1, 2), (2, 3)], matrix)
    record = CameraRecord(("a",), "guess", 1200.0, size=(1000, 700))
    native = mapper_of("sparse").native(MappingTask(path, None, cameras={1: record}), 0)
    native.mapper.init_max_forward_motion = 1.0
    graph = PairGraph.read(path)
    priors = camera_priors(graph.cameras.values(), {1: record}, {})
    adjuster = Adjuster(priors, 0.7, native.get_global_bundle_adjustment())
    search = RecordingSearch(
        adjuster, ModelScorer(graph, priors), native, 6, lambda _: None
    )
    (found,) = search.best(graph)
    assert found.reconstruction.num_reg_images() == 4
    assert search.tried_px == pytest.approx([USUAL_FOCAL * 1000, 977.5], rel=0.02)


@dataclass(frozen=True)
class NeverCertain(RecordingSearch):
    """Tries all focal lengths."""

    def is_certain(self, *_: Any, **__: Any) -> bool:
        return False


def test_cameras_of_one_image_each_begin_at_focal_lengths_from_wide_to_long(
    scene: Scene,
) -> None:
    task = task_of(scene, UNKNOWN)
    native = mapper_of("sparse").native(task, 0)
    graph = PairGraph.read(scene[0])
    priors = camera_priors(graph.cameras.values(), task.cameras, {})
    adjuster = Adjuster(priors, NOISE_PX, native.get_global_bundle_adjustment())
    search = NeverCertain(
        adjuster, ModelScorer(graph, priors), native, 1, lambda _: None
    )
    (found,) = search.best(graph)
    assert focals(found.reconstruction) == pytest.approx(
        [TRUE_FOCAL] * NUM_IMAGES, rel=0.03
    )
    for zoom in ZOOMS:
        assert (
            min(
                abs(tried / (zoom * USUAL_FOCAL * SIZE[0]) - 1)
                for tried in search.tried_px
            )
            < 0.01
        )


def unknown_search(scene: Scene, kind: type[Search], **values: Any) -> Any:
    """Return a search of one kind for cameras that nobody knows."""
    task = task_of(scene, UNKNOWN)
    native = mapper_of("sparse").native(task, 0)
    graph = PairGraph.read(scene[0])
    priors = camera_priors(graph.cameras.values(), task.cameras, {})
    adjuster = Adjuster(priors, NOISE_PX, native.get_global_bundle_adjustment())
    scorer = ModelScorer(graph, priors)
    return kind(adjuster, scorer, native, 6, lambda _: None, **values)


@dataclass(frozen=True)
class RisingSearch(Search):
    """Each attempt is better than those before, and lacks an image."""

    model: pycolmap.Reconstruction | None = None
    built_bridges: list[bool] = field(default_factory=list)

    def is_certain(self, *_: Any, **__: Any) -> bool:
        return False

    def _attempt(self, search: Search, _: PairGraph) -> _Attempt:
        assert self.model is not None
        self.built_bridges.append(search.builds_bridges)
        found = [MappedModel(pycolmap.Reconstruction(self.model))]
        return _Attempt(found, float(len(self.built_bridges)), focals_agree=True)


def without_last(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return a copy that lacks the last image."""
    less = pycolmap.Reconstruction(model)
    image = less.images[max(less.reg_image_ids())]
    less.deregister_frame(image.frame_id)
    return less


def test_focal_lengths_that_win_without_bridges_are_tried_with_them(
    scene: Scene, model: pycolmap.Reconstruction
) -> None:
    search = unknown_search(scene, RisingSearch, model=without_last(model))
    search.best(search.graph)
    assert search.built_bridges == [True] + [False, True] * (len(ZOOMS) - 1)
    search = unknown_search(scene, RisingSearch, model=model)
    search.best(search.graph)  # no bridge is missing
    assert search.built_bridges == [True] + [False] * (len(ZOOMS) - 1)


def test_a_search_without_bridges_keeps_models_of_other_images(
    scene: Scene, model: pycolmap.Reconstruction
) -> None:
    models = []
    ids = sorted(model.reg_image_ids())
    for lost in (ids[2:], ids[:2], ids[:3]):
        part = pycolmap.Reconstruction(model)
        for image_id in lost:
            part.deregister_frame(part.images[image_id].frame_id)
        models.append(MappedModel(part))
    search = unknown_search(scene, Search, builds_bridges=False)
    assert search.with_bridges(search.graph, models) == models[:2]


def test_each_model_has_bridges_of_its_own_cameras(
    scene: Scene, model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relative poses that are kept for another model may be of other focal lengths."""
    finders = list[BridgeFinder]()

    def register(mapped: MappedModel, bridges: BridgeFinder, *_: Any) -> MappedModel:
        finders.append(bridges)
        return mapped

    monkeypatch.setattr(mappers_search, "register_bridges", register)
    search = unknown_search(scene, Search)
    models = [MappedModel(without_last(model)), MappedModel(without_last(model))]
    search.with_bridges(search.graph, models)
    assert len({id(finder) for finder in finders}) == 2


def test_a_search_ends_after_as_many_failing_first_pairs_as_colmaps(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = unknown_search(scene, Search, tries_focals=False)
    tried = list[tuple[int, int]]()

    def fail(_: Grower, pair: tuple[int, int]) -> None:
        tried.append(pair)

    monkeypatch.setattr(Grower, "grow", fail)
    assert search.best(search.graph) == []
    assert len(tried) == len(search.graph.pairs) == 6
    tried.clear()
    search.native.init_num_trials = 1
    assert search.best(search.graph) == []
    assert len(tried) == 1


def test_bridges_begin_with_the_priors_of_cameras_that_a_model_has_not_used(
    scene: Scene, model: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database has other focal lengths."""
    search = unknown_search(scene, Search)
    prior_px = 1.01 * TRUE_FOCAL
    for key, prior in search.adjuster.priors.items():
        search.adjuster.priors[key] = replace(prior, focal_px=prior_px)
    less = without_last(model)
    found = BridgeFinder(search.graph, search.adjuster, 0).find(less)
    assert found
    for hypothesis in found:
        assert hypothesis.camera.mean_focal_length() == pytest.approx(prior_px)
    focals_px = dict[int, float]()

    def note(_: Grower, mapper: pycolmap.IncrementalMapper) -> None:
        for image in mapper.reconstruction.images.values():
            focals_px[image.image_id] = image.camera.mean_focal_length()

    monkeypatch.setattr(Grower, "_complete", note)
    search.grower(search.graph).restart_from(less)
    assert focals_px.pop(max(focals_px)) == pytest.approx(prior_px)
    assert set(focals_px.values()) == {TRUE_FOCAL}


def test_colmaps_own_model_is_taken_where_ours_scores_lower(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Search, "best", lambda *_: [])
    (found,) = mapper_of("sparse").map(
        task_of(scene, UNKNOWN), tmp_path, 0, lambda _: None
    )
    assert found.hypotheses == (COLMAP_MODEL,)
    assert focals(found.reconstruction) == pytest.approx(
        [TRUE_FOCAL] * NUM_IMAGES, rel=0.05
    )
    assert not mapper_of("sparse").map(
        task_with_given_cameras(scene[0]), tmp_path, 0, lambda _: None
    )


def test_models_begin_with_the_strongest_pairs_of_two_frames() -> None:
    geometry = pycolmap.TwoViewGeometry()
    pairs = []
    for ids, num in (((1, 3), 20), ((1, 2), 90), ((2, 3), 40)):
        pairs.append(VerifiedPair(ids, np.zeros((num, 2), np.int64), geometry))
    frames = {1: 7, 2: 7, 3: 8}  # a rig took the first two images at once
    images = {key: SimpleNamespace(frame_id=frame) for key, frame in frames.items()}
    graph: Any = SimpleNamespace(cache=SimpleNamespace(images=images))
    assert [pair.ids for pair in first_pairs(pairs, graph)] == [(2, 3), (1, 3), (1, 2)]


def test_a_token_stops_the_search(scene: Scene, tmp_path: Path) -> None:
    token = pycolmap.CancellationToken()
    task = replace(task_of(scene, UNKNOWN), cancellation=token)
    shown: list[int] = []

    def show(number: int) -> None:
        shown.append(number)
        token.cancel()

    with pytest.raises(KeyboardInterrupt):
        map_database(mapper_of("sparse"), task, tmp_path / "sparse", show)
    assert shown == [2]
    assert not list(tmp_path.iterdir())


def two_places(path: Path) -> dict[int, CameraRecord]:
    """A verified database of four photographs of one place, one enlarged, and two of another."""
    parts = []
    for seed, count in ((3, 4), (8, 2)):
        parts.append(path.with_name(f"{count}.db"))
        synthesize(
            parts[-1], seed=seed, num_rigs=count, num_points3D=200, noise_px=NOISE_PX
        )
        with closing(sqlite3.connect(parts[-1])) as connection, connection:
            connection.execute("UPDATE images SET name = ? || name", (f"{count}/",))
    with open_database(path) as both:
        with open_database(parts[0]) as one, open_database(parts[1]) as other:
            pycolmap.Database.merge(one, other, both)
        images = both.read_all_images()
        middle = np.array(SIZE) / 2
        enlarged = min(
            image.image_id for image in images if image.name.startswith("4/")
        )
        keypoints = both.read_keypoints(enlarged)
        keypoints[:, :2] = (keypoints[:, :2] - middle) * 1.7 + middle
        both.update_keypoints(enlarged, keypoints)
        both.clear_two_view_geometries()
    verify(path, VerificationOptions())
    return {i.camera_id: replace(UNKNOWN, names=(i.name,)) for i in images}


def focals_of(mapped: MappedModel) -> list[float]:
    """Return the focal lengths of the images of a model, rising."""
    cameras = cameras_of(mapped.reconstruction).values()
    return sorted(camera.mean_focal_length() for camera in cameras)


@pytest.mark.long
def test_models_of_other_places_go_on_once_photographs_have_own_cameras(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    cameras = two_places(path)
    names = {name for record in cameras.values() for name in record.names}
    last, other = sorted(name for name in names if name.startswith("4/"))[-2:]
    task = MappingTask(
        path, None, cameras=cameras, may_share=True, unmeasured_pairs=[(last, other)]
    )
    large, small = mapper_of("sparse").map(task, tmp_path, 0, lambda _: None)
    assert PER_IMAGE_CAMERAS in large.hypotheses
    for mapped in (large, small):
        model = mapped.reconstruction
        registered = [model.images[i] for i in model.reg_image_ids()]
        assert len({image.camera_id for image in registered}) == len(registered)


@pytest.mark.long
def test_photographs_get_own_cameras_and_models_of_other_places_stay(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    task = MappingTask(path, None, cameras=two_places(path), may_share=True)
    large, small = mapper_of("sparse").map(task, tmp_path, 0, lambda _: None)
    assert (large.hypotheses[-1], small.hypotheses) == (
        PER_IMAGE_CAMERAS,
        ("with all pairs",),
    )
    found = focals_of(large)
    assert found == pytest.approx(
        [TRUE_FOCAL, TRUE_FOCAL, TRUE_FOCAL, 1.7 * TRUE_FOCAL], rel=0.03
    )
    assert small.reconstruction.num_reg_images() == 2
    known = replace(task, previous_models=[large, small])
    again = mapper_of("sparse").map(known, tmp_path, 0, lambda _: None)
    assert [model.reconstruction.num_reg_images() for model in again] == [4, 2]
    focals_px = focals_of(again[0])
    assert focals_px == pytest.approx(found, rel=0.01)


def test_known_models_stay_as_they_are_when_they_are_extended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=6, num_points3D=150, noise_px=NOISE_PX)
    ids = sorted(truth.reg_image_ids())
    known = []
    for lost in (ids[3:], ids[:3]):
        model = pycolmap.Reconstruction(truth)
        for image_id in lost:
            model.deregister_frame(model.images[image_id].frame_id)
        known.append(MappedModel(model))
    before_px = [focals(mapped.reconstruction) for mapped in known]
    search = unknown_search((path, truth), Search)
    monkeypatch.setattr(Search, "with_bridges", lambda _, __, models: list(models))
    found = search.extend_models(search.graph, known)
    assert len(found) >= 2
    assert [focals(mapped.reconstruction) for mapped in known] == before_px


def test_models_grow_in_threads_only_where_the_first_one_is_not_enough() -> None:
    grown = list[int]()

    def grow(pair: tuple[int, int]) -> pycolmap.Reconstruction | None:
        grown.append(pair[0])
        return None if pair[0] < 2 else pycolmap.Reconstruction()

    grower = cast(Grower, SimpleNamespace(grow=grow, stop=lambda: None))
    models = _grow_in_order(grower, [(number, 9) for number in range(6)])
    assert [next(models), next(models)] == [None, None]
    assert next(models) is not None
    models.close()
    assert grown == [0, 1, 2]
    every = list(_grow_in_order(grower, [(number, 9) for number in range(6)]))
    assert [model is None for model in every] == [True] * 2 + [False] * 4


def test_models_that_nobody_waits_for_end_with_their_next_image() -> None:
    is_stopped = threading.Event()
    have_begun = threading.Semaphore(0)

    def grow(pair: tuple[int, int]) -> pycolmap.Reconstruction:
        if pair[0] > 1:
            have_begun.release()
            assert is_stopped.wait(timeout=10.0)
        return pycolmap.Reconstruction()

    grower = cast(Grower, SimpleNamespace(grow=grow, stop=is_stopped.set))
    models = _grow_in_order(grower, [(number, 9) for number in range(4)])
    next(models)
    next(models)
    assert have_begun.acquire(timeout=10.0)
    models.close()  # would wait for ever for a model that grows on
    assert is_stopped.is_set()
