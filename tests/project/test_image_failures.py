"""Why photographs cannot be used is a code with values, and every code has its sentence."""

from __future__ import annotations

import pickle
from pathlib import Path
from string import Formatter
from typing import get_args

from colmap_affrect.errors import StoreError
from colmap_affrect.images.conversion import ConversionReport
from colmap_affrect.project.image_failures import (
    ADVICE,
    SENTENCES,
    FailureCode,
    ImageFailure,
    failure_of,
    unusable,
)
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.report.line_pictures import LineReports


def test_every_failure_can_be_said() -> None:
    assert set(SENTENCES) == set(get_args(FailureCode))
    assert set(ADVICE) < set(SENTENCES)
    for code, sentence in SENTENCES.items():
        fields = [part for part in Formatter().parse(sentence) if part[1]]
        values = {str(name): 3.0 if spec else "x" for _, name, spec, _ in fields}
        text = ImageFailure(code, "a.png", values).text()
        assert text.startswith("a.png: ")
        assert "{" not in text


def test_a_failure_reaches_another_process_and_the_report_with_its_values() -> None:
    error = unusable("foreign_format", Path("a.heic"), format="HEIC")
    arrived = pickle.loads(pickle.dumps(error))
    assert (arrived.failure, str(arrived)) == (error.failure, str(error))
    report = StageReport("extract", 1.0, 2, failed={"a.heic": arrived.failure})
    text = (
        "a.heic: is of the format HEIC, which COLMAP cannot read; convert it to PNG or "
        "JPEG (colmap-affrect convert)"
    )
    content = report.to_mapping()
    assert content["failures"] == {"a.heic": text}
    assert content["failed"] == {
        "a.heic": {"code": "foreign_format", "text": text, "format": "HEIC"}
    }
    assert "1 failed" in report.summary()


def test_any_error_of_a_photograph_is_a_failure_with_what_it_says() -> None:
    error = unusable("no_memory", Path("a.png"))
    assert failure_of(error) == error.failure
    other = failure_of(StoreError("is odd", where=Path("x"), advice="mend it"))
    assert (other.code, other.path, other.values) == (
        "unreadable",
        "x",
        {"reason": "is odd"},
    )


def test_options_of_failures_are_called_as_who_reads_them_calls_them() -> None:
    report = StageReport("extract", 1.0, 0, failed={"a": ImageFailure("no_memory")})
    assert "resources.device cpu" in report.failures["a"]
    assert "--device cpu" in report.to_mapping()["failures"]["a"]
    assert "--device cpu" in report.to_mapping()["failed"]["a"]["text"]
    converted = ConversionReport(failed=report.failed)
    assert "resources.device cpu" in converted.failures["a"]
    assert "not a: not enough memory" in converted.summary()
    assert "--device cpu" in converted.summary()
    lines = LineReports(failed=report.failed)
    content = lines.to_mapping()
    assert content["failures"] == lines.failures == {"a": "not enough memory"}
    assert content["failed"]["a"]["code"] == "no_memory"
