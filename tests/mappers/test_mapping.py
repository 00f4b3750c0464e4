"""Mapping: what is passed on to pycolmap, its mappers, several models, and interruptions."""

from __future__ import annotations

import errno
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import pytest
from mapping_tasks import (
    NOTHING_KNOWN,
    SEED,
    WHOLE,
    mapper_of,
    synthesize,
    task_with_given_cameras,
)
from small_scene import NAMES, write_photographs
from verified import verified

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import (
    model_poses,
    pose_errors,
    read_poses,
    relative_pose,
)
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.mappers import scored_models, snapshots
from colmap_affrect.mappers.base import MAPPERS, MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.existing import Extension
from colmap_affrect.mappers.global_mapper import GlobalMapper, GlobalOptions
from colmap_affrect.mappers.incremental import IncrementalMapper, IncrementalOptions
from colmap_affrect.mappers.mapping import (
    _pass_on_reasons,
    map_database,
)
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.reliability import Confidence
from colmap_affrect.mappers.scored_models import ScoredModel
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.options import PRESETS
from colmap_affrect.pipeline import map_and_report
from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context
from colmap_affrect.stages.guide import guide


@pytest.mark.parametrize("preset", PRESETS)
def test_mapper_options_win_over_the_preset(preset: str) -> None:
    given = {
        "min_model_size": "4",
        "init_min_num_inliers": "33",
        "ignore_two_view_tracks": "1",
    }
    mapper = IncrementalMapper(IncrementalOptions.preset(preset, mapper_options=given))
    native = mapper.native(NOTHING_KNOWN, SEED)
    assert (native.min_model_size, native.mapper.init_min_num_inliers) == (4, 33)
    assert native.triangulation.ignore_two_view_tracks is True
    assert native.random_seed == SEED
    assert mapper.options.preset_name == preset


@pytest.mark.parametrize(
    ("name", "num_of_first"), [("sparse", 40), ("incremental", 50)]
)
def test_small_sets_need_fewer_inliers_than_colmap_asks_for_and_long_lenses(
    name: str, num_of_first: int
) -> None:
    mapper = mapper_of(name).native(NOTHING_KNOWN, SEED).get_mapper()
    assert mapper.init_min_num_inliers == num_of_first
    assert mapper.abs_pose_min_num_inliers == 12
    assert mapper.max_focal_length_ratio == 30.0


def test_values_that_colmap_does_not_accept_are_named() -> None:
    given = {"init_min_num_inliers": -4, "min_num_matches": 16}
    with pytest.raises(
        OptionError, match=r"mapper\.init_min_num_inliers=-4 .*does not accept"
    ):
        mapper_of("incremental", mapper_options=given)


def reconstruct(path: Path, mapper: Mapper) -> tuple[list[ModelSummary], int]:
    """Map into path/../sparse; return the models and the number of images shown."""
    shown: list[int] = []
    found = map_database(
        mapper, task_with_given_cameras(path), path.parent / "sparse", shown.append
    )
    assert not (path.parent / "sparse.partial").exists()
    return found, sum(shown)


