from __future__ import annotations

import pytest

from colmap_affrect.project import stopwatch
from colmap_affrect.project.stopwatch import Stopwatch


def test_inner_steps_are_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock reads 0, 1, 2, ...: outer from 0 to 5, inner from 1 to 2 and from 3 to 4."""
    ticks = iter(range(100))
    monkeypatch.setattr(stopwatch.time, "perf_counter", lambda: next(ticks))
    watch = Stopwatch("never", "outer")
    with watch.step("outer"):
        for _ in range(2):
            with watch.step("inner"):
                pass
    with pytest.raises(ValueError, match="broken"), watch.step("outer"):
        raise ValueError("broken")
    assert watch.seconds == {"never": 0, "outer": 3 + 1, "inner": 2}
    assert list(watch.seconds) == ["never", "outer", "inner"]
