"""Levels without measured frames: their matches join those of others, or give way to them."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import INTRINSICS, NAMES

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.verification import PairVerifier, VerificationOptions, verified_pairs
from colmap_affrect.features.base import EXTRACTORS
from colmap_affrect.geometry.arrays import rows_in
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.project.stores import PairMatches
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions, load_recipe
from colmap_affrect.stages import map as stage
from colmap_affrect.stages.context import Context, Inputs
from colmap_affrect.stages.escalate import (
    MIN_NUM_TELLING,
    OUTNUMBERED,
    Escalation,
    escalate,
)
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verified_inliers, verify_matches

PAIR = NAMES[0], NAMES[1]
Counts = dict[tuple[int, int], int]
RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = "shapeless"
[escalate]
strong_num_inliers = 1000000
max_seconds_per_image = 1e9
"""


@pytest.fixture(scope="module", autouse=True)
def _shapeless() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXTRACTORS.built_in, "shapeless", "shapeless_features:Shapeless")
        yield


@pytest.fixture(scope="module")
def escalated(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, Counts]:
    """All pairs have escalated to the level without measured frames; what they had before."""
    folder = tmp_path_factory.mktemp("escalated")
    (folder / "recipe.toml").write_text(RECIPE)
    workspace = Workspace(folder / "out")
    cameras = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)
    with workspace.locked():
        context = Context(workspace)
        inputs = Inputs.of(photos, cameras=cameras)
        extract(context, inputs, load_recipe(str(folder / "recipe.toml")))
        choose_pairs(context)
        match(context)
        verify_matches(context)
        before = verified_pairs(workspace.database, 1)
        escalate(context)
    return workspace, before


@pytest.fixture
def context(escalated: tuple[Workspace, Counts], tmp_path: Path) -> Context:
    return Context(Workspace(Path(shutil.copytree(escalated[0].path, tmp_path / "out"))))


def escalation_of(context: Context) -> Escalation:
    return Escalation(context, load_recipe("default").escalate)


def shapeless_only(escalation: Escalation, *pairs: tuple[str, str]) -> None:
    """Take the matches of measured frames from some pairs."""
    for found in list(escalation.matches.read(pairs)):
        rows = ~escalation.measured(found.names, found.indices)
        kept = replace(found, indices=found.indices[rows], scores=found.scores[rows])
        escalation.matches.write([kept])
    escalation.write()


def test_matches_of_both_kinds_of_frames_are_united(
    escalated: tuple[Workspace, Counts], context: Context
) -> None:
    before, escalation = escalated[1], escalation_of(context)
    assert set(escalation.matches.levels(escalation.pairs).values()) == {1}
    after = verified_pairs(context.workspace.database, 1)
    assert len(after) == len(before) == 6
    for pair, inliers in verified_inliers(escalation.context).items():
        num_measured = np.count_nonzero(escalation.measured(pair, inliers))
        assert 0.5 * len(inliers) < 2 * num_measured < 1.5 * len(inliers)
    assert all(after[ids] > 1.5 * before[ids] for ids in before)


