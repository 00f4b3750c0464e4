"""Pair lists as COLMAP and hloc write them, and with names that those cannot handle."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.pairs import lists
from colmap_affrect.pairs.lists import (
    Pair,
    exhaustive_pairs,
    most_similar_pairs,
    ordered_for_reuse,
    read_pairs,
    read_pairs_once,
    sequence_pairs,
    write_pairs,
)

NAMES = ["a.png", "b.png", "new wing/a 1.png", "new wing/b.png", "č, d.png"]


@pytest.fixture
def pair_list(tmp_path: Path) -> Path:
    return tmp_path / "list of pairs.txt"


def test_sequence_pairs_follow_the_numbers_in_names() -> None:
    names = ["b/1.png", "a/10.png", "a/9.png", "a/8.png"]
    assert sequence_pairs(names, 1) == [
        ("a/10.png", "a/9.png"), ("a/10.png", "b/1.png"), ("a/8.png", "a/9.png"),
    ]  # fmt: skip
    assert sequence_pairs(names, 2) == sorted(
        [*sequence_pairs(names, 1), ("a/10.png", "a/8.png"), ("a/9.png", "b/1.png")]
    )
    assert sequence_pairs(names, 9) == exhaustive_pairs(names)


def num_read(pairs: Sequence[Pair], num_kept: int) -> int:
    """How many images are read when the most recently used ones are kept."""
    kept: list[str] = []
    count = 0
    for name in itertools.chain.from_iterable(pairs):
        count += name not in kept
        kept = [name, *(other for other in kept if other != name)][:num_kept]
    return count


@pytest.mark.parametrize("num_images", [1, 40])
def test_ordered_pairs_are_the_same_pairs(num_images: int) -> None:
    pairs = [("a", "b"), ("c", "d"), ("b", "c"), ("x", "y"), ("a", "y")]
    assert sorted(ordered_for_reuse(pairs, num_images)) == sorted(pairs)
    assert list(ordered_for_reuse([], num_images)) == []


def test_few_images_are_read_again_for_all_pairs() -> None:
    pairs = exhaustive_pairs([f"{index:02d}" for index in range(40)])
    ordered = ordered_for_reuse(pairs, 5)
    assert num_read(ordered, 10) <= 8 * 9 // 2 * 10 < num_read(pairs, 10) // 2
    assert list(ordered_for_reuse(pairs, 40)) == pairs


def crowd_and_few() -> tuple[list[str], np.ndarray]:
    """Similarities of 8 images of one place, and of 4 of another where all are less alike."""
    random = np.random.default_rng(0)
    similarity = random.uniform(0.0, 0.1, (12, 12))
    similarity[:8, :8] = random.uniform(0.8, 0.9, (8, 8))
    similarity[8:, 8:] = random.uniform(0.4, 0.5, (4, 4))
    similarity = np.maximum(similarity, similarity.T)
    return [f"{index:02d}" for index in range(12)], similarity


def neighbors(pairs: list[Pair], name: str) -> set[str]:
    """What a name is paired with."""
    found = set[str]()
    for pair in pairs:
        if name in pair:
            found.update(pair)
    return found - {name}


def test_most_similar_pairs_are_as_many_as_asked_for_on_average() -> None:
    names, similarity = crowd_and_few()
    pairs = most_similar_pairs(names, similarity, 4)
    assert len(pairs) == len(set(pairs)) == 12 * 4 // 2
    assert pairs == sorted(pairs)
    assert all(first < second for first, second in pairs)


def test_each_photograph_has_half_as_many_of_its_most_similar_ones() -> None:
    names, similarity = crowd_and_few()
    pairs = most_similar_pairs(names, similarity, 4)
    for index, name in enumerate(names):
        order = np.argsort(-similarity[index])
        nearest = [names[other] for other in order[order != index][:2]]
        assert neighbors(pairs, name).issuperset(nearest)


def test_pairs_that_are_over_go_to_the_crowd_although_the_few_have_some_left() -> None:
    names, similarity = crowd_and_few()
    pairs = most_similar_pairs(names, similarity, 4)
    of_crowd = [pair for pair in pairs if pair[0] < "08"]
    assert len(pairs) - len(of_crowd) < 6
    assert max(second for _, second in of_crowd) < "08"


def test_an_image_proposes_five_times_as_many_pairs_as_it_gets_on_average() -> None:
    names = [f"{index:03d}" for index in range(40)]
    similarity = np.random.default_rng(0).uniform(0.0, 0.1, (40, 40))
    similarity[0] = similarity[:, 0] = 0.9
    pairs = most_similar_pairs(names, similarity[:1], 2)
    assert len(pairs) == 5 * 2


@pytest.mark.parametrize(("text", "pairs"), [
    ("a.png\tb.png\n", [("a.png", "b.png")]),
    ("a.png, b.png\n", [("a.png", "b.png")]),
    ("\ufeff  a.png b.png  \r\n", [("a.png", "b.png")]),
    ("# a.png b.png\n\n   \n  # more\na.png new wing/b.png\n", [("a.png", "new wing/b.png")]),
    ("new wing/b.png new wing/a 1.png\n", [("new wing/a 1.png", "new wing/b.png")]),
    ("a.png, č, d.png\n", [("a.png", "č, d.png")]),
])  # fmt: skip
def test_read_pairs_takes_what_others_write(
    pair_list: Path, text: str, pairs: list[Pair]
) -> None:
    pair_list.write_bytes(text.encode())
    assert list(read_pairs(pair_list, NAMES)) == pairs


FOLDER = "/data/old photos"


@pytest.mark.parametrize(("text", "pairs"), [
    ("a.png b.png 0.713\n", [("a.png", "b.png")]),
    ("a.png,b.png,-1.5e-3\n", [("a.png", "b.png")]),
    ("a.png\tnew wing/b.png\t12\n", [("a.png", "new wing/b.png")]),
    ("a.png new wing\\b.png\n", [("a.png", "new wing/b.png")]),
    ("new wing\\a 1.png\tnew wing\\b.png\t1.\n", [("new wing/a 1.png", "new wing/b.png")]),
    (f"{FOLDER}/a.png {FOLDER}/b.png\n", [("a.png", "b.png")]),
    (f"{FOLDER}/new wing/b.png,{FOLDER}/a.png,.5\n", [("a.png", "new wing/b.png")]),
    (f"{FOLDER}/a.png b.png\n".replace("/", "\\"), [("a.png", "b.png")]),
    ("./a.png ./new wing/b.png\n", [("a.png", "new wing/b.png")]),
])  # fmt: skip
def test_scores_backslashes_and_paths_into_the_folder_are_read(
    pair_list: Path, text: str, pairs: list[Pair]
) -> None:
    pair_list.write_text(text, encoding="utf-8")
    assert list(read_pairs(pair_list, NAMES, Path(FOLDER))) == pairs


def test_relative_folder_of_photographs_is_found_in_absolute_paths(
    pair_list: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    pair_list.write_text(f"{tmp_path}/photos/a.png photos/b.png\n", encoding="utf-8")
    for folder in (Path("photos"), tmp_path / "photos"):  # a run has the whole path
        assert list(read_pairs(pair_list, NAMES, folder)) == [("a.png", "b.png")]


def test_a_current_folder_that_is_gone_keeps_no_list_from_being_read(
    pair_list: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    here.rmdir()
    pair_list.write_text(f"{tmp_path}/photos/a.png b.png\n", encoding="utf-8")
    found = read_pairs(pair_list, NAMES, tmp_path / "photos")
    assert list(found) == [("a.png", "b.png")]


@pytest.mark.parametrize("text", [
    "/elsewhere/a.png /elsewhere/b.png\n", "a.png b.png 0.5 0.7\n", "a.png 0.5\n",
])  # fmt: skip
def test_paths_elsewhere_and_more_columns_are_refused(
    pair_list: Path, text: str
) -> None:
    pair_list.write_text(text, encoding="utf-8")
    with pytest.raises(AffrectError, match=r"line 1: .* is not two names of images"):
        read_pairs(pair_list, NAMES, Path(FOLDER))


def test_read_pairs_lists_unknown_names_with_line_and_suggestion(
    pair_list: Path,
) -> None:
    pair_list.write_text("a.png b.png\na.png bb.png\n\nzzzz 1234\n")
    with pytest.raises(AffrectError) as error:
        read_pairs(pair_list, NAMES)
    assert str(error.value) == (
        f"{pair_list}: line 2: 'a.png bb.png' is not two names of images (did you mean b.png?), "
        "nor are 1 more lines"
    )


@pytest.mark.parametrize(("content", "error", "message"), [
    (b"# nothing\n", AffrectError, "holds no pair of two different images"),
    (b"a.png a.png\n", AffrectError, "holds no pair of two different images"),
    ("a.png b.png\n".encode("utf-16"), OptionError, r"pairs\.txt: is no text in UTF-8; save"),
    (b"\0" * 5000, OptionError, r"line 1: '.{150,250}' is not two names of images$"),
    (None, OptionError, r"list of pairs\.txt: cannot be read"),
])  # fmt: skip
def test_read_pairs_refuses_other_files(
    pair_list: Path, content: bytes | None, error: type[Exception], message: str
) -> None:
    if content:
        pair_list.write_bytes(content)
    with pytest.raises(error, match=message):
        read_pairs(pair_list, NAMES)


def test_write_pairs_of_plain_names_is_what_hloc_and_colmap_read(
    pair_list: Path,
) -> None:
    write_pairs(pair_list, [("a.png", "b.png"), ("a.png", "c/d.png")])
    assert pair_list.read_text() == "a.png b.png\na.png c/d.png\n"


IMAGE_NAMES = st.lists(
    st.text(st.sampled_from("ab. ,#č图/"), min_size=1, max_size=6).map(
        lambda stem: f"{stem}.png"
    ),
    min_size=2,
    max_size=6,
    unique=True,
)


@pytest.mark.parametrize(("names", "text", "pair"), [
    (["a", "b", " a"], " a b", (" a", "b")),
    (["a", "b", "b "], "a b ", ("a", "b ")),
    (["a", "b", "a,b", "c", "b c"], "a,b c\n", ("a", "b c")),
    (["a", "b"], "b a\n", ("a", "b")),
])  # fmt: skip
def test_names_of_lines_that_look_plain_may_have_separators(
    pair_list: Path, names: list[str], text: str, pair: Pair
) -> None:
    pair_list.write_text(text)
    assert list(read_pairs(pair_list, names)) == [pair]


def test_a_list_is_read_once_while_nobody_writes_it(
    pair_list: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["a.png", "b.png", "c.png"]
    read = Mock(wraps=lists.read_pairs)
    monkeypatch.setattr(lists, "read_pairs", read)
    write_pairs(pair_list, [("a.png", "b.png")])
    for _ in range(2):
        assert list(read_pairs_once(pair_list, names)) == [("a.png", "b.png")]
    assert read.call_count == 1
    write_pairs(pair_list, [("a.png", "c.png")])  # as long, perhaps within one tick
    assert list(read_pairs_once(pair_list, names)) == [("a.png", "c.png")]
    assert list(read_pairs_once(pair_list, names[:1] + names[2:])) == [
        ("a.png", "c.png")
    ]
    assert read.call_count == 3


@given(names=IMAGE_NAMES)
def test_written_list_reads_back(
    names: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.txt"
    pairs = exhaustive_pairs(names)
    write_pairs(path, pairs)
    assert list(read_pairs(path, names)) == pairs
