"""Warnings are codes with values, and every code has its sentence."""

from __future__ import annotations

from string import Formatter
from typing import get_args

from colmap_affrect.errors import with_flags
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import (
    SENTENCES,
    StageWarning,
    WarningCode,
)


def test_every_warning_can_be_said() -> None:
    assert set(SENTENCES) == set(get_args(WarningCode))
    for code, sentence in SENTENCES.items():
        names = [n for _, n, *_ in Formatter().parse(with_flags(sentence)) if n]
        warning = StageWarning(code, "it", dict.fromkeys(names, "x"))
        assert with_flags(warning.line) == f"it: {warning.text()}"
        assert "{" not in warning.text()


def test_report_has_warnings_as_texts_and_as_codes_with_their_values() -> None:
    warning = StageWarning("pages", "a.tif", {"num_pages": 3})
    report = StageReport("extract", 1.0, 2, warned=(warning,))
    content = report.to_mapping()
    assert content["warnings"] == {"a.tif": warning.text()}
    assert content["warned"] == [
        {"code": "pages", "about": "a.tif", "text": warning.text(), "num_pages": 3}
    ]
    assert "1 with a warning" in report.summary()


def test_options_of_warnings_are_called_as_who_reads_them_calls_them() -> None:
    warned = (StageWarning("camera_stands_still", "pairs"),)
    report = StageReport("match", 1.0, 2, warned=warned)
    assert "(masks.path)" in report.warnings["pairs"]
    assert "(--mask-path)" in report.to_mapping()["warnings"]["pairs"]
    assert "(--mask-path)" in report.to_mapping()["warned"][0]["text"]


def test_no_sentence_names_a_flag_for_all_who_read_it() -> None:
    for sentence in SENTENCES.values():
        parts = sentence if isinstance(sentence, tuple) else (sentence,)
        assert not any("--" in part for part in parts if isinstance(part, str))
