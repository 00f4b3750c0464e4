"""Pair lists as COLMAP and hloc write them, and with names that those cannot handle."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_affrect.errors import PairListError
from colmap_affrect.matching.pairs import exhaustive_pairs, read_pairs, write_pairs

NAMES = ["a.png", "b.png", "new wing/a 1.png", "new wing/b.png", "č, d.png"]


@pytest.fixture
def pair_list(tmp_path: Path) -> Path:
    return tmp_path / "list of pairs.txt"


@pytest.mark.parametrize(
    ("names", "count"), [([], 0), (["a"], 0), (["b", "a"], 1), (["c", "a", "b", "d"], 6)]
)
def test_exhaustive_pairs_are_all_pairs_once(names: list[str], count: int) -> None:
    pairs = exhaustive_pairs(names)
    assert len(set(pairs)) == len(pairs) == count
    assert all(first < second for first, second in pairs)
    assert pairs == sorted(pairs)


@pytest.mark.parametrize(
    "line",
    [
        "a.png b.png",
        "a.png   b.png",
        "a.png\tb.png",
        "a.png,b.png",
        "a.png, b.png",
        "  a.png b.png  ",
        "\ufeffa.png b.png",
        "a.png b.png\r",
    ],
)
def test_read_pairs_takes_space_tab_and_comma(pair_list: Path, line: str) -> None:
    pair_list.write_bytes(f"{line}\n".encode())
    assert read_pairs(pair_list, NAMES) == [("a.png", "b.png")]


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", ", "  "])
def test_read_pairs_takes_names_with_spaces_and_commas(pair_list: Path, separator: str) -> None:
    pairs = [("new wing/a 1.png", "new wing/b.png"), ("a.png", "č, d.png")]
    text = "".join(f"{first}{separator}{second}\n" for first, second in pairs)
    pair_list.write_text(text, encoding="utf-8")
    assert read_pairs(pair_list, NAMES) == sorted(pairs)


def test_read_pairs_skips_comments_and_empty_lines(pair_list: Path) -> None:
    pair_list.write_text("# a.png b.png\n\n   \n  # more\na.png new wing/b.png\n")
    assert read_pairs(pair_list, NAMES) == [("a.png", "new wing/b.png")]


def test_read_pairs_counts_a_pair_once_and_drops_self_pairs(pair_list: Path) -> None:
    pair_list.write_text("b.png a.png\na.png a.png\na.png b.png\na.png b.png\n")
    assert read_pairs(pair_list, NAMES) == [("a.png", "b.png")]


def test_read_pairs_lists_unknown_names_with_line_and_suggestion(pair_list: Path) -> None:
    pair_list.write_text("a.png b.png\na.png bb.png\n\nzzzz 1234\n")
    with pytest.raises(PairListError) as error:
        read_pairs(pair_list, NAMES)
    text = str(error.value)
    assert "\n" not in text
    assert str(pair_list) in text
    assert "line 2: 'a.png bb.png' (did you mean b.png?)" in text
    assert "line 4: 'zzzz 1234'" in text
    assert "line 1" not in text


def test_read_pairs_of_many_unknown_names_stays_short(pair_list: Path) -> None:
    pair_list.write_text("".join(f"x{index}.jpg a.png\n" for index in range(300)))
    with pytest.raises(PairListError, match="and 295 more") as error:
        read_pairs(pair_list, NAMES)
    assert len(str(error.value)) < 1000


@pytest.mark.parametrize("text", ["", "\n \n", "# nothing\n", "a.png a.png\n"])
def test_read_pairs_of_a_list_without_pairs_is_refused(pair_list: Path, text: str) -> None:
    pair_list.write_text(text)
    with pytest.raises(PairListError, match="holds no pair of two different images"):
        read_pairs(pair_list, NAMES)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00a"], ids=["missing", "not UTF-8"])
def test_read_pairs_of_an_unreadable_file_is_refused(
    pair_list: Path, content: bytes | None
) -> None:
    if content:
        pair_list.write_bytes(content)
    with pytest.raises(PairListError, match=r"list of pairs\.txt: cannot be read"):
        read_pairs(pair_list, NAMES)


def test_write_pairs_of_plain_names_is_what_hloc_and_colmap_read(pair_list: Path) -> None:
    write_pairs(pair_list, [("a.png", "b.png"), ("a.png", "c/d.png")])
    assert pair_list.read_text() == "a.png b.png\na.png c/d.png\n"


IMAGE_NAMES = st.lists(
    st.text(st.sampled_from("ab. ,#č图/"), min_size=1, max_size=6).map(lambda stem: f"{stem}.png"),
    min_size=2,
    max_size=6,
    unique=True,
)


@given(names=IMAGE_NAMES)
def test_written_list_reads_back(
    names: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.txt"
    pairs = exhaustive_pairs(names)
    write_pairs(path, pairs)
    assert read_pairs(path, names) == pairs
