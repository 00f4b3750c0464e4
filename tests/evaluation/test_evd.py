"""Layouts of pairs with homographies, and files that are missing or damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from planar_pairs import TRUTH, write_extreme_views, write_pair

from colmap_affrect.errors import EvaluationError, OptionError
from colmap_affrect.evaluation.evaluate import PROTOCOLS, make_protocol
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.protocol import PairScore

UNCHECKED = Evd()


def test_layout_of_the_extreme_view_dataset(tmp_path: Path) -> None:
    write_extreme_views(tmp_path, ["cafe"])
    (pair,) = UNCHECKED.load(tmp_path).pairs
    assert [image.name for image in pair.images] == ["1/cafe.png", "2/cafe.png"]
    assert (pair.name, pair.problem) == ("cafe", "")
    np.testing.assert_allclose(pair.truth.matrix, TRUTH)
    assert pair.truth.size1 == (160, 120)


def test_sequences_as_oxfords(tmp_path: Path) -> None:
    write_pair(tmp_path / "my_wall_1.png", tmp_path / "my_wall_2.png", seed=1)
    (tmp_path / "my_wall_3.png").write_bytes((tmp_path / "my_wall_2.png").read_bytes())
    for number, shift in ((3, 7.0), (2, 0.0)):
        matrix = TRUTH + np.array([[0, 0, shift], [0, 0, 0], [0, 0, 0]])
        np.savetxt(tmp_path / f"H_my_wall_1_{number}.txt", matrix)
    dataset = UNCHECKED.load(tmp_path)
    assert [pair.name for pair in dataset.pairs] == ["my_wall 1-2", "my_wall 1-3"]
    assert dataset.pairs[1].images[1].name == "my_wall_3.png"
    assert dataset.pairs[1].truth.matrix[0, 2] == TRUTH[0, 2] + 7.0
    assert dataset.notes == ()


def test_files_that_are_missing_or_damaged_are_named_and_fail_their_pair(tmp_path: Path) -> None:
    write_extreme_views(tmp_path, ["good", "imageless", "truthless", "endless", "flat", "broken"])
    (tmp_path / "2" / "imageless.png").unlink()
    (tmp_path / "h" / "truthless.txt").unlink()
    np.savetxt(tmp_path / "h" / "endless.txt", TRUTH * [np.nan, 1, 1])
    np.savetxt(tmp_path / "h" / "flat.txt", TRUTH[[0, 0, 0]])
    (tmp_path / "1" / "broken.png").write_bytes(b"no image")
    dataset = UNCHECKED.load(tmp_path)
    problems = {pair.name: pair.problem for pair in dataset.pairs}
    assert problems["good"] == ""
    assert "imageless.png: missing" in problems["imageless"]
    assert "truthless.txt: missing" in problems["truthless"]
    assert "not finite" in problems["endless"]
    assert "singular" in problems["flat"]
    assert "not a readable image" in problems["broken"]
    notes = "\n".join(dataset.notes)
    assert "6 pairs; the dataset of the paper has 15" in notes
    assert notes.count("counts as failed") == 5


def test_other_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"holds neither 1/NAME\.png"):
        UNCHECKED.load(tmp_path)


def test_success_is_an_error_below_five_px() -> None:
    assert [UNCHECKED.success(PairScore(error, 9)) for error in (4.9, 5.0)] == [1.0, 0.0]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_protocol_has_what_the_frame_needs(name: str) -> None:
    protocol = make_protocol(name)
    assert protocol.name == name
    assert protocol.error_title
    assert isinstance(protocol.category_title, str)
    assert protocol.settings()
    assert not any(protocol.summarize([]).values())


def test_settings_of_a_protocol_are_read_by_their_type() -> None:
    protocol = make_protocol("evd", ["magsac_threshold_px=1"])
    assert protocol == Evd(magsac_threshold_px=1.0)
    for setting, message in (
        ("magsac_treshold_px=1", "did you mean 'magsac_threshold_px'"),
        ("threshold_px", "expected KEY=VALUE"),
        ("threshold_px=wide", "expected float"),
        ("threshold_px=-1", "is outside"),
        ("threshold_px=" + 20_000 * "[", "expected float"),
    ):
        with pytest.raises(OptionError, match=message):
            make_protocol("evd", [setting])
