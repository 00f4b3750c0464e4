"""Guided matching as a stage: who is guided, what stays on record, again and killed."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from results import database_content
from small_scene import NAMES
from verified import copy_of, verified

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import StoreError
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context
from colmap_affrect.stages import guide as stage
from colmap_affrect.stages import stationary
from colmap_affrect.stages.guide import current, exact_inliers, guide, guided_counts
from colmap_affrect.stages.stationary import NUM_CELLS
from colmap_affrect.stages.verify import verify_matches

ALWAYS = GuidedOptions(enabled="always")


@pytest.fixture(scope="module")
def before(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return verified(photos, tmp_path_factory.mktemp("before"))


@pytest.fixture(scope="module")
def after(before: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The same with all pairs guided."""
    workspace = copy_of(before, tmp_path_factory.mktemp("after") / "out")
    guide(Context(workspace), ALWAYS)
    return workspace


@pytest.fixture
def context(before: Workspace, tmp_path: Path) -> Context:
    return Context(copy_of(before, tmp_path / "out"))


@pytest.fixture
def guided(after: Workspace, tmp_path: Path) -> Context:
    return Context(copy_of(after, tmp_path / "guided"))


def test_pairs_gain_and_what_was_there_stays_on_record(
    before: Workspace, context: Context
) -> None:
    exact = Context(before).verified_inliers()
    assert guide(context, ALWAYS).num_done == len(exact) == 6
    found = context.verified_inliers()
    counts = guided_counts(context)
    assert counts["pairs"] > 1
    assert counts["matches_after"] > 1.05 * counts["matches_before"]
    for pair, indices in exact.items():
        assert len(found[pair]) >= len(indices)
        assert_array_equal(exact_inliers(context, current(context))[pair], indices)
        for side in (0, 1):
            assert len(np.unique(found[pair][:, side])) == len(found[pair])
    raw = [raw_matches(item.database) for item in (before, context.workspace)]
    assert raw[0] == raw[1]
    assert rows_digest(before.database) != rows_digest(context.workspace.database)


def raw_matches(path: Path) -> list[tuple[int, bytes]]:
    with open_database(path) as database:
        pair_ids, matches = database.read_all_matches()
    return [
        (pair, found.tobytes()) for pair, found in zip(pair_ids, matches, strict=True)
    ]


def test_guided_matches_are_right(guided: Context) -> None:
    """A geometry of the first inliers explains nearly all that came later."""
    exact = exact_inliers(guided, current(guided))
    frames = {name: guided.features.read(name).keypoints for name in NAMES}
    for pair, indices in guided.verified_inliers().items():
        known = {*map(tuple, exact[pair])}
        new = np.array([row for row in indices.tolist() if tuple(row) not in known])
        if not len(new):
            continue
        points = [np.concatenate([frames[n][i] for i in (exact[pair][:, s], new[:, s])])
                  for s, n in enumerate(pair)]  # fmt: skip
        found = pycolmap.estimate_fundamental_matrix(*points, {"max_error": 3.0})
        assert found is not None
        assert found["inlier_mask"][len(exact[pair]) :].mean() > 0.9


def test_sets_that_hang_together_are_left_alone(
    before: Workspace, context: Context
) -> None:
    digest = rows_digest(before.database)
    assert guide(context).num_done == 0
    assert not context.workspace.guided.exists()
    assert rows_digest(context.workspace.database) == digest


