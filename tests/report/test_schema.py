"""report.json is what its schema says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pydantic
import pytest
from small_run import NAMES, make_run_page, small_report

from colmap_affrect.errors import with_flags
from colmap_affrect.mappers.camera_priors import FocalContradiction
from colmap_affrect.project.line_report import LineReport
from colmap_affrect.project.report import MatchedAgain, Residual
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.observations import ModelReader
from colmap_affrect.report.photographs import photographs_of_report
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.report.schema import ReportFile, report_schema

CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"
SCHEMA = Path(__file__).parents[2] / "docs" / "report.schema.json"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    """A report in which there is something of everything."""
    folder = tmp_path_factory.mktemp("run")
    make_run_page(folder)
    small = small_report(folder)
    workspace = Workspace(folder / "out")
    found = photographs_of_report(
        ModelReader(workspace.sparse), NAMES, small.models, small.cameras, {}
    )
    (model,) = small.models
    (camera,) = small.cameras
    mapped = replace(model, tie_points=(Residual("1", NAMES[0], 2.5),))
    return replace(
        small,
        models=(replace(mapped, one_view=((NAMES[0], NAMES[1]),)),),
        cameras=(
            {
                **camera,
                "focal_longer_sides": 1.25,
                "lens_mm": 0.0,
                "given_principal_point_px": [320.0, 368.0],
                "fitting_principal_point_px": [322.0, 243.0],
            },
        ),
        mapping={**small.mapping, "random_seed": 0},
        verification={**small.verification, "random_seed": 0},
        photographs=found,
        lines={NAMES[0]: LineReport(40, up=(0.0, -1.0, 0.0))},
        matched_again=(MatchedAgain("learned", 3, 20.0),),
        focal_contradictions=(
            FocalContradiction((NAMES[0],), "exif", 900.0, 1400.0, 0.05),
        ),
    )


def content_of(report: RunReport) -> dict[str, Any]:
    return dict(json.loads(report.to_json()))


def test_a_report_has_what_the_schema_says_and_nothing_else(report: RunReport) -> None:
    content = content_of(report)
    read = ReportFile.model_validate(content)
    assert read.model_dump(mode="json", exclude_unset=True) == content


@pytest.mark.parametrize("key", ["status", "photographs", "focal_contradictions"])
def test_a_report_without_a_part_is_refused(report: RunReport, key: str) -> None:
    content = content_of(report)
    del content[key]
    with pytest.raises(pydantic.ValidationError, match=key):
        ReportFile.model_validate(content)


@pytest.mark.skipif(
    f"pydantic=={pydantic.VERSION}\n" not in CONSTRAINTS.read_text(encoding="utf-8"),
    reason="other versions of pydantic write it with other words",
)
def test_the_schema_in_the_documentation_is_the_one_of_the_code() -> None:
    is_same = SCHEMA.read_text(encoding="utf-8") == report_schema()
    assert is_same, (
        "write what colmap_affrect.report.schema.report_schema() returns to docs/report.schema.json"
    )


def test_contradicted_focal_lengths_are_told_in_the_terminal(report: RunReport) -> None:
    text = report.summary(said=with_flags)
    assert "the focal length from EXIF is 900 px, straight lines tell 1,400 px" in text
    assert "--ignore-exif leaves it out" in text
    assert "cameras.ignore_exif leaves it out" in str(report)


def test_contradicted_principal_points_are_told_in_the_terminal(
    report: RunReport,
) -> None:
    line = "the given principal point may be wrong: 320,368 px given, about 322,243 px fits"
    assert line in report.summary()
