"""The limits that keep the code readable name what passes them (tests/house.py)."""

from __future__ import annotations

from pathlib import Path

import house
import pytest

SIMPLE = "def simple(a):\n    return 1 if a else 2\n"
COMPLEX = "def tangled(a):\n" + "    if a:\n        a -= 1\n" * house.MAX_COMPLEXITY


def test_functions_that_are_too_complex_are_named_where_there_are_too_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in house.LIMITS:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "module.py").write_text(SIMPLE * 30)
    monkeypatch.setattr(house, "ROOT", tmp_path)
    house.main()
    assert "has to be split" not in capsys.readouterr().out
    (tmp_path / "colmap_affrect" / "module.py").write_text(
        SIMPLE + COMPLEX * (house.LIMITS["colmap_affrect"].complex_functions + 1)
    )
    assert house.main() == 1
    said = capsys.readouterr().out
    assert f"{tmp_path / 'colmap_affrect' / 'module.py'}:3 tangled" in said
    assert "simple" not in said
