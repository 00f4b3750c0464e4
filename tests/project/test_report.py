"""What a run reports: the keys of report.json, and one screen for people."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from colmap_affrect.errors import with_flags
from colmap_affrect.project.advised import Advice
from colmap_affrect.project.camera_notes import merge_shared_cameras
from colmap_affrect.project.image_failures import ImageFailure
from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import (
    Bridge,
    ModelSummary,
    ReconstructionReport,
    Residual,
)
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning

LARGE = ModelSummary(
    ("a.png", "č d.png"),
    120,
    2.25,
    0.512,
    bridges={"č d.png": Bridge("a.png", 32, 36, 0.031)},
)
SMALL = ModelSummary(("e.png", "f.png"), 50, 2.0, 0.25)

REPORT = ReconstructionReport(
    images_total=5,
    unregistered={
        "broken.png": Missing("unreadable"),
        "e.png": Missing("not_registered"),
        "f.png": Missing("no_features"),
    },
    models=(LARGE, SMALL),
    num_verified_pairs=3,
    num_pairs=10,
    stages=(
        StageReport(
            "extract",
            1.25,
            3,
            1,
            {"broken.png": ImageFailure("no_image", "broken.png")},
        ),
        StageReport("map", 0.5, 2),
    ),
    recipe="default",
    versions={"pycolmap": "4.2.1"},
    preset="sparse",
    verification={"min_num_inliers": 20, "random_seed": 7},
    mapping={
        "name": "incremental",
        "min_model_size": 2,
        "random_seed": 7,
        "mapper_options": {"mapper.init_max_error": 3.0},
    },
    advice=(
        Advice("recipe", "it tries more", "colmap-affrect run"),
        Advice("photographs", "more photographs"),
    ),
    cameras=(
        {"id": 4, "source": "exif"},
        {"id": 2, "source": "guess"},
        {"id": 3, "source": "exif"},
    ),
)

SHAKY = replace(
    LARGE, doubtful={"a.png": (Doubt("few_three_view_points", {"num": 9}),)}
)
TURNED = replace(
    LARGE,
    doubtful=dict.fromkeys(
        LARGE.registered_names, (Doubt("no_parallax", {"share": 0.9}),)
    ),
)
EMPTY = replace(
    REPORT,
    models=(),
    unregistered={"a.png": Missing("no_verified_pair")},
    images_total=1,
)


def test_report_has_the_promised_keys_and_reads_back() -> None:
    read = json.loads(REPORT.to_json())
    stages = read.pop("stages")
    assert read.pop("bridges") == {
        "č d.png": {
            "by": "a.png", "num_agreeing": 32, "num_ratios": 36, "scale_error_frac": 0.031,
        },
    }  # fmt: skip
    assert read == {
        "status": "partial", "images_total": 5, "images_registered": 2, "num_models": 2,
        "registered_names": ["a.png", "č d.png"], "unregistered": {
            "broken.png": {"code": "unreadable", "text": "unreadable"},
            "e.png": {"code": "not_registered", "text": "not registered"},
            "f.png": {"code": "no_features", "text": "no features"},
        },
        "doubtful": {}, "unsure": {}, "probabilities": {}, "hypotheses": [], "guided": {},
        "advice": [
            {"code": "recipe", "why": "it tries more", "command": "colmap-affrect run"},
            {"code": "photographs", "why": "more photographs", "command": ""},
        ],
        "cameras": list(REPORT.cameras), "points3D": 120, "mean_track_length": 2.25,
        "mean_reprojection_error_px": 0.512, "models": [["a.png", "č d.png"], ["e.png", "f.png"]],
        "extended": [], "added": [], "num_pairs": 10, "num_verified_pairs": 3,
        "recipe": "default", "preset": "sparse", "mapper": "incremental",
        "mapper_options": {"mapper.init_max_error": 3.0}, "verification": {"min_num_inliers": 20},
        "mapping": {"min_model_size": 2}, "random_seed": 7, "versions": {"pycolmap": "4.2.1"},
        "by_hand": [], "tie_points": [], "one_view": [], "lines": {},
        "effort": "", "matched_again": [], "untried": [],
    }  # fmt: skip
    assert [(stage["name"], stage["wall_s"]) for stage in stages] == [
        ("extract", 1.25),
        ("map", 0.5),
    ]
    assert "č d.png" in REPORT.to_json()


@pytest.mark.parametrize(("report", "status"), [
    (REPORT, "partial"),
    (replace(REPORT, unregistered={}), "ok"),
    (replace(REPORT, models=(SHAKY, SMALL)), "doubtful"),
    (replace(REPORT, models=(TURNED,)), "doubtful"),
    (EMPTY, "no_model"),
    (replace(EMPTY, unregistered={}), "no_model"),
])  # fmt: skip
def test_status_tells_whether_all_images_are_in_the_largest_model(
    report: ReconstructionReport, status: str
) -> None:
    assert report.status == report.to_mapping()["status"] == status


def test_summary_is_one_screen_with_names_reasons_and_numbers() -> None:
    text = REPORT.summary()
    assert len(text.splitlines()) < 24
    for part in (
        "registered  2 of 5 images",
        "not broken.png: unreadable",
        "not e.png: not registered",
        "try         it tries more\n            colmap-affrect run\ntry         more photographs",
        "joined      č d.png bridged by a.png, 32 of 36 depths agree, scale +-3.1%",
        "3 of 10 verified",
        "cameras     focal lengths: 2 from EXIF, 1 not known beforehand",
        "points      120, each in 2.25 images",
        "0.51 px",
        "2, of 2, 2 images",
        "preset      sparse, incremental mapper, mapper.init_max_error=3.0\n",
        "extract 1.2  map 0.5",
    ):
        assert part in text


@pytest.mark.parametrize(("num_verified", "is_said"), [(0, True), (1, False)])
def test_summary_says_what_ties_a_model_of_fewer_verified_pairs_than_images(
    num_verified: int, *, is_said: bool
) -> None:
    """Two images need one pair; those of 7 to 14 matches are not counted as verified."""
    models = (replace(REPORT.models[0], tie_points=()),)
    report = replace(
        REPORT, models=models, extended=(), num_verified_pairs=num_verified
    )
    assert ("others have fewer matches" in report.summary()) == is_said
    mark = Residual(point="A", image="a.png", error_px=1.0)
    by_hand = (replace(REPORT.models[0], tie_points=(mark,)),)
    assert "others have fewer" not in replace(report, models=by_hand).summary()


def test_summary_says_where_exif_is_wrong_or_needs_the_size_of_the_sensor() -> None:
    camera = {
        "id": 1,
        "source": "exif",
        "focal_px": 270.0,
        "refined_px": 1081.2,
        "lens_mm": 0.0,
    }
    right = {**camera, "id": 2, "refined_px": 280.0}
    lens = {**camera, "id": 3, "source": "guess", "lens_mm": 35.0}
    text = replace(REPORT, cameras=(camera, right, lens)).summary(said=with_flags)
    assert "cameras     focal lengths: 2 from EXIF, 1 not known beforehand\n" in text
    assert (
        "            EXIF may be wrong: 270 px by EXIF, 1081 px in the model; --ignore"
        in text
    )
    assert "not the size of the sensor: --focal-mm 35 and --film-width-mm (its" in text
    text = replace(REPORT, cameras=(right, {**right, "refined_px": None})).summary()
    assert "EXIF may be wrong" not in text
    assert "sensor" not in text
    database = {**camera, "source": "given", "focal_px": 2560.0, "refined_px": 1279.0}
    text = replace(REPORT, cameras=(database, {**right, "source": "given"})).summary(
        said=with_flags
    )
    line = "the given focal length may be wrong: 2560 px given, 1279 px in the model; --cameras"
    assert line in text
    assert "EXIF" not in text


def test_summary_names_arguments_to_who_calls_functions() -> None:
    known = {"source": "exif", "focal_px": 270.0, "refined_px": 1081.2, "lens_mm": 35.0}
    given = {**known, "source": "given"}
    warned = StageWarning("time_over", "time")
    text = replace(
        REPORT,
        cameras=({**known, "id": 1}, {**given, "id": 2}),
        stages=(StageReport("map", 0.5, 1, warned=(warned,)),),
        advice=(),
    ).summary()
    assert "--" not in text
    for argument in (
        "cameras.ignore_exif leaves it out",
        "cameras.cameras_path takes another one",
        "cameras.focal_mm 35 and cameras.film_width_mm (its",
        "without max_minutes tries more",
    ):
        assert argument in text


def test_summary_says_what_cannot_be_trusted() -> None:
    shaky = replace(SHAKY, probabilities={"a.png": 0.31, "č d.png": 0.9})
    text = replace(REPORT, models=(shaky,)).summary()
    assert (
        "doubtful    a.png: only 9 of its points could be found in two other photographs\n"
        in text
    )
    line = "sure        1, unsure 0, doubtful 1; sure: right with 90% or more\n"
    assert line in text


def test_summary_says_why_photographs_are_not_sure() -> None:
    doubts = (Doubt("no_three_view_points"),)
    why = "none of its points is seen by two other photographs"
    names = LARGE.registered_names[:2]
    sure = dict.fromkeys(names, 0.7)
    two = replace(
        LARGE, bridges={}, probabilities=sure, unsure=dict.fromkeys(names, doubts)
    )
    text = replace(REPORT, models=(two,)).summary()
    line = f"unsure      {names[0]}, {names[1]}: {why}"
    counts = f"sure        0, unsure {len(LARGE.registered_names)}, doubtful 0"
    assert f"{counts}; sure: right with 90% or more\n{line}\n" in text


def test_cameras_that_mapping_makes_one_are_said_to_be() -> None:
    camera = {"source": "guess", "focal_px": 1000.0, "refined_px": 912.3, "why": ""}
    cameras = [
        {**camera, "id": 1, "names": ["a.png"]},
        {**camera, "id": 2, "names": ["b.png"]},
        {**camera, "id": 3, "names": ["c.png"], "source": "exif"},
        {**camera, "id": 4, "names": ["d.png"], "refined_px": 700.0},
        {**camera, "id": 5, "names": ["e.png"], "refined_px": None},
    ]
    text = replace(REPORT, cameras=tuple(cameras)).summary()
    assert "cameras     focal lengths: 4 not known beforehand, 1 from EXIF\n" in text
    assert (
        "            of those not known mapping makes 2: photographs of one size share"
        in text
    )
    merged = merge_shared_cameras(cameras)
    assert [camera["id"] for camera in merged] == [1, 3, 4, 5]
    names = [camera["names"] for camera in merged]
    assert names == [["a.png", "b.png"], ["c.png"], ["d.png"], ["e.png"]]


def test_long_lists_end_where_the_screen_does() -> None:
    many = {f"{i}.png": Missing("another_model", i + 1) for i in range(100)}
    report = replace(REPORT, unregistered=many)
    assert "and 88 more, see report.json" in report.summary()
    report = replace(REPORT, unregistered=dict.fromkeys(many, Missing("no_features")))
    assert "        not 0.png, 1.png," in report.summary()
    assert "10.png, 11.png and 88 more: no features\n" in report.summary()
    assert len(report.to_mapping()["unregistered"]) == 100


@pytest.mark.parametrize(("stage", "line"), [
    (StageReport("match", 2.04, 6), "match: 6 done in 2.0 s"),
    (StageReport("match", 0.1, 3, 3), "match: 3 done, 3 already there in 0.1 s"),
    (REPORT.stages[0], "extract: 3 done, 1 already there, 1 failed in 1.2 s"),
])  # fmt: skip
def test_stage_summary_is_one_line(stage: StageReport, line: str) -> None:
    assert stage.summary() == line


def test_without_a_model_the_headline_says_why_the_one_that_pairs_make_was_wrong() -> (
    None
):
    few = (Doubt("few_matches"), Doubt("focal_unknown"))
    wrong = Missing("wrong_model", doubts=few)
    other = Missing("wrong_model", doubts=(Doubt("matches_disagree"),))
    unregistered = {"a": wrong, "b": other, "c": wrong, "d": Missing("not_registered")}
    report = replace(REPORT, models=(), unregistered=unregistered, stages=())
    why = Doubt("few_matches").text()
    headline = "no model is kept: that of 3 photographs was surely wrong"
    assert report.why_no_model == f"{headline}: {why}"
