"""Campaign (tests/campaign.py): folders that are not ours."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from campaign import CAMPAIGN, COMPARED, PLAIN, Words, assert_clear
from command import FAST, Call
from results import differences, tree

pytestmark = CAMPAIGN

FILLERS: dict[str, Words] = {
    "run": ["--image-path", "{photos}", *FAST],
    "extract": ["--image-path", "{photos}", *FAST],
    "compare": ["--image-path", "{photos}", *COMPARED],
    "evaluate": ["evd", "--dataset-path", "{scene}/pairs", "--recipes", PLAIN[1]],
    "inspect": ["{photos}/a.png", *PLAIN],
    "map": ["--from-database", "{scene}/any.db"],
    "convert": ["--image-path", "{photos}"],
}
"""Commands that fill an output folder."""


@pytest.mark.parametrize("kind", ["report", "photographs", "above the photographs"])
@pytest.mark.parametrize("name", FILLERS)
def test_foreign_folder_is_refused(
    scene: Path, tmp_path: Path, call: Call, name: str, kind: str
) -> None:
    photos = Path(shutil.copytree(scene / "photos", tmp_path / "photos"))
    (tmp_path / "mine").mkdir()
    for mine in ("notes.txt", "report.html", "database.db", "run.log"):
        (tmp_path / "mine" / mine).write_text("mine")
    out = {"report": tmp_path / "mine", "photographs": photos}.get(kind, tmp_path)
    before = tree(tmp_path)
    words = [str(word).format(photos=photos, scene=scene) for word in FILLERS[name]]
    end = call(name, "-q", *words, "--output-path", out)
    assert not (harmed := differences(before, tree(tmp_path))), (harmed, end.code)
    assert_clear(end, 1, 2)
