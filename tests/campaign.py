"""A campaign of attacks on the command line: nothing of the user's is ever harmed.

    pytest -m long --dist load tests/robustness -k campaign
    CAMPAIGN=10 pytest -m long --dist load tests/robustness -k campaign

The second line makes ten times as many trials by chance. Each trial has a number, which seeds it,
stands alone, and says what it did when it fails. Each kind of attack has a file of its own,
``tests/robustness/test_campaign_*.py``. Kills and full disks: test_interruption.py.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from command import CAMERA, FAST, Ended

CAMPAIGN = [pytest.mark.long, pytest.mark.usefixtures("ends_in_time")]
TIMES = int(os.environ.get("CAMPAIGN", "1"))
PLAIN = ["--recipe", "unrectified-rootsift"]
COMPARED = ["--methods", PLAIN[1], "--seeds", "0", *CAMERA]

Words = list[object]


def run_words(scene: Path, out: Path) -> Words:
    """Arguments of the run of the scene."""
    given = ["--image-path", scene / "photos", "--output-path", out]
    return ["run", "-q", *given, *FAST, "--set", "guided.enabled=always"]


def assert_clear(end: Ended, *codes: int) -> None:
    """No traceback, one of these exit codes, and one line that says why if it is not 0."""
    assert "Traceback" not in end.stdout + "".join(end.stderr), end
    assert end.code in codes, end
    assert len(end.errors) == bool(end.code), end
    assert not end.code or len(end.stderr) == 1, end
