"""Photographs in, COLMAP model out: the whole chain, again, and interrupted."""

from __future__ import annotations

import json
import math
import re
import shlex
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from adviser import AGAIN, Adviser
from command import CAMERA, Call, pair_list
from numpy.testing import assert_array_equal
from results import database_content, hdf5_content
from small_scene import IMAGE_SIZE, INTRINSICS, NAMES
from verified import CAMERAS, copy_of

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.cameras import (
    Source,
    read_camera_records,
    write_camera_records,
)
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.geometry.lines import SHIFTED_SIGMA
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.mappers.camera_priors import FocalContradiction
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.mappers.wrong_models import ThrownAway
from colmap_affrect.matchers.base import ImageFeatures
from colmap_affrect.matchers.nearest import MatchableImage, NearestNeighbors
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.project import feature_store
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import pair_key
from colmap_affrect.project.reasons import Doubt, DoubtCode
from colmap_affrect.project.report import (
    Bridge,
    MatchedAgain,
    PrincipalPointContradiction,
    ReconstructionReport,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import advice as advice_module
from colmap_affrect.report.advice import advice
from colmap_affrect.session.context import Context, Resources
from colmap_affrect.stages import match as match_stage
from colmap_affrect.stages.map import line_cameras
from colmap_affrect.stages.verify import verify_matches

CAMERA_ARGUMENTS = ["--camera-mode", "single", *CAMERA[2:]]
OPTIONS = RunOptions(
    cameras=CAMERAS,
    verification=VerificationOptions(random_seed=3),
    mapping=SparseOptions(random_seed=3),
)

Finished = tuple[Workspace, ReconstructionReport]

MOST_OPENINGS = 5
"""Of databases by one run: what COLMAP has read of the images, what becomes of it, the database for
all stages before mapping, for mapping, and for the report."""
DIGITS = 9
"""Means over a model that was read back may differ from those before in the last digits."""


@pytest.fixture(scope="module")
def finished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run of all four photographs; nothing may be changed in it."""
    path = tmp_path_factory.mktemp("finished") / "out"
    with pytest.MonkeyPatch.context() as patch:
        opened = Mock(wraps=pycolmap.Database.open)
        patch.setattr(pycolmap.Database, "open", opened)
        report = run(photos, path, OPTIONS)
    assert opened.call_count <= MOST_OPENINGS
    return Workspace(path), report


@pytest.fixture
def copy(finished: Finished, tmp_path: Path) -> Workspace:
    """A copy of the finished run, to be changed."""
    return copy_of(finished[0], tmp_path / "copy")


def without_times(report: dict[str, object]) -> dict[str, object]:
    """What a report says beside its times; means depend on the order of summation."""
    return {
        key: round(value, DIGITS) if isinstance(value, float) else value
        for key, value in report.items()
        if key != "stages"
    }


RESULTS = {
    "config.toml", "database.db", "features.h5", "matches.h5", "pairs.txt", "report.html",
    "report.json", "sparse",
}  # fmt: skip


def test_run_registers_all_photographs_and_leaves_all_results(
    finished: Finished,
) -> None:
    workspace, report = finished
    assert report.status == "ok"
    assert report.registered_names == tuple(sorted(NAMES))
    assert report.unregistered == {}
    assert {path.name for path in workspace.path.iterdir()} >= RESULTS
    assert len(workspace.pairs.read_text(encoding="utf-8").splitlines()) == 6
    assert (report.num_pairs, report.num_verified_pairs) == (6, 6)


def test_run_says_how_good_its_model_is(finished: Finished) -> None:
    _, report = finished
    (model,) = report.models
    assert model.num_points3D > 300
    assert 2.0 <= model.mean_track_length <= 4.0
    assert 0.0 < model.mean_reprojection_error_px < 1.0


def test_model_of_a_run_has_the_camera_that_was_given(finished: Finished) -> None:
    workspace, report = finished
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    names = sorted(model.images[image_id].name for image_id in model.reg_image_ids())
    assert names == list(report.registered_names)
    (camera,) = model.cameras.values()
    assert camera.params.tolist() == [float(value) for value in INTRINSICS.split(",")]
    assert (camera.width, camera.height) == IMAGE_SIZE
    (record,) = read_camera_records(workspace.cameras).values()
    assert record.names == tuple(names)
    assert (record.source, record.is_all_given) == ("given", True)


def test_run_leaves_the_options_of_all_its_stages(finished: Finished) -> None:
    workspace, _ = finished
    stages = ["extract", "pairs", "match", "verify", "escalate", "guide", "map"]
    assert workspace.record().keys() == {"recipe", *stages, "made_from", "mapped"}
    assert workspace.started_stages == stages


def test_report_and_page_say_what_lines_were_found(finished: Finished) -> None:
    workspace, report = finished
    name = NAMES[0]
    lines = FeatureStore(workspace.features).lines_of([name]).get(name)
    assert lines is not None
    assert report.lines.keys() == set(NAMES)
    assert report.lines[name].num_segments == len(lines.segments)
    said = json.loads(workspace.report.read_text(encoding="utf-8"))["lines"]
    assert said[name]["num_segments"] == len(lines.segments)
    assert 'id="lines"' in workspace.page.read_text(encoding="utf-8")


@pytest.mark.parametrize("source", ["guess", "exif"])
def test_lines_are_asked_for_cameras_that_the_user_does_not_give(
    copy: Workspace, source: Source
) -> None:
    context = Context(copy)
    assert line_cameras(context) == {}
    records = read_camera_records(copy.cameras)
    not_given = {key: replace(r, source=source, given=()) for key, r in records.items()}
    write_camera_records(copy.cameras, not_given)
    store = FeatureStore(copy.features)
    for name in NAMES:
        lines = store.lines_of([name]).get(name)
        said = lines.camera() if lines else None
        found = line_cameras(context).get(name)
        assert (found and found.focal) == (said and said.focal)


def test_the_lines_of_crops_say_what_they_say_wherever_the_axis_is(
    copy: Workspace,
) -> None:
    """With the axis in the middle they would be surer of a focal length than they are."""
    records = read_camera_records(copy.cameras)
    crops = {
        key: replace(r, source="guess", given=(), uncropped_px=1000.0)
        for key, r in records.items()
    }
    write_camera_records(copy.cameras, crops)
    store = FeatureStore(copy.features)
    found = line_cameras(Context(copy))
    assert found
    for name, by_lines in found.items():
        free = store.lines_of([name])[name].camera(SHIFTED_SIGMA)
        assert free
        assert (by_lines.focal, by_lines.shift_sigma) == (free.focal, free.shift_sigma)


def test_keypoints_in_the_database_are_those_of_the_store_plus_half_a_pixel(
    finished: Finished,
) -> None:
    workspace, _ = finished
    ids = image_ids(workspace.database)
    assert sorted(ids) == sorted(NAMES)
    with (
        h5py.File(workspace.features, "r") as file,
        open_database(workspace.database) as database,
    ):
        for name in NAMES:
            keypoints = database.read_keypoints(ids[name])
            assert len(keypoints) > 500
            assert_array_equal(
                keypoints[:, :2], file[name]["keypoints"][()] + np.float32(0.5)
            )


@pytest.mark.long
def test_stage_commands_do_what_run_does_for_its_first_model_and_it_goes_on_from_there(
    finished: Finished, photos: Path, tmp_path: Path, call: Call
) -> None:
    expected, first = finished
    out = ["--output-path", tmp_path / "out"]
    seed = ["--random-seed", 3]
    for command in (
        ["extract", "--image-path", photos, *CAMERA_ARGUMENTS],
        ["pairs"],
        ["match"],
        ["verify", *seed],
        ["map", *seed],
    ):
        code, stdout, stderr = call(command[0], *out, *command[1:])
        assert code == 0, stderr
        assert stdout
    made = Workspace(tmp_path / "out")
    assert hdf5_content(made.features) == hdf5_content(expected.features)
    assert hdf5_content(made.matches) == hdf5_content(expected.matches)
    assert made.pairs.read_bytes() == expected.pairs.read_bytes()
    record = dict(made.record())
    planned = record.pop("planned")
    done = dict(expected.record())
    done["made_from"] = dict(done["made_from"])
    assert done["made_from"].pop(
        "guided"
    )  # what guided matching has seen; run alone has it
    assert record | planned == done
    assert image_ids(made.database) == image_ids(expected.database)
    assert database_content(made.database) == database_content(expected.database)
    reports = [
        json.loads(space.report.read_text(encoding="utf-8"))
        for space in (made, expected)
    ]
    assert without_times(reports[0]) == without_times(reports[1])
    report = run(photos, made.path, OPTIONS)
    assert without_times(report.to_mapping()) == without_times(first.to_mapping())
    assert made.config.read_bytes() == expected.config.read_bytes()


@pytest.fixture
def adviser(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> Adviser:
    monkeypatch.setattr(Workspace, "recipe", lambda _: "rectified")
    workspace, report = finished
    context = Context(workspace, command=tuple(shlex.split(AGAIN)))
    return Adviser(context, report.models[0])


LOST = NAMES[0]


def test_for_a_lost_photograph_the_best_recipe_and_tie_points_are_advised(
    adviser: Adviser,
) -> None:
    more = adviser.anew("--recipe default")
    tied = f"{AGAIN} --tie-points tie-points.csv"
    assert adviser.commands([LOST]) == [more, tied, ""]
    assert adviser.commands(["unreadable.png"]) == []


def test_focal_lengths_are_advised_where_they_are_unknown_or_contradicted(
    adviser: Adviser,
) -> None:
    unknown = {LOST: (Doubt("focal_unknown"),)}
    # A number in a command would be a guess; more photographs have no command either
    assert adviser.commands([], doubtful=unknown) == ["", ""]
    contradicted = Doubt("focal_contradicted", {"given_px": 9.0, "fitting_px": 8.1})
    found = adviser.commands([LOST], taken_out={LOST: (contradicted,)})
    assert found[0] == adviser.anew("--focal-length-px 8")


@pytest.mark.parametrize(("cameras", "given", "kept"), [
    ({"principal_point": "1,2"}, "--principal-point 1,2", ""),
    ({"model": "PINHOLE", "params": "400,500,1,2"}, "--camera-params=400,500,1,2",
     "--focal-length-px 450"),
    ({"cameras_path": "table.csv"}, "--cameras-path table.csv", "--cameras-path table.csv"),
])  # fmt: skip
def test_a_given_principal_point_that_does_not_fit_is_left_open(
    adviser: Adviser,
    monkeypatch: pytest.MonkeyPatch,
    cameras: dict[str, str],
    given: str,
    kept: str,
) -> None:
    inputs = adviser.context.inputs.changed(cameras=CameraOptions(**cameras))
    monkeypatch.setattr(Context, "inputs", inputs, raising=False)
    words = tuple(shlex.split(f"{AGAIN} {given}"))
    asked = Adviser(replace(adviser.context, command=words), adviser.model)
    one = PrincipalPointContradiction((1.0, 2.0), (511.6, 383.9), {LOST: 4.0})
    (command,) = asked.commands([], principal_point_contradictions=(one,))
    assert command == asked.anew(kept).replace("  ", " ")
    (found,) = advice(
        asked.context,
        [],
        [replace(asked.model, principal_point_contradictions=(one,))],
        0,
    )
    assert "about 512,384 px does" in found.why


def test_masks_and_rejected_pairs_are_advised_where_matches_contradict_a_pose(
    adviser: Adviser, monkeypatch: pytest.MonkeyPatch
) -> None:
    masks = adviser.anew("--mask-path masks")
    more = adviser.anew("--recipe default")
    bridged = {LOST: Bridge(NAMES[1], 5, 9, 0.2)}
    little = {LOST: (Doubt("little_agreement", {"percent": 9}),)}
    assert adviser.commands([], doubtful=little, gains={LOST: 0.3}) == [more, masks, ""]
    rejecting = f"{AGAIN} --reject-pair '{LOST},{NAMES[1]}'"
    agreeing = adviser.commands([], doubtful=little, gains={}, bridges=bridged)
    assert agreeing == [masks, ""]  # the model says that these matches are right
    disagrees = {(NAMES[1], LOST): 0.4}
    monkeypatch.setattr(advice_module, "agreements", lambda *_: disagrees)
    found = adviser.commands([], doubtful=little, gains={}, bridges=bridged)
    assert found == [masks, rejecting, ""]
    few = {LOST: (Doubt("few_matches"),)}
    assert adviser.commands([], doubtful=few, bridges=bridged) == [""]


def test_more_photographs_help_doubtful_ones_and_models_of_which_nothing_is_sure(
    adviser: Adviser,
) -> None:
    few = {LOST: (Doubt("few_matches"),)}
    doubtful = replace(adviser.model, doubtful=few, gains={})
    (found,) = advice(adviser.context, [], [doubtful], 0)
    assert found.why == f"more photographs, between {LOST} and the others"
    unsure = replace(adviser.model, probabilities=dict.fromkeys(NAMES, 0.7))
    (found,) = advice(adviser.context, [], [unsure], 0)
    assert found.why == "more photographs, from places between those of these"
    one_sure = replace(unsure, probabilities={**unsure.probabilities, LOST: 0.97})
    assert advice(adviser.context, [], [one_sure], 0) == ()


def test_tie_points_that_join_nothing_are_advised_again_with_the_reason(
    adviser: Adviser,
) -> None:
    model = adviser.model
    by_hand = ByHand(tie_points_path=Path("t.csv"))
    said = replace(adviser.context, by_hand=by_hand, command=())
    (_, tie_points, _) = advice(said, [LOST], [model], 0)
    why = "no point of t.csv is seen by two photographs of one model"
    assert tie_points.why.startswith(why)
    assert tie_points.command.startswith("colmap-affrect map --output-path ")
    given = replace(said, command=("colmap-affrect", "map", "--tie-points", "t.csv"))
    (_, tie_points, _) = advice(given, [LOST], [model, model], 0)
    assert tie_points.why.endswith("join two models")
    assert tie_points.command == "colmap-affrect map --tie-points t.csv"


@pytest.mark.parametrize(
    ("code", "has_tie_points"),
    [("other_surroundings", False), ("two_places", False), ("surer_apart", True)],
)
def test_tie_points_do_not_join_what_was_found_to_be_another_place(
    adviser: Adviser, code: DoubtCode, *, has_tie_points: bool
) -> None:
    found = adviser.commands([LOST], taken_out={LOST: (Doubt(code),)})
    assert any("--tie-points" in command for command in found) == has_tie_points


def test_tie_points_that_begin_a_model_are_advised_where_there_is_none(
    adviser: Adviser,
) -> None:
    (_, tie_points, _) = advice(adviser.context, [*NAMES], [], 0)
    assert tie_points.code == "tie_points"
    assert tie_points.why.startswith("mark seven points or more in two photographs")


@pytest.mark.parametrize(
    ("shows_depth", "why"),
    [(True, "contradict each other"), (False, "show no depth")],
)
def test_strong_pairs_that_make_no_model_contradict_each_other_or_show_no_depth(
    adviser: Adviser,
    monkeypatch: pytest.MonkeyPatch,
    why: str,
    *,
    shows_depth: bool,
) -> None:
    found_depth = Mock(return_value=shows_depth)
    monkeypatch.setattr(advice_module, "_any_shows_depth", found_depth)
    *more, found = advice(adviser.context, [*NAMES], [], 900)
    assert why in found.why
    # Other features show no depth either where there is none
    codes = ["recipe", "tie_points"] if shows_depth else []
    assert [one.code for one in more] == codes


def test_matches_of_a_scene_with_depth_show_it(adviser: Adviser) -> None:
    *_, found = advice(adviser.context, [*NAMES], [], 900)
    assert "contradict each other" in found.why


def test_doubts_of_models_that_were_thrown_away_are_advised_on(
    adviser: Adviser, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A given focal length can be the reason why there is no model."""
    contradicted = Doubt("focal_contradicted", {"given_px": 9.0, "fitting_px": 8.1})
    thrown_away = ThrownAway({LOST: (contradicted,)})
    monkeypatch.setattr(advice_module, "read_thrown_away", lambda _: thrown_away)
    first, *_ = advice(adviser.context, [*NAMES], [], 900)
    assert first.command == adviser.anew("--focal-length-px 8")


def test_the_default_mapper_is_advised_first_where_another_one_leaves_out(
    adviser: Adviser, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = "--mapper incremental --mapper-options a=1 b=2"
    incremental = MAPPERS.options({"name": "incremental"}, "")
    monkeypatch.setattr(Context, "mapping", incremental, raising=False)
    asked = replace(adviser.context, command=tuple(shlex.split(f"{AGAIN} {given}")))
    other = Adviser(asked, adviser.model)
    first, *_ = other.commands([LOST])
    assert first == other.anew("").replace("  ", " ")
    assert "" in other.commands([LOST])  # more photographs
    marks = advice_module.command_with_tie_points(asked)
    assert marks == other.anew("--tie-points tie-points.csv")


@pytest.mark.parametrize(
    ("source", "given", "kept"),
    [
        ("given", "--focal-mm 9 --film-width-mm 36", ""),
        ("exif", "", "--ignore-exif"),
    ],
)
def test_focal_lengths_that_lines_contradict_are_left_out_where_something_is_missing(
    adviser: Adviser, source: str, given: str, kept: str
) -> None:
    words = tuple(shlex.split(f"{AGAIN} {given}"))
    asked = Adviser(replace(adviser.context, command=words), adviser.model)
    found = FocalContradiction((LOST,), source, 900.0, 1400.0, 0.05)
    first, *_ = advice(asked.context, [LOST], [asked.model], 0, contradictions=[found])
    assert first.code == "lines_contradict"
    flags = shlex.split(first.command)
    assert [*filter(None, [kept])] == [
        word for word in flags if word == "--ignore-exif"
    ]
    assert "--focal-mm" not in flags
    assert "--film-width-mm" not in flags
    assert not advice(asked.context, [], [asked.model], 0, contradictions=[found])


def test_weights_are_advised_where_the_best_recipe_lacks_them(
    adviser: Adviser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Workspace, "recipe", lambda _: "default")
    missing = Mock(return_value=["pip install it", "fetch it"])
    monkeypatch.setattr(Resources, "commands_to_complete", missing)
    (weights, *_) = advice(adviser.context, [LOST], [adviser.model], 0)
    assert weights.command == f"pip install it && {AGAIN}"


def test_run_again_does_nothing_twice(copy: Workspace, photos: Path) -> None:
    before = {
        path: path.read_bytes() for path in (copy.features, copy.matches, copy.pairs)
    }
    model = (copy.sparse / "0" / "points3D.bin").stat().st_mtime_ns
    tables = database_content(copy.database)
    report = run(photos, copy.path, OPTIONS)
    done = {stage.name: (stage.num_done, stage.num_kept) for stage in report.stages}
    assert done == {
        "extract": (0, 4), "pairs": (6, 0), "match": (0, 6), "verify": (0, 6),
        "escalate": (0, 0), "guide": (0, 0), "map": (0, 1),
    }  # fmt: skip
    assert report.status == "ok"
    assert {path: path.read_bytes() for path in before} == before
    assert (copy.sparse / "0" / "points3D.bin").stat().st_mtime_ns == model
    assert database_content(copy.database) == tables


def test_idle_run_looks_at_no_header(
    copy: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_affrect.colmap.initial_cameras.read_camera_tags", None)
    monkeypatch.setattr("colmap_affrect.project.match_store.MatchStore.has", None)
    run(photos, copy.path, OPTIONS)


def test_idle_run_reads_the_features_of_no_photograph_and_builds_no_networks(
    copy: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy has other times than its summaries and its page name; the first run makes them again.

    The second one finds a page that shows all that there is.
    """
    first = run(photos, copy.path, OPTIONS)
    feature_store._forget_summaries()
    read = Mock(wraps=feature_store._line_datasets)
    monkeypatch.setattr(feature_store, "_line_datasets", read)
    monkeypatch.setattr(feature_store, "entries_of", None)
    monkeypatch.setattr("colmap_affrect.stages.one_image.prepare", None)
    monkeypatch.setattr("colmap_affrect.report.run_results.write_run_page", None)
    again = run(photos, copy.path, OPTIONS)
    assert not read.called
    assert without_times(again.to_mapping()) == without_times(first.to_mapping())


def test_summaries_that_are_removed_change_no_result(
    copy: Workspace, photos: Path
) -> None:
    before = run(photos, copy.path, OPTIONS)
    copy.features_summary.unlink()
    feature_store._forget_summaries()
    after = run(photos, copy.path, OPTIONS)
    assert copy.features_summary.exists()
    assert without_times(after.to_mapping()) == without_times(before.to_mapping())
    assert {stage.num_done for stage in after.stages} == {0, 6}  # pairs are listed


def test_pairs_are_given_up_where_those_of_a_dozen_photographs_or_more_are_listed(
    copy: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The list counts, not what is left of it: a run that goes on finds the same."""
    asked = list[bool]()
    prepare = NearestNeighbors.prepare

    def prepared(matcher: NearestNeighbors, image: ImageFeatures) -> MatchableImage:
        asked.append(matcher.may_give_up)
        return prepare(matcher, image)

    monkeypatch.setattr(NearestNeighbors, "prepare", prepared)
    assert math.comb(10, 2) < match_stage.MIN_PAIRS_TO_GIVE_UP <= math.comb(20, 2)
    context = Context(copy)
    listed = context.listed_pairs()
    for least, gives_up in ((len(listed) + 1, False), (len(listed), True)):
        monkeypatch.setattr(match_stage, "MIN_PAIRS_TO_GIVE_UP", least)
        asked.clear()
        context.matches.remove(pairs=[listed[0]])
        with copy.locked():
            match_stage.match(context)
        assert set(asked) == {gives_up}


@pytest.mark.parametrize("name", NAMES[1:3])
def test_image_whose_features_are_lost_gets_the_same_again(
    finished: Finished, copy: Workspace, photos: Path, name: str
) -> None:
    expected, first = finished
    with h5py.File(copy.features, "a") as file:
        del file[name]
    report = run(photos, copy.path, OPTIONS)
    assert (report.stages[0].num_done, report.stages[0].num_kept) == (1, 3)
    assert hdf5_content(copy.features) == hdf5_content(expected.features)
    assert without_times(report.to_mapping()) == without_times(first.to_mapping())


def test_other_options_than_before_are_named(
    copy: Workspace, photos: Path, call: Call
) -> None:
    out = ["--output-path", copy.path]
    images = ["--image-path", photos]
    cameras = CAMERA_ARGUMENTS
    seed = ["--random-seed", 3]
    before = {
        path: path.read_bytes() for path in (copy.features, copy.matches, copy.config)
    }
    cases = [
        (["run", *images, *seed, *cameras, "--set", "features.contrast_threshold=0.02"],
         "features.contrast_threshold=0.013, and it is 0.02"),
        (["run", *images, *seed, *cameras, "--set", "matching.max_ratio=0.7"], "max_ratio=0.85"),
        (["run", *images, *cameras], "random_seed=3, and it is 0"),
        (["run", "--image-path", photos / "side", *seed, *cameras], f"image_path='{photos}'"),
        (["run", *images, *seed, *cameras, "--match-list-path",
          pair_list(copy.path.parent, "a.png", "b c.png")], "match_list_path=''"),
        (["extract", *images, *cameras, "--recipe", "unrectified-rootsift"], "rectifier.name"),
        (["match", "--set", "matching.duplicate_radius_px=3"], "duplicate_radius_px=2.0"),
        (["verify", "--random-seed", 4], "random_seed=3, and it is 4"),
        (["map", "--random-seed", 4], "random_seed=3, and it is 4"),
    ]  # fmt: skip
    for command, named in cases:
        code, stdout, stderr = call(*command, *out)
        assert (code, stdout, len(stderr)) == (2, "", 1), stderr
        assert named in stderr[0]
        assert "--overwrite" in stderr[0]
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.long
def test_options_survive_stage_by_stage(
    photos: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What extract was given counts later, also where a relative recipe would not be found."""
    out = tmp_path / "out"
    (tmp_path / "own.toml").write_text(
        'rectifier = "identity"\nmatching.max_ratio = 0.8\nmapping.init_min_num_inliers = 40\n'
    )
    monkeypatch.chdir(tmp_path)
    extract = [
        "extract",
        "--image-path",
        photos,
        "--output-path",
        out,
        *CAMERA_ARGUMENTS,
    ]
    assert call(*extract, "--recipe", "own.toml").code == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for stage in ("pairs", "match", "verify", "map"):
        ended = call(stage, "--output-path", out)
        assert ended.code == 0, ended.errors
    workspace = Workspace(out)
    now = Workspace(out)
    assert workspace.require("match")["max_ratio"] == 0.8
    assert workspace.require("map")["init_min_num_inliers"] == 40
    changed = call(
        "match", "--output-path", out, "--set", "matching.max_ratio=0.7", "--overwrite"
    )
    assert changed.code == 0
    assert now.require("match")["max_ratio"] == 0.7
    wrong = call("match", "--output-path", out, "--set", "rectifier.name=identity")
    assert wrong.errors == [
        "error: --set: only options of matching can be changed here"
    ]


@pytest.mark.long
def test_mapper_options_are_added_to_what_is_on_record(
    copy: Workspace, call: Call
) -> None:
    seeds = ["--preset", "colmap", "--random-seed", "4"]
    assert call("map", "--output-path", copy.path, "--overwrite", *seeds).code in (0, 3)
    option = ["--mapper-options", "ba_refine_principal_point=true"]
    assert call("map", "--output-path", copy.path, "--overwrite", *option).code in (
        0,
        3,
    )
    record = copy.require("map")
    assert (record["min_model_size"], record["random_seed"]) == (10, 4)
    assert record["mapper_options"] == {"ba_refine_principal_point": True}


@pytest.mark.parametrize("stage", ["pairs", "match", "verify", "map"])
def test_stage_before_its_turn_says_what_to_run(
    tmp_path: Path, call: Call, stage: str
) -> None:
    code, stdout, stderr = call(stage, "--output-path", tmp_path)
    assert (code, stdout, len(stderr)) == (2, "", 1)
    assert "stage has not been run there; run 'colmap-affrect " in stderr[0]


def test_pairs_that_are_not_listed_any_more_leave_the_database(
    copy: Workspace, call: Call
) -> None:
    names = FeatureStore(copy.features).names()
    path = copy.path.parent / "list.txt"
    for lines, overwrite, has_lost in [
        ([names[:2], names[1:3]], ["--overwrite"], False),
        ([names[:2], names[1:3], names[2:4]], [], False),
        ([names[:2]], [], True),
    ]:
        path.write_text(
            "".join("\t".join(line) + "\n" for line in lines), encoding="utf-8"
        )
        arguments = ["--output-path", copy.path, "--match-list-path", path, *overwrite]
        code, _, stderr = call("pairs", *arguments)
        assert code == 0, stderr
        assert (
            any("2 pairs are not listed any more" in line for line in stderr)
            == has_lost
        )
    assert call("match", "--output-path", copy.path).code == 0
    assert set(database_content(copy.database)["raw matches"]) == {tuple(names[:2])}


def test_match_index_out_of_range_is_refused_before_it_is_written(
    copy: Workspace,
) -> None:
    pair = ("a.png", "b c.png")
    count = FeatureStore(copy.features).num_keypoints()[pair[1]]
    with h5py.File(copy.matches, "a") as file:
        dataset = file[pair_key(*pair)]["matches0"]
        dataset[3] = count
        del dataset.attrs["crc32"]
    copy.database.unlink()
    with pytest.raises(
        DatabaseError, match=r"a\.png, b c\.png point at keypoints that"
    ):
        verify_matches(Context(copy), VerificationOptions(random_seed=3))
    with sqlite3.connect(copy.database) as connection:
        assert connection.execute("SELECT count(*) FROM matches").fetchone() == (0,)
    connection.close()


def test_features_of_another_number_than_in_the_database_are_refused(
    copy: Workspace, photos: Path
) -> None:
    store = FeatureStore(copy.features)
    features = store.read("a.png")
    store.write("a.png", features.select(np.arange(10)), IMAGE_SIZE)
    with pytest.raises(
        DatabaseError, match=r"a\.png has .* keypoints in the database and 10"
    ):
        run(photos, copy.path, OPTIONS)


@pytest.mark.parametrize(("values", "message"), [
    ({"effort": "hihg"}, "effort='hihg': should be 'low', 'normal' or 'high'"),
    ({"max_minutes": -1.0}, "max_minutes=-1.0: should be greater than or equal to 0"),
    ({"max_minutes": float("nan")}, "max_minutes=nan: should be greater than or equal to 0"),
])  # fmt: skip
def test_run_options_that_mean_nothing_are_refused_at_once(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(OptionError, match=f"^{re.escape(message)}$"):
        RunOptions(**values)


def test_advice_names_what_was_not_tried_and_the_command_that_goes_on(
    finished: Finished,
) -> None:
    workspace, report = finished
    words = ("colmap-affrect", "run", "--image-path", "a b", "--output-path", "out")
    left = [
        MatchedAgain("measured, all tilts", 28, 1200.0),
        MatchedAgain("new", 1, 60.0),
    ]
    context = Context(workspace, command=(*words, "--effort", "normal"))
    found = advice(context, [NAMES[0]], report.models, 0, left, "normal")
    more = found[-3]  # tie points and other photographs are more work
    assert more.why.startswith("more matching, at most about ")
    assert more.why.endswith(" min: all tilts 28 pairs, new 1 pair")
    assert shlex.split(more.command) == [*words, "--effort", "high"]
    low = replace(context, command=words)
    (more,) = advice(low, [], report.models, 0, left, "low")
    assert shlex.split(more.command) == [*words, "--effort", "normal"]
    assert advice(context, [], report.models, 0, left, "high") == ()
    for limit in (["--max-time", "3"], ["--max-time=3"]):  # the effort was not used up
        limited = replace(context, command=(*words, "--effort=low", *limit))
        (more,) = advice(limited, [], report.models, 0, left, "low")
        assert shlex.split(more.command) == [*words, "--effort=low"]
    (more,) = advice(replace(context, command=()), [], report.models, 0, left, "low")
    assert more.command == ""
    assert more.why.endswith(
        "; give the command of the run again, with --effort normal"
    )


def test_photographs_that_are_all_lost_are_not_to_be_joined_with_the_others(
    finished: Finished,
) -> None:
    context = Context(finished[0])
    *_, last = advice(context, [*NAMES], [], 0)
    assert last.why == "more photographs, from places between those of these"
    *_, last = advice(context, [NAMES[0]], [], 0)
    assert last.why == f"more photographs, between {NAMES[0]} and the others"