@pytest.mark.parametrize(
    ("name", "key"),
    [("incremental", "ba_global_function_tolerance"), ("global", "function_tolerance")],
)
def test_mapper_that_fails_is_one_clear_line_and_leaves_nothing(
    tmp_path: Path, name: str, key: str
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=3, num_points3D=150)
    wrong = mapper_of(name, mapper_options={key: -1})
    with pytest.raises(
        AffrectError, match=rf"{name} mapper failed: .*tolerance"
    ) as error:
        reconstruct(path, wrong)
    assert "\n" not in str(error.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db"]


def test_global_mapper_registers_all_images_in_place_and_repeatably(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=5, num_points3D=60)
    files = []
    for _ in range(2):
        (model,), num_shown = reconstruct(path, mapper_of("global"))
        assert len(model.registered_names) == num_shown == 5
        assert min(model.probabilities.values()) > 0.9  # judged as all models are
        files.append((tmp_path / "sparse" / "0" / "images.bin").read_bytes())
    assert files[0] == files[1]
    found = read_poses(tmp_path / "sparse" / "0")
    true = model_poses(truth)
    for first, second in combinations(sorted(found), 2):
        estimated = relative_pose(found[first], found[second])
        errors_deg = pose_errors(estimated, relative_pose(true[first], true[second]))
        assert max(errors_deg) < 0.1


def test_global_mapper_counts_tracks_of_two_images_by_our_preset_only(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=2, num_points3D=120)
    (model,), num_shown = reconstruct(path, mapper_of("global"))
    assert len(model.registered_names) == num_shown == 2
    assert reconstruct(path, GlobalMapper(GlobalOptions.preset("colmap"))) == ([], 0)
    assert list((tmp_path / "sparse").iterdir()) == []


def test_global_mapper_keeps_one_given_camera_among_others(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=4, num_points3D=60)
    given = replace(WHOLE, focal_px=1290.0)
    with open_database(path) as database:
        camera = database.read_camera(2)
        params = camera.params
        params[0] = 1290.0
        camera.params = params
        database.update_camera(camera)
    task = MappingTask(path, None, cameras={2: given})
    (model,) = map_database(
        mapper_of("global"), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 4
    cameras = pycolmap.Reconstruction(tmp_path / "sparse" / "0").cameras
    assert cameras[2].params.tolist() == params.tolist()
    assert abs(cameras[1].params[0] - 1280.0) < 10.0


def test_mapper_that_cannot_extend_says_so_before_anything_is_made(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=2, num_points3D=60)
    with pytest.raises(
        OptionError, match=r"the global mapper cannot; use .*mapper sparse"
    ):
        colmap_affrect.map_database(
            path,
            tmp_path / "out",
            mapping=GlobalOptions(),
            extend=Extension(model_path=tmp_path / "model"),
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_mapping_that_is_stopped_leaves_nothing_and_can_be_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=3, num_points3D=150)

    def fail(_: Path, __: Path, output_path: Path, **___: object) -> None:
        (output_path / "0").mkdir()
        (output_path / "0" / "images.bin").write_bytes(b"half")
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(pycolmap, "incremental_mapping", fail)
        with pytest.raises(error):
            reconstruct(path, mapper_of("incremental"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db"]
    (model,), _ = reconstruct(path, mapper_of("incremental"))
    assert len(model.registered_names) == 3


def test_kept_probabilities_are_on_the_side_of_their_class_and_none_is_certain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [0.49996, 0.89996, 0.99996, 0.99996]

    def scored(mapped: MappedModel, *_: object) -> dict[str, Confidence]:
        names = sorted(image.name for image in mapped.reconstruction.images.values())
        return {
            n: Confidence(p, (Doubt("few_matches"),))
            for n, p in zip(names, given, strict=True)
        }

    path = tmp_path / "database.db"
    synthesize(path, num_rigs=4, num_points3D=150)
    monkeypatch.setattr(scored_models, "score_images", scored)
    (model,), _ = reconstruct(path, mapper_of("incremental"))
    first, second, *others = model.registered_names
    assert list(model.probabilities.values()) == [0.499, 0.899, 0.999, 0.999]
    doubts = (Doubt("few_matches"),)
    assert (model.doubtful, model.unsure) == ({first: doubts}, {second: doubts})
    assert model.sure == tuple(others)


def test_mapping_that_is_stopped_while_a_call_still_writes_is_interrupted_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call that does not look whether it is cancelled is left, and goes on for a moment."""
    path = tmp_path / "database.db"
    removed = shutil.rmtree
    synthesize(path, num_rigs=2, num_points3D=50)

    def remove_while_a_file_is_made(folder: Path) -> None:
        monkeypatch.setattr(shutil, "rmtree", removed)
        raise OSError(errno.ENOTEMPTY, "Directory not empty", folder)

    def stop(*_: object, **__: object) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove_while_a_file_is_made)
        raise KeyboardInterrupt

    monkeypatch.setattr(pycolmap, "incremental_mapping", stop)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(path, mapper_of("incremental"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db"]


@pytest.fixture(scope="module")
def two_places(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Verified pairs of two photographs of one room and three of another, never guided."""
    photos = tmp_path_factory.mktemp("photos")
    write_photographs(photos / "here", 2)
    write_photographs(photos / "there", 3, first_seed=10)
    workspace = verified(photos, tmp_path_factory.mktemp("places") / "out")
    guide(Context(workspace), GuidedOptions(enabled="never"))
    return workspace


def names_by_folder(sparse: Path) -> dict[str, tuple[str, ...]]:
    """Return the names of the registered images of each model, by the name of its folder."""
    found = {}
    for folder in sparse.iterdir():
        if folder.is_dir():
            model = pycolmap.Reconstruction(folder)
            names = sorted(model.images[i].name for i in model.reg_image_ids())
            found[folder.name] = tuple(names)
    return found


@pytest.mark.parametrize(
    "mapper",
    [
        pytest.param(n, marks=[pytest.mark.long] * (n != MAPPERS.default))
        for n in ("sparse", "incremental", "global")
    ],
)
def test_two_places_make_two_models_the_largest_first(
    two_places: Workspace, mapper: str
) -> None:
    report = map_and_report(Context(two_places), mapper_of(mapper), overwrite=True)
    large = tuple(f"there/{name}" for name in sorted(NAMES[:3]))
    small = tuple(f"here/{name}" for name in sorted(NAMES[:2]))
    assert [model.registered_names for model in report.models] == [large, small]
    assert report.status == "partial"
    assert report.unregistered == dict.fromkeys(small, Missing("another_group", 1))
    assert "models      2, of 3, 2 images" in report.summary()
    assert [*map(tuple, report.to_mapping()["models"])] == [large, small]
    assert names_by_folder(two_places.sparse) == {"0": large, "1": small}


@pytest.mark.parametrize(("min_model_size", "num_models"), [(3, 1), (4, 0), (2, 2)])
def test_models_of_fewer_images_than_wanted_are_dropped(
    two_places: Workspace, min_model_size: int, num_models: int
) -> None:
    mapper = mapper_of(MAPPERS.default, min_model_size=min_model_size)
    report = map_and_report(Context(two_places), mapper, overwrite=True)
    assert len(report.models) == num_models


@pytest.mark.parametrize("min_model_size", [4, 10])
def test_a_model_of_a_small_set_is_large_enough(
    tmp_path: Path, min_model_size: int
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=3, num_points3D=150)
    (model,), _ = reconstruct(
        path, mapper_of(MAPPERS.default, min_model_size=min_model_size)
    )
    assert len(model.registered_names) == 3


@pytest.mark.parametrize(
    ("probability", "precision_factor", "num_images"),
    [(0.2, 1.0, 3), (0.04, 1.0, 2), (0.04, 0.1, 3)],
)
def test_an_image_leaves_its_model_when_nineteen_of_twenty_such_poses_are_wrong(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    probability: float,
    precision_factor: float,
    num_images: int,
) -> None:
    """What noise leaves open is no sign of a wrong pose."""
    synthesize(tmp_path / "database.db", num_rigs=3, num_points3D=60)

    def score(mapped: MappedModel, *_: object) -> dict[str, Confidence]:
        names = sorted(model_poses(mapped.reconstruction))
        found = dict.fromkeys(names, Confidence(0.99, ()))
        if len(names) == 3:
            doubts = (Doubt("few_matches"),)
            found[names[-1]] = Confidence(probability, doubts, 0.0, precision_factor)
        return found

    monkeypatch.setattr(scored_models, "score_images", score)
    ((model,), _) = reconstruct(tmp_path / "database.db", mapper_of("incremental"))
    assert len(model.registered_names) == num_images
    assert len(model.doubtful) == (num_images == 3)
    assert len(model.taken_out) == (num_images == 2)


def test_why_a_dropped_model_was_wrong_is_said_by_the_one_that_is_kept() -> None:
    """Its photographs are in no other model, and were not simply left unregistered."""
    empty = MappedModel(pycolmap.Reconstruction())
    wrong = Confidence(0.01, (Doubt("matches_disagree"),))
    other = Confidence(0.02, (Doubt("few_matches"),))
    kept = ScoredModel(empty, {"a": Confidence(0.9, ())}, {"b": other})
    dropped = ScoredModel(empty, {}, {"a": wrong, "b": wrong, "c": wrong})
    _pass_on_reasons([kept, dropped], [kept])
    assert kept.taken_out == {"b": other, "c": wrong}
    _pass_on_reasons([dropped], [])


def test_verified_pairs_are_read_once_also_where_there_are_snapshots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=3, num_points3D=100)
    monkeypatch.setattr(snapshots, "SNAPSHOT_FRAMES", 2)
    read = PairGraph.read
    num_read = list[Path]()

    def counted(path: Path, min_num_matches: int) -> PairGraph:
        num_read.append(path)
        return read(path, min_num_matches)

    monkeypatch.setattr(PairGraph, "read", counted)
    ((model,), _) = reconstruct(path, mapper_of("sparse"))
    assert len(model.registered_names) == 3
    assert num_read == [path]
