"""Levels without measured frames: for pairs, and images, that measured ones do not tie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from small_scene import NAMES
from verified import copy_of, verified

from colmap_affrect.colmap import pycolmap
from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.escalation.expected_gain import Step
from colmap_affrect.escalation.image_set import ImageSet
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.project.match_state import Worth
from colmap_affrect.project.match_store import PairMatches
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions, load_recipe
from colmap_affrect.session.context import Context
from colmap_affrect.stages import map as stage
from colmap_affrect.stages.map import unmeasured_pairs

RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = "shapeless"
[escalate]
strong_num_inliers = 1000000
"""


pytestmark = pytest.mark.usefixtures("shapeless_features_are_known")


@pytest.fixture(scope="module")
def before(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """All pairs are verified by measured frames."""
    folder = tmp_path_factory.mktemp("verified")
    (folder / "recipe.toml").write_text(RECIPE)
    return verified(photos, folder / "out", str(folder / "recipe.toml"))


@pytest.fixture
def context(before: Workspace, tmp_path: Path) -> Context:
    return Context(copy_of(before, tmp_path / "out"))


def escalation_of(context: Context) -> Escalation:
    return Escalation(context, load_recipe("default").escalate)


def without_matches(context: Context, name: str) -> list[tuple[str, str]]:
    """Take the matches of an image, and return its pairs."""
    own = [pair for pair in escalation_of(context).image_set.pairs if name in pair]
    for found in list(context.matches.read(own)):
        none = replace(found, indices=found.indices[:0], scores=found.scores[:0])
        context.matches.write([none], own, 0)
    escalation_of(context).write()
    return own


def test_pairs_of_frames_that_were_not_measured_are_told(context: Context) -> None:
    assert unmeasured_pairs(context) == []
    own = without_matches(context, NAMES[3])
    escalation_of(context).match_at(own, 1)
    assert sorted(unmeasured_pairs(context)) == sorted(own)


def test_images_that_measured_frames_hold_need_no_others(context: Context) -> None:
    """Only one that is not there does, or one without a pair with a likely image."""
    own = without_matches(context, NAMES[3])
    names = tuple(sorted(NAMES))
    escalation = escalation_of(context)
    states = escalation_of(context).image_set.states()
    model = ModelSummary(
        names, 9, 2.0, 0.5, doubtful={NAMES[0]: (Doubt("few_matches"),)}
    )
    assert escalation.image_set._anchored(model, states) == set(NAMES) - {NAMES[3]}
    all_doubtful = replace(
        model, doubtful=dict.fromkeys(names, (Doubt("few_matches"),))
    )
    assert escalation.image_set._anchored(all_doubtful, states) == set()
    without = replace(model, registered_names=names[1:])
    assert names[0] not in escalation.image_set._anchored(without, states)
    assert all(NAMES[3] in pair for pair in own)


def test_pairs_that_nothing_hints_at_escalate_to_features_of_another_kind(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of an image that no measured frames match, and not those of the others."""
    own = without_matches(context, NAMES[3])
    options = EscalateOptions(strong_num_inliers=1)
    escalation = Escalation(context, options)
    step = escalation.next_step()
    assert step
    assert (step.level, step.pairs) == (1, own)

    written = escalation.matches.write

    def killed(
        found: list[PairMatches],
        tried: list[tuple[str, str]],
        level: int,
        worths: dict[tuple[str, str], Worth],
    ) -> None:
        kept = {pair: worth for pair, worth in worths.items() if pair in tried[:2]}
        written(found[:2], tried[:2], level, kept)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ImageSet, "is_mapped", lambda _: True)
        patch.setattr(escalation.matches, "write", killed)
        with pytest.raises(KeyboardInterrupt):
            escalation.match_at(own, 1)
    # The matches that are stored look different now; what is left of the step is not decided anew.
    escalation = Escalation(context, options)
    assert escalation.next_step() == Step(1, own[2:])
    escalation.match_at(own[2:], 1)
    assert escalation.matches.state.rounds == (1,)  # it is one step
    assert min(escalation.image_set.num_inliers()[pair] for pair in own) > 30
    assert escalation.next_step() is None


def test_no_mapping_follows_a_step_that_changes_nothing(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = escalation_of(context)
    monkeypatch.setattr(ImageSet, "is_mapped", lambda _: True)
    escalation.match_at(without_matches(context, NAMES[3]), 1)
    assert escalation.matches.state.has_stepped
    assert not escalation.matches.state.rounds


@pytest.mark.long
def test_images_that_other_pairs_alone_tie_come_in(context: Context) -> None:
    workspace = context.workspace
    escalation = escalation_of(context)
    last = NAMES[3]
    escalation.match_at(without_matches(context, last), 1)
    assert not escalation.matches.state.rounds  # nothing was mapped before
    mapper = MAPPERS.make(MAPPERS.options("sparse"))
    _, models = stage.map_images(context, mapper)
    assert models[0].registered_names == tuple(sorted(NAMES))
    model = pycolmap.Reconstruction(workspace.sparse / "0")
    image = model.find_image_with_name(last)
    assert image
    assert image.num_points3D > 50
    assert not models[0].doubtful
