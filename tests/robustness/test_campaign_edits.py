"""Campaign (tests/campaign.py): records of a run that somebody has edited, or an editor has saved.

They are refused, or made again, or nothing that they say has changed; never is a photograph called
surer than it was.
"""

from __future__ import annotations

import json
import random
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest
from campaign import CAMPAIGN, TIMES, assert_clear, run_words
from command import Call
from results import differences, tree

pytestmark = CAMPAIGN

RECORDS = ("cameras.json", "sparse/0/summary.json")
"""Of a run, in JSON; its texts are below."""
TEXTS = ("config.toml", "database.db.seal", "pairs.txt", "report.json", "run.log")
NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d+)?(?![\w.\"])")
ODD_NUMBERS = (
    "NaN",
    "Infinity",
    "-Infinity",
    "nan",
    "1e999",
    "-1",
    "0",
    "true",
    "null",
    '"x"',
    "[]",
    "{}",
    "9" * 400,
    "9" * 5000,
    "1e308",
    "0x10",
    "1,5",
    "1_000",
    "07",
    "٣",
)
ODD_NAMES = (
    "z.png",
    "../../etc/passwd",
    "",
    "a.png ",
    "A.PNG",
    "side/c\u030c.png",
    "\\ud800",
    "\\u0000",
    "b-c.png",
    "a" * 5000,
)

Edit = Callable[[str, random.Random], bytes]


def truncated(text: str, chance: random.Random) -> bytes:
    return text.encode()[: chance.randrange(len(text))]


def odd_number(text: str, chance: random.Random) -> bytes:
    places = list(NUMBER.finditer(text))
    if not places:
        return f"{text}{chance.choice(ODD_NUMBERS)}".encode()
    place = chance.choice(places)
    number = chance.choice(ODD_NUMBERS)
    return f"{text[: place.start()]}{number}{text[place.end() :]}".encode()


def other_number(text: str, chance: random.Random) -> bytes:
    places = list(NUMBER.finditer(text))
    if not places:
        return b"1" + text.encode()
    place = chance.choice(places)
    factor = chance.choice((0.5, 1.01, 2.0, 1000.0))
    number = f"{float(place.group()) * factor:.12g}"
    return f"{text[: place.start()]}{number}{text[place.end() :]}".encode()


def other_name(text: str, chance: random.Random) -> bytes:
    name = chance.choice(("a.png", "side/d.png", "b-c.png"))
    count = chance.choice((1, -1))
    return text.replace(name, chance.choice(ODD_NAMES), count).encode()


def _two_lines(text: str, chance: random.Random) -> tuple[list[str], int, int]:
    lines = text.splitlines(keepends=True)
    return lines, chance.randrange(len(lines)), chance.randrange(len(lines))


def swapped(text: str, chance: random.Random) -> bytes:
    lines, first, second = _two_lines(text, chance)
    lines[first], lines[second] = lines[second], lines[first]
    return "".join(lines).encode()


def doubled(text: str, chance: random.Random) -> bytes:
    lines, first, second = _two_lines(text, chance)
    lines.insert(first, lines[second])
    return "".join(lines).encode()


def without_a_line(text: str, chance: random.Random) -> bytes:
    lines, first, _ = _two_lines(text, chance)
    del lines[first]
    return "".join(lines).encode()


def saved_otherwise(text: str, chance: random.Random) -> bytes:
    encoding = chance.choice(
        ("utf-16", "utf-32", "utf-8-sig", "utf-7", "cp1252", "crlf")
    )
    if encoding == "crlf":
        return text.replace("\n", "\r\n").encode()
    return text.encode(encoding, "replace")


def of_another_program(text: str, chance: random.Random) -> bytes:
    whole = (
        "",
        "[]",
        "null",
        "3",
        '{"a": 1}',
        "[" * 100_000,
        "{}",
        "x = 1",
        "<html>",
        text * 2,
    )
    return chance.choice(whole).encode()


def moved_values(text: str, chance: random.Random) -> bytes:
    """Give one entry of JSON the value of another one."""
    try:
        values: Any = json.loads(text)
    except ValueError:
        return swapped(text, chance)
    inner = values
    while isinstance(inner, dict) and len(inner) > 1:
        first, second = chance.sample(sorted(inner), 2)
        if not isinstance(inner[first], dict) or chance.random() < 0.3:
            inner[first], inner[second] = inner[second], inner[first]
            break
        inner = inner[first]
    return json.dumps(values, indent=1).encode()


EDITS: tuple[Edit, ...] = (
    truncated,
    odd_number,
    odd_number,
    other_number,
    other_number,
    other_name,
    swapped,
    doubled,
    without_a_line,
    saved_otherwise,
    of_another_program,
    moved_values,
    moved_values,
)


def said_of(out: Path) -> dict[str, Any]:
    """What a run says of its photographs and cameras."""
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    kept = (
        "registered_names",
        "probabilities",
        "doubtful",
        "unsure",
        "cameras",
        "points3D",
    )
    return {key: report[key] for key in kept}


@pytest.mark.parametrize("number", range(105 * TIMES))
def test_edited_record_makes_nothing_surer(
    scene: Path, tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"edit {number}")
    names = RECORDS if number % 3 else TEXTS
    name = chance.choice(names)
    edit = EDITS[number % len(EDITS)]
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    path = out / name
    path.write_bytes(edit(path.read_text(encoding="utf-8"), chance))
    sys.stdout.write(f"{name}: {edit.__name__}\n")  # shown when the test fails
    before = tree(out)
    doctor = call("doctor", "-q", out)
    assert doctor.code in (0, 1), doctor
    assert "Traceback" not in doctor.stdout + "".join(doctor.stderr), doctor
    assert differences(before, tree(out)) == []
    end = call(*run_words(scene, out), "--no-page")
    assert_clear(end, 0, 1, 2)
    if end.code:
        assert doctor.code == 1 or end.code == 2, (doctor, end)
    else:
        assert said_of(out) == said_of(scene / "out"), end
    for file in ("features.h5", "matches.h5"):
        assert (out / file).read_bytes() == (scene / "out" / file).read_bytes()


STORES = ("features.h5", "matches.h5", "guided.h5")
ODD_ATTRIBUTES = (
    -1,
    1,
    7,
    1 << 40,
    0.5,
    float("nan"),
    "x",
    b"\xff",
    [1, 2],
    ["b.png", "a.png"],
    True,
    '{"step": {"level": 7, "pairs": [["a.png", "z.png"]]}}',
    '{"stationary": [[[320, 240], [[99999, -5]]]]}',
    '{"backgrounds": [["a.png", "zz"]]}',
)


def odd_attribute(file: h5py.File, chance: random.Random) -> str:
    """Change, add or remove an attribute of an entry, or of the file."""
    entries: list[Any] = [file]
    file.visititems(lambda _, item: entries.append(item) if len(item.attrs) else None)
    entry = chance.choice(entries)
    name = chance.choice([*entry.attrs, "level"])
    value = chance.choice(ODD_ATTRIBUTES)
    if chance.random() < 0.2 and name in entry.attrs:
        del entry.attrs[name]
    else:
        entry.attrs[name] = value
    return f"{entry.name} {name}={value!r}"


def odd_link(file: h5py.File, chance: random.Random) -> str:
    """Have an entry or its values linked from elsewhere."""
    keys: list[str] = []
    file.visit(keys.append)
    key, source = chance.sample(keys, 2)
    link = chance.choice(
        (
            h5py.SoftLink(f"/{source}"),
            h5py.SoftLink("/nowhere"),
            h5py.SoftLink(f"/{key}"),
            h5py.ExternalLink(file.filename, f"/{source}"),
            h5py.ExternalLink("none.h5", "/x"),
        )
    )
    del file[key]
    file[key] = link
    return f"{key} -> {link.path}"


@pytest.mark.parametrize("number", range(16 * TIMES))
def test_edited_store_makes_nothing_surer(
    scene: Path, tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"store {number}")
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    path = out / chance.choice(STORES)
    edit = (odd_attribute, odd_link)[number % 2]
    with h5py.File(path, "r+") as file:
        what = edit(file, chance)
    sys.stdout.write(f"{path.name}: {what}\n")  # shown when the test fails
    assert call("doctor", "-q", out).code in (0, 1)
    end = call(*run_words(scene, out), "--no-page")
    assert_clear(end, 0, 1, 2)
    if not end.code:
        before, after = said_of(scene / "out"), said_of(out)
        for name, probability in after["probabilities"].items():
            assert probability <= before["probabilities"][name] + 0.05
    for words in (["verify", "--overwrite"], ["map", "--no-page"]):
        assert_clear(call(*words, "-q", "--output-path", out), 0, 1, 2, 3)