def test_only_images_in_need(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    every = set(context.verified_inliers())
    in_need = {NAMES[1]}
    monkeypatch.setattr(stage, "weakly_connected_images", lambda *_: in_need)
    assert guide(context).num_done == 3
    assert {pair.names for pair in context.guided.read()} == {
        p for p in every if NAMES[1] in p
    }
    in_need.add(NAMES[0])
    context.workspace.record_input_digests(guided="")  # nothing is known to be finished
    report = guide(context)
    assert (report.num_done, report.num_kept) == (2, 3)


def test_what_was_looked_at_is_looked_at_again_only_where_it_has_changed(
    guided: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = Mock(return_value=list[Pair]())
    monkeypatch.setattr(stage.Guiding, "todo", looked)
    assert guide(guided, ALWAYS).num_kept == 6
    assert not looked.called
    first = min(guided.verified_inliers())
    ids = guided.graph.ids
    with guided.graph.open_to_change(for_pairs=True) as database:
        database.delete_two_view_geometry(ids[first[0]], ids[first[1]])
    guide(guided, ALWAYS)
    assert looked.call_count == 1
    guide(guided, ALWAYS)
    assert looked.call_count == 1
    guided.workspace.guided.unlink()
    guide(guided, ALWAYS)
    assert looked.call_count == 2


def test_a_run_that_is_killed_has_not_looked_at_all_pairs(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where an earlier one had, and others were verified since."""
    guide(context, ALWAYS)
    verify_matches(context, overwrite=True)
    monkeypatch.setattr(stage.Guiding, "guide", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        guide(context, ALWAYS)
    monkeypatch.undo()
    assert guide(context, ALWAYS).num_done == 6


def test_captions_are_not_found_again(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here they are said to be everywhere, and matches from one to another are none of a scene."""
    monkeypatch.setattr(stationary, "MAX_SHARE_BESIDE", 1.0)
    everywhere = np.indices((NUM_CELLS, NUM_CELLS)).reshape(2, -1).T
    sizes = set(context.features.image_sizes().values())
    cells = tuple(map(tuple, everywhere.tolist()))
    context.matches.update_state(stationary=tuple((size, cells) for size in sizes))
    assert guide(context, ALWAYS).num_done == 6
    assert guided_counts(context) == {}


def test_never(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "weakly_connected_images", lambda *_: set(NAMES))
    assert guide(context, GuidedOptions(enabled="never")).num_done == 0


def test_again_nothing_happens_and_other_options_are_refused(guided: Context) -> None:
    content = database_content(guided.workspace.database)
    report = guide(guided)
    assert (report.num_done, report.num_kept) == (0, 6)
    with pytest.raises(StoreError, match="enabled='always', and it is 'auto' now"):
        guide(guided, GuidedOptions())
    assert database_content(guided.workspace.database) == content


def test_killed_before_the_geometries_are_written_it_goes_on(
    context: Context, guided: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "PAIRS_PER_WRITE", 4)
    monkeypatch.setattr(stage.Guiding, "_write", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        guide(context, ALWAYS)
    monkeypatch.undo()
    assert guided_counts(context) == {}
    guide(context, ALWAYS)
    same_inliers(guided, context)


def same_inliers(first: Context, second: Context) -> None:
    one = first.verified_inliers()
    other = second.verified_inliers()
    assert one.keys() == other.keys()
    for pair, indices in one.items():
        assert_array_equal(indices, other[pair])


def test_verification_over_again_forgets_inliers_by_guiding(
    before: Workspace, context: Context
) -> None:
    guide(context, ALWAYS)
    verify_matches(context, overwrite=True)
    assert guided_counts(context) == {}
    same_inliers(Context(before), context)


def test_ids_of_a_pair_are_in_order(context: Context) -> None:
    ids = image_ids(context.workspace.database)
    assert all(ids[first] < ids[second] for first, second in context.verified_inliers())
    guide(context, ALWAYS)
    with open_database(context.workspace.database) as database:
        assert len(database.read_two_view_geometries()[0]) == 6


@pytest.mark.parametrize(("num_kept", "is_taken"), [(17, True), (12, False)])
def test_geometry_that_loses_many_exact_inliers_is_not_taken_for_its_number_of_others(
    num_kept: int, is_taken: bool
) -> None:
    exact = np.stack([np.arange(20)] * 2, axis=1)
    model = Mock()
    task = stage.GuidedTask((NAMES[0], NAMES[1]), model, exact, is_calibrated=False)
    others = np.stack([np.arange(100, 140)] * 2, axis=1)
    geometry = pycolmap.TwoViewGeometry()
    geometry.inlier_matches = np.concatenate([exact[:num_kept], others])
    assert stage.is_better(geometry, task) == is_taken
