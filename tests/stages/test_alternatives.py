"""Models of one kind of matches alone, beside those of the best matches of each pair."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal
from results import database_content
from small_scene import NAMES
from verified import copy_of, verified

from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.features.base import EXTRACTORS
from colmap_affrect.mappers.base import MAPPERS, Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stores import CLIMBING, COMPARED, FINISHED
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.stages import alternatives, climb
from colmap_affrect.stages.alternatives import choose_kind, remember_score, score
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import LEARNED_ONLY, Escalation, begin

RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = { name = "shapeless", max_num_features = 900 }
"""
UNSURE = ModelSummary(NAMES[:2], 50, 2.0, 0.5, probabilities=dict.fromkeys(NAMES[:2], 0.6))


@pytest.fixture(scope="module", autouse=True)
def _shapeless() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXTRACTORS.built_in, "shapeless", "shapeless_features:Shapeless")
        yield


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    path = tmp_path_factory.mktemp("recipe") / "recipe.toml"
    path.write_text(RECIPE)
    return load_recipe(str(path))


@pytest.fixture(scope="module")
def matched(photos: Path, recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """All pairs were matched by both kinds; the learned ones have fewer features."""
    workspace = verified(photos, tmp_path_factory.mktemp("matched") / "out", recipe.name)
    escalation, _ = begin(Context(workspace), recipe.escalate)
    escalation.match_at(escalation.pairs, 1)
    return workspace


@pytest.fixture
def context(matched: Workspace, tmp_path: Path) -> Context:
    return Context(copy_of(matched, tmp_path / "out"))


@pytest.fixture
def mapper() -> Mapper:
    return MAPPERS.make(MAPPERS.options("sparse"))


def levels(context: Context) -> set[int]:
    pairs = Escalation(context, context.escalation).pairs
    return set(context.matches.levels(pairs).values())


def with_models(monkeypatch: pytest.MonkeyPatch, *, found: ModelSummary) -> list[dict]:
    """Say what models are there, and what a copy gives; return the choices that are mapped."""
    asked = list[dict]()

    def models_of(_: Context, __: Mapper, choice: dict) -> list[ModelSummary]:
        asked.append(choice)
        return [found]

    monkeypatch.setattr(alternatives, "_models_of", models_of)
    monkeypatch.setattr(alternatives, "read_summaries", lambda _: [UNSURE])
    monkeypatch.setattr(Escalation, "models", lambda _: [UNSURE])
    monkeypatch.setattr(Escalation, "needs", lambda *_: {NAMES[0]: 1.0})
    return asked


def test_matches_of_the_other_kind_are_kept_beside_better_ones(context: Context) -> None:
    pairs = Escalation(context, context.escalation).pairs
    others = context.matches.alternatives(list(pairs))
    assert levels(context) == {0}
    assert set(others) == set(pairs)
    states = Escalation(context, context.escalation).states()
    for pair, other in others.items():
        assert other.matches.level == 1
        assert other.matches.names == pair
        assert 0 < other.worth[0] < states[pair].num_inliers


def test_kind_with_a_greater_score_is_chosen_and_is_what_the_database_holds(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = Escalation(context, context.escalation)
    better = replace(UNSURE, probabilities=dict.fromkeys(NAMES[:2], 0.9))
    asked = with_models(monkeypatch, found=better)
    others = context.matches.alternatives(list(escalation.pairs))
    context.matches.keep_note(CLIMBING, context.matches.note(FINISHED))
    assert choose_kind(escalation, mapper)
    assert len(asked) == 1
    assert context.matches.note(COMPARED) == [len(others), LEARNED_ONLY]
    assert context.matches.note(CLIMBING) is None  # models that are there are not gone on from
    assert levels(context) == {1}
    ids = image_ids(context.workspace.database)
    with open_database(context.workspace.database) as database:
        for pair, other in others.items():
            stored = database.read_matches(*(ids[name] for name in pair))
            assert_array_equal(stored, other.matches.indices)
    swapped = context.matches.alternatives(list(escalation.pairs))
    assert {other.matches.level for other in swapped.values()} == {0}
    assert not choose_kind(escalation, mapper)  # that is decided
    assert len(asked) == 1


def test_kind_with_no_greater_score_changes_nothing_and_is_asked_once(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = Escalation(context, context.escalation)
    asked = with_models(monkeypatch, found=UNSURE)
    before = database_content(context.workspace.database)
    assert not choose_kind(escalation, mapper)
    assert not choose_kind(escalation, mapper)
    assert len(asked) == 1
    assert levels(context) == {0}
    assert database_content(context.workspace.database) == before


def test_measured_matches_alone_are_looked_at_where_models_were_better_before(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    escalation = Escalation(context, context.escalation)
    others = context.matches.alternatives(list(escalation.pairs))
    mixed = list(others)[:2]
    there = {pair: escalation.states()[pair].worth for pair in mixed}
    current = {found.names: found for found in context.matches.read(mixed)}
    choice = {
        pair: (others[pair].matches, alternatives.Alternative(current[pair], there[pair]))
        for pair in mixed
    }
    context.matches.choose(choice)
    escalation.write()
    asked = with_models(monkeypatch, found=UNSURE)
    remember_score(context)
    context.matches.keep_note(alternatives.SCORE_BEFORE, score([UNSURE]) + 0.5)
    assert not choose_kind(escalation, mapper)
    learned, measured = asked
    assert set(learned) == set(others) - set(mixed)
    assert set(measured) == set(mixed)
    assert {matches.level for matches, _ in measured.values()} == {0}


def test_set_of_which_the_model_is_sure_is_not_looked_at(
    context: Context, mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = with_models(monkeypatch, found=UNSURE)
    monkeypatch.setattr(Escalation, "needs", lambda *_: {})
    assert not choose_kind(Escalation(context, context.escalation), mapper)
    assert not asked


def test_score_counts_relative_poses_that_are_expected_to_be_right() -> None:
    pair = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9})
    three = replace(UNSURE, probabilities={"a": 0.9, "b": 0.9, "c": 0.9})
    assert score([]) == 0.0
    assert score([pair]) == pytest.approx(0.8)
    assert score([three]) == pytest.approx(1.7)
    assert score([pair, pair]) < score([three])
    assert score([replace(UNSURE, probabilities={"a": 0.2, "b": 0.2})]) == 0.0


@pytest.mark.long
def test_run_killed_after_the_choice_maps_the_chosen_matches(
    matched: Workspace, recipe: Recipe, mapper: Mapper, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Not from the models of before: they are of other matches."""
    spaces = [copy_of(matched, tmp_path / name) for name in ("whole", "killed")]
    surest = replace(UNSURE, probabilities=dict.fromkeys("abcdefgh", 1.0))
    monkeypatch.setattr(alternatives, "_models_of", lambda *_: [surest])
    monkeypatch.setattr(Escalation, "needs", lambda *_: {NAMES[0]: 1.0})
    monkeypatch.setattr(Escalation, "next_step", lambda _: None)
    whole, killed = (Context(space) for space in spaces)
    climb.climb(whole, mapper, recipe)
    with monkeypatch.context() as patch:
        patch.setattr(Escalation, "write", interrupted_at_second_call())
        with pytest.raises(KeyboardInterrupt):
            climb.climb(killed, mapper, recipe)
    assert killed.matches.note(COMPARED)[1] == LEARNED_ONLY
    climb.climb(killed, mapper, recipe)
    for context in (whole, killed):
        assert levels(context) == {1}
    contents = [database_content(space.database) for space in spaces]
    assert contents[0] == contents[1]
    models = [read_summaries(space.sparse) for space in spaces]
    assert models[0] == models[1]


def interrupted_at_second_call() -> Callable[[Escalation], None]:
    written = Escalation.write
    calls = list[int]()

    def write(escalation: Escalation) -> None:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        written(escalation)

    return write
