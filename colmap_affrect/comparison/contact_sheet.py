"""The photographs on the page: which method registers which of them, and how surely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from colmap_affrect.comparison.method_table import Column
from colmap_affrect.comparison.results import Comparison
from colmap_affrect.report.view_graph import Node

FILTERS = {
    "all": "All",
    "differ": "Methods differ",
    "seeds": "Seeds disagree",
    "wrong": "Registered wrongly",
    "doubtful": "Doubtful",
    "none": "Registered by none",
}


KINDS = {
    "shared": "registered by other methods, too",
    "only": "registered by this method only",
    "doubtful": "contradicts other seeds or methods",
    "wrong": "at a wrong place",
}
"""How cameras are drawn; each has a colour of this name."""


@dataclass(frozen=True)
class Mark(Node):
    """What one method does with one photograph.

    Attributes:
        is_doubtful: registered in poses that contradict those of other seeds or methods.
        is_only: usually registered by no other method.
    """

    column: Column
    is_doubtful: bool
    is_only: bool

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        if self.is_wrong:
            return "wrong"
        return "doubtful" if self.is_doubtful else "only" if self.is_only else "shared"


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet.

    Attributes:
        number: from 1, the same everywhere on the page.
    """

    number: int
    name: str
    marks: tuple[Mark, ...]
    groups: tuple[str, ...]


def cards_of(columns: Sequence[Column], comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    with_truth = {
        name
        for column in columns
        for seed in column.method.seeds
        if seed.scores is not None
        for pair in seed.scores.pair_errors_deg
        for name in pair
    }
    usually_registered = [column.method.usually_registered for column in columns]
    only = comparison.only_registered_by
    registered_by_none = set(comparison.registered_by_none)
    cards = []
    for number, name in enumerate(comparison.image_names, 1):
        marks = tuple(
            _mark(
                column,
                number,
                name,
                has_ground_truth=name in with_truth,
                is_only=only.get(name) == column.name and len(columns) > 1,
            )
            for column in columns
        )
        tests = {
            "all": True,
            "differ": len({name in names for names in usually_registered}) > 1,
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": any(mark.is_wrong for mark in marks),
            "doubtful": any(mark.is_doubtful for mark in marks),
            "none": name in registered_by_none,
        }
        groups = tuple(group for group, passes in tests.items() if passes)
        cards.append(Card(number, name, marks, groups))
    return cards


def _mark(column: Column, number: int, name: str, *, has_ground_truth: bool, is_only: bool) -> Mark:
    method, seeds = column.method, column.method.seeds
    registering = [seed for seed in seeds if name in seed.registered_names]
    correct = [s for s in registering if s.scores is not None and name in s.scores.correct_names]
    if not registering:
        state, text = "never", "not registered"
    elif len(registering) == len(seeds):
        state, text = "always", "registered"
    else:
        state, text = "sometimes", f"registered with {len(registering)} of {len(seeds)} seeds"
    is_wrong = has_ground_truth and len(correct) < len(registering)
    if is_wrong:
        text += f", correctly with {len(correct)}" if correct else ", wrongly"
    elif correct:
        text += ", correctly"
    is_unstable = name in method.unstable_names
    others = [other for other, names in method.disagreements.items() if name in names]
    if is_unstable:
        text += ", in poses that contradict each other from seed to seed"
    if others:
        text += f", in a pose that contradicts that of {' and '.join(others)}"
    return Mark(
        number,
        name,
        state,
        is_wrong,
        f"{column.name}: {text}",
        column=column,
        is_doubtful=is_unstable or bool(others),
        is_only=is_only,
    )
