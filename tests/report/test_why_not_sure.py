"""Why photographs are not sure, as the page of a run groups it."""

from __future__ import annotations

from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.report.why_not_sure import Group, groups_of

NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg")


def turned(degrees: float) -> Doubt:
    """Return a doubt that has a number of its own for each photograph."""
    return Doubt("principal_point_open", {"turn_deg": degrees})


def test_a_reason_is_told_once_with_the_range_of_its_numbers() -> None:
    few = Doubt("few_matches")
    first = ModelSummary(
        NAMES[:3],
        9,
        3.0,
        0.5,
        unsure={"a.jpg": (turned(6.2),)},
        doubtful={"b.jpg": (few, turned(29.8)), "c.jpg": (turned(11.0),)},
    )
    second = ModelSummary(NAMES[3:], 9, 3.0, 0.5, doubtful={"e.jpg": (few,)})
    axes, matches = groups_of(NAMES, (first, second), {})
    assert axes.photographs == (0, 1, 2)
    assert axes.text.endswith("its rotation may be off by 6 to 30 degrees")
    assert matches == Group("few matches support its position", (1, 4))


def test_equal_numbers_are_told_as_one_and_other_words_apart() -> None:
    one = Doubt("hangs_on", {"other": "c.jpg", "percent": 40})
    same = Doubt("hangs_on", {"other": "c.jpg", "percent": 40})
    other = Doubt("hangs_on", {"other": "d.jpg", "percent": 40})
    doubtful = {"a.jpg": (one,), "b.jpg": (same,), "e.jpg": (other,)}
    model = ModelSummary(NAMES, 9, 3.0, 0.5, doubtful=doubtful)
    found = groups_of(NAMES, (model,), {})
    assert [group.photographs for group in found] == [(0, 1), (4,)]
    assert found[0].text == (
        "it hangs on c.jpg, which is right with a probability of 40% itself"
    )


def test_lost_photographs_are_with_what_took_them_out_or_what_became_of_them() -> None:
    """Those that are in another model are not lost."""
    model = ModelSummary(("a.jpg",), 9, 3.0, 0.5, doubtful={"a.jpg": (turned(8.0),)})
    missing = {
        "b.jpg": Missing("taken_out", doubts=(turned(20.0),)),
        "c.jpg": Missing("no_features"),
        "d.jpg": Missing("no_features"),
        "e.jpg": Missing("another_model", model=1),
    }
    found = groups_of(NAMES, (model,), missing)
    assert [group.photographs for group in found] == [(0, 1), (2, 3)]
    assert found[1].text == "no features"


def test_photographs_that_match_and_are_lost_are_told_with_their_best_matches() -> None:
    model = ModelSummary(("a.jpg",), 9, 3.0, 0.5)
    missing = {
        "b.jpg": Missing("not_registered", partners={"a.jpg": 281, "c.jpg": 30}),
        "c.jpg": Missing("not_registered", partners={"b.jpg": 30}),
    }
    (group,) = groups_of(NAMES, (model,), missing)
    assert group.photographs == (1, 2)
    assert "the best with 30 to 281 inliers" in group.text
    alone = {"b.jpg": Missing("not_registered")}
    assert groups_of(NAMES, (model,), alone) == [Group("not registered", (1,))]
