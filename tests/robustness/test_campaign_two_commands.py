"""Campaign (tests/campaign.py): two commands at once on one folder harm nothing."""

from __future__ import annotations

import random
import shutil
import time
from itertools import product
from pathlib import Path

import pytest
from campaign import CAMPAIGN, COMPARED, PLAIN, Words, assert_clear, run_words
from command import FAST, Ended, run_in_process_of_its_own, start
from results import tree

pytestmark = CAMPAIGN

WRITERS: dict[str, Words] = {
    "map": ["map", "-q", "--output-path", "{out}", "--no-page", "--overwrite"],
    "match": ["match", "-q", "--output-path", "{out}", "--overwrite"],
}
MORE_WRITERS: dict[str, Words] = {
    "extract": ["extract", "-q", "--image-path", "{photos}", "--output-path", "{out}", *FAST],
    "pairs": ["pairs", "-q", "--output-path", "{out}", "--overwrite"],
    "verify": ["verify", "-q", "--output-path", "{out}", "--overwrite"],
    "run": ["run", "-q", "--image-path", "{photos}", "--output-path", "{out}", *FAST,
            "--set", "guided.enabled=always", "--no-page"],
}  # fmt: skip
"""Commands that make again what is in a folder."""
OTHERS: dict[str, Words] = {
    "export": ["export", "-q", "--model-path", "{out}/sparse/0", "--output-path", "{new}"],
    "align": ["align", "-q", "--model-path", "{out}/sparse/0", "--output-path", "{new}",
              "--distance", "a.png,b-c.png,2"],
    "inspect": ["inspect", "-q", "{photos}/a.png", "--output-path", "{out}", *PLAIN],
    "lines": ["lines", "-q", "{photos}/a.png", "--output-path", "{new}"],
    "compare": ["compare", "-q", "--image-path", "{photos}", "--output-path", "{new}",
                *COMPARED],
    "doctor": ["doctor", "-q", "{out}"],
    "show-pair": ["show-pair", "-q", "{out}", "a.png", "b-c.png", "--output-path", "{new}.png"],
    "export-h5": ["export-h5", "-q", "--database-path", "{out}/database.db",
                  "--features-path", "{new}.features", "--matches-path", "{new}.matches"],
}  # fmt: skip
"""Commands that read it, or write beside it."""
MORE_OTHERS: dict[str, Words] = {
    "export-database": ["export-database", "-q", "{out}", "{new}.old.db", "--colmap", "3.8"],
}  # fmt: skip
ALL = WRITERS | MORE_WRITERS | OTHERS | MORE_OTHERS
MAX_DELAY_S = 1.2  # between both: until about then a command loads packages


@pytest.mark.parametrize(("writer", "other"), [*product(WRITERS, OTHERS)])
def test_two_commands_at_once_harm_nothing(
    scene: Path, tmp_path: Path, writer: str, other: str
) -> None:
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    photos = scene / "photos"
    delay_s = random.Random(f"{writer} {other}").uniform(0.0, MAX_DELAY_S)
    paths = {"out": out, "photos": photos, "new": tmp_path / "new"}
    ends = list[Ended]()
    first = start(*(str(word).format(**paths) for word in WRITERS[writer]))
    time.sleep(delay_s)
    second = start(*(str(word).format(**paths) for word in OTHERS[other]))
    for process in (first, second):
        stdout, stderr = process.communicate()
        ends.append(Ended(process.returncode, stdout, stderr.splitlines()))
    assert_clear(ends[0], 0)
    if other == "doctor":  # which prints what it finds
        assert "Traceback" not in ends[1].stdout + "".join(ends[1].stderr), ends[1]
    else:
        assert_clear(ends[1], 0, 1, 2)
    again = run_in_process_of_its_own(*run_words(scene, out))
    assert_clear(again, 0)
    assert run_in_process_of_its_own("doctor", "-q", out).code == 0


def ends_of_all(paths: dict[str, Path], chance: random.Random) -> dict[str, Ended]:
    """Start all commands in any order, a moment apart; return how they ended."""
    started = {}
    for name in chance.sample(sorted(ALL), len(ALL)):
        new = paths["new"].with_name(name)
        words = [str(word).format(**{**paths, "new": new}) for word in ALL[name]]
        started[name] = start(*words)
        time.sleep(chance.uniform(0.0, MAX_DELAY_S / 4))
    ends = {}
    for name, process in started.items():
        stdout, stderr = process.communicate()
        ends[name] = Ended(process.returncode, stdout, stderr.splitlines())
    return ends


@pytest.mark.parametrize("number", range(2))
def test_all_commands_at_once_harm_nothing(
    scene: Path, tmp_path: Path, number: int
) -> None:
    """Each meets each other one: a pair at a time would take too long."""
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    photos = Path(shutil.copytree(scene / "photos", tmp_path / "photos"))
    before = tree(photos)
    paths = {"out": out, "photos": photos, "new": tmp_path / "new"}
    ends = ends_of_all(paths, random.Random(f"all {number}"))
    for name, end in ends.items():
        if name == "doctor":  # which prints what it finds
            assert "Traceback" not in end.stdout + "".join(end.stderr), end
        else:
            assert_clear(end, 0, 1, 2, 3)
    given = [str(word).format(**paths) for word in MORE_WRITERS["run"]]
    again = run_in_process_of_its_own(*given)
    assert_clear(again, 0)
    assert "registered  4 of 4 images" in again.stdout
    assert run_in_process_of_its_own("doctor", "-q", out).code == 0
    assert tree(photos) == before
