"""What a run advises: codes, and how much work of a person each takes."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from colmap_affrect.options import documented

AdviceCode = Literal[
    "focal_length",
    "lines_contradict",
    "principal_point",
    "mapper",
    "features",
    "recipe",
    "weights",
    "effort",
    "tie_points",
    "lens",
    "masks",
    "reject_pair",
    "photographs",
]
"""Kinds of advice: commands that need nothing else, then what is done by hand on the page of a run
or known by a person, then photographs that are still to be taken or found."""

BY_HAND: Collection[AdviceCode] = ("tie_points", "lens", "masks", "reject_pair")
"""Advice whose command needs minutes of a person first."""

Work = Literal["nothing", "minutes", "hours"]
WORKS: Sequence[Work] = ("nothing", "minutes", "hours")
"""What a person has to do beside giving a command, the least first."""


@documented
@dataclass(frozen=True)
class Advice:
    """What may help."""

    code: AdviceCode
    """Kind of the advice."""
    why: str
    """What it would be good for."""
    command: str = ""
    """Command for a shell; empty where none does it."""

    @property
    def work(self) -> Work:
        """What a person has to do beside giving the command."""
        if self.code == "photographs":
            return "hours"
        return "minutes" if self.code in BY_HAND else "nothing"


def least_work_first(advised: Iterable[Advice]) -> tuple[Advice, ...]:
    """Return advice that takes a person less work before other advice, else in its order."""
    return tuple(sorted(advised, key=lambda one: WORKS.index(one.work)))
