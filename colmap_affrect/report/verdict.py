"""How good a run is, said first: a headline, a sentence what to do next, the models."""

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from colmap_affrect.project.report import ReconstructionReport
from colmap_affrect.report.photographs import PhotographReport, Quality

QUALITIES: Mapping[Quality, str] = {
    "sure": "sure",
    "unsure": "unsure",
    "doubtful": "doubtful",
    "missing": "not placed",
}
"""What the classes of photographs are called; each has a colour of its key."""
SIGNS: Mapping[Quality, str] = {
    "sure": "✓", "unsure": "~", "doubtful": "?", "missing": "-",
}  # fmt: skip
"""What stands for a class beside its colour."""


TOOLS = {"--tie-points": "tie-points", "--mask-path": "masks"}
"""Sections of the page in which one makes what an option takes."""


@dataclass(frozen=True)
class Component:
    """A model, or the photographs that are in none."""

    title: str
    photographs: tuple[int, ...]  # their numbers, from 0
    # Of its photographs by class, without classes of none
    counts: Mapping[Quality, int]
    view: int | None  # number of the model


@dataclass(frozen=True)
class Verdict:
    """What the page of a run begins with."""

    headline: str
    next_step: str
    command: str  # that does it; empty where none does
    counts: Mapping[Quality, int]
    components: tuple[Component, ...]


def verdict_of(
    report: ReconstructionReport,
    names: Sequence[str],
    photographs: Mapping[str, PhotographReport],
) -> Verdict:
    """Return what the page of a run begins with.

    Args:
        report: of the run.
        names: of all photographs, in the order of their numbers.
        photographs: what is known of each of them.

    Returns:
        The verdict.
    """
    counts = _counts([photographs[name] for name in names])
    next_step, command = _next_step(report, counts)
    return Verdict(
        headline=_headline(len(names), counts, len(report.models)),
        next_step=next_step,
        command=command,
        counts=counts,
        components=_components(names, photographs),
    )


def tool_of(command: str) -> str:
    """Return the section of the page whose tool makes what a command takes; empty: none does."""
    words = shlex.split(command)
    sections = [section for option, section in TOOLS.items() if option in words]
    return sections[0] if sections else ""


def _counts(photographs: Sequence[PhotographReport]) -> dict[Quality, int]:
    """Return the number of photographs of each class that there is, the surest first."""
    found = Counter(photograph.quality for photograph in photographs)
    return {quality: found[quality] for quality in QUALITIES if found[quality]}


def _headline(num: int, counts: Mapping[Quality, int], num_models: int) -> str:
    """Say how many of ``num`` photographs can be trusted, and what the others are."""
    num_placed = num - counts.get("missing", 0)
    if not num_placed:
        return f"None of {num} photographs could be placed"
    num_sure = counts.get("sure", 0)
    models = f", in {num_models} models" if num_models > 1 else ""
    if num_sure == num:
        return f"All {num} photographs are placed surely{models}"
    others = []
    for quality, count in counts.items():
        if quality != "sure":
            others.append(f"{count} {QUALITIES[quality]}")
    text = f"{num_sure} of {num} photographs are placed surely, {', '.join(others)}"
    if not num_sure:
        text = f"None of {num} photographs is placed surely, {', '.join(others)}"
    return f"{text}; {num_models} models" if num_models > 1 else text


def _next_step(
    report: ReconstructionReport, counts: Mapping[Quality, int]
) -> tuple[str, str]:
    """Return a sentence what to do next, and the command that does it.

    Before hours are spent on doubtful or unsure photographs they are worth a look.
    """
    first = report.advice[0] if report.advice else None
    if first and (first.work != "hours" or "missing" in counts):
        return f"Next: {first.why}.", first.command
    if not report.models:
        return "Next: more photographs, from places between those of these.", ""
    if counts.keys() == {"sure"}:
        return "Nothing is left to do: the model in sparse/0 can be used.", ""
    if "doubtful" in counts:
        return "Next: look at the doubtful photographs and their pairs below.", ""
    if "missing" in counts:
        return (
            "Next: see below why photographs are not placed, or mark tie points in them.",
            "",
        )
    return (
        "The model in sparse/0 can be used; look at the unsure photographs before you "
        "measure in it.",
        "",
    )


def _components(
    names: Sequence[str], photographs: Mapping[str, PhotographReport]
) -> tuple[Component, ...]:
    """Return the models with their photographs, the largest first, and those that are in none."""
    groups = dict[int | None, list[int]]()
    for number, name in enumerate(names):
        groups.setdefault(photographs[name].model, []).append(number)
    found = []
    for model in sorted(key for key in groups if key is not None):
        numbers = groups[model]
        some = [photographs[names[number]] for number in numbers]
        photographs_text = "photograph" if len(numbers) == 1 else "photographs"
        title = f"Model in sparse/{model}: {len(numbers)} {photographs_text}"
        found.append(Component(title, tuple(numbers), _counts(some), model))
    lost = groups.get(None, [])
    if lost:
        title = f"Not placed: {len(lost)}"
        found.append(Component(title, tuple(lost), {"missing": len(lost)}, None))
    return tuple(found)