def test_pairs_that_nothing_hints_at_escalate_to_features_of_another_kind(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of an image that no measured frames match, and not those of the others."""
    escalation_of(context).undo()
    own = [pair for pair in escalation_of(context).pairs if NAMES[3] in pair]
    for found in list(context.matches.read(own)):
        none = replace(found, indices=found.indices[:0], scores=found.scores[:0])
        context.matches.write([none], own, 0)
    escalation_of(context).write()
    options = EscalateOptions(strong_num_inliers=1, min_num_tracks=0)
    worthless = options.changed(max_seconds_per_image=0.0)
    assert Escalation(context, worthless).next_work() is None
    escalation = Escalation(context, options)
    assert escalation.next_work() == (1, own)

    written = escalation.matches.write

    def killed(found: list[PairMatches], tried: list[tuple[str, str]], level: int) -> None:
        written(found[:2], tried[:2], level)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(escalation.matches, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            escalation.match_at(own, 1)
    # The matches that are stored look different now; what is left of the step is not decided anew.
    escalation = Escalation(context, options)
    assert escalation.next_work() == (1, own[2:])
    escalation.match_at(own[2:], 1)
    assert min(escalation.num_inliers()[pair] for pair in own) > 30
    assert escalation.next_work() is None


class OneKind:
    """Says that a geometry explains measured matches, or the others, and never both."""

    def __init__(self, escalation: Escalation, measured: bool) -> None:
        self._escalation, self._measured = escalation, measured

    def inliers(self, names: tuple[str, str], _: object, indices: NDArray[Any]) -> NDArray[Any]:
        rows = self._escalation.measured(names, indices) == self._measured
        return indices[rows] if rows.any() else indices

    def are_explained(self, _: object, __: object, indices: NDArray[Any], *___: object) -> Any:
        return np.ones(len(indices), np.bool_)


@pytest.mark.parametrize(
    ("is_measured", "worth"), [(False, 0), (True, math.inf)], ids=["they stay", "they win"]
)
def test_measured_frames_decide_where_both_kinds_differ(
    context: Context, is_measured: bool, worth: float
) -> None:
    escalation = escalation_of(context)
    (found,) = escalation.matches.read([PAIR])
    measured = escalation.measured(PAIR, found.indices)
    new = measured == is_measured
    level = replace(found, indices=found.indices[new], scores=found.scores[new])
    others = found.indices[~new]
    disagreeing = cast("PairVerifier", OneKind(escalation, measured=False))
    chosen, worth_found = escalation._judged(level, others, disagreeing)
    assert chosen is level
    assert worth_found == (worth, 0)
    agreeing = cast("PairVerifier", OneKind(escalation, measured=True))
    united, (count, _) = escalation._judged(level, others, agreeing)
    assert np.array_equal(united.indices, found.indices)
    assert count == (math.inf if is_measured else np.count_nonzero(measured))


class Outnumbering:
    """Says that a geometry explains all matches of other frames, and the first measured ones."""

    def __init__(self, escalation: Escalation, num_measured: int) -> None:
        self._escalation, self._num_measured = escalation, num_measured

    def inliers(self, names: tuple[str, str], _: object, indices: NDArray[Any]) -> NDArray[Any]:
        measured = self._escalation.measured(names, indices)
        return np.concatenate([indices[~measured], indices[measured][: self._num_measured]])


@pytest.mark.parametrize("num_fewer", [0, 1], ids=["many times more", "fewer"])
@pytest.mark.parametrize("num_kept", [5, 4], ids=["half agree", "most do not"])
def test_many_others_decide_where_half_of_the_measured_agree(
    context: Context, num_fewer: int, num_kept: int
) -> None:
    escalation = escalation_of(context)
    (found,) = escalation.matches.read([PAIR])
    measured = escalation.measured(PAIR, found.indices)
    level = np.flatnonzero(~measured)[: OUTNUMBERED * 10 - num_fewer]
    level_matches = replace(found, indices=found.indices[level], scores=found.scores[level])
    verifier = cast("PairVerifier", Outnumbering(escalation, num_kept))
    judged, worth = escalation._judged(level_matches, found.indices[measured][:10], verifier)
    if num_fewer or num_kept < 5:
        assert judged is level_matches
        assert worth == (0, 0)
    else:
        assert len(judged.indices) == len(level) + 10
        assert worth == (len(level) + num_kept, 0)


@pytest.mark.parametrize("step", [1, -1], ids=["from the first", "from the second"])
@pytest.mark.parametrize("num_measured", [MIN_NUM_TELLING, MIN_NUM_TELLING - 1])
def test_enough_measured_matches_decide_which_others_are_right(
    context: Context, step: int, num_measured: int
) -> None:
    escalation = escalation_of(context)
    (found,) = escalation.matches.read([PAIR])
    found = replace(found, names=PAIR[::step], indices=found.indices[:, ::step])
    measured = escalation.measured(found.names, found.indices)
    right, level = found.indices[measured][:num_measured], found.indices[~measured]
    wrong = np.stack([level[:, 0], np.roll(level[:, 1], len(level) // 2)], axis=1)
    indices = np.concatenate([level, wrong])
    both = replace(found, indices=indices, scores=np.ones(len(indices), np.float32))
    verifier = PairVerifier(context.workspace.database, VerificationOptions())
    united, _ = escalation._judged(both, right, verifier)
    is_wrong = rows_in(united.indices, wrong) & ~rows_in(united.indices, level)
    assert rows_in(right, united.indices).all()
    assert rows_in(level, united.indices).mean() > 0.9
    assert len(united.scores) == len(united.indices)
    if num_measured == MIN_NUM_TELLING:
        assert is_wrong.sum() < 0.1 * len(wrong)
    else:
        assert is_wrong.sum() == len(wrong)


@pytest.mark.long
def test_images_that_other_pairs_alone_tie_come_in(context: Context) -> None:
    workspace, escalation, last = context.workspace, escalation_of(context), NAMES[3]
    shapeless_only(escalation, *(pair for pair in escalation.pairs if last in pair))
    mapper = MAPPERS.make(MAPPERS.options("sparse"))
    _, models = stage.map_images(context, mapper)
    assert models[0].registered_names == tuple(sorted(NAMES))
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    image = model.find_image_with_name(last)
    assert image
    assert image.num_points3D > 50
    assert not models[0].doubtful
