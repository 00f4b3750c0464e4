"""Why photographs are not sure or not placed: each reason once, with its photographs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from colmap_affrect.project.reasons import SENTENCES, Doubt, Missing
from colmap_affrect.project.report import ModelSummary

Value = int | float | str
NO_PLACE = (
    "not registered: it matches others, the best with {num_inliers} inliers, but no position "
    "that these agree on was found"
)


@dataclass(frozen=True)
class Group:
    """A reason, and the photographs that it is true of."""

    text: str
    photographs: tuple[int, ...]  # their numbers, from 0


@dataclass(frozen=True)
class _Range:
    """Values of one kind, which are told as the least and the greatest."""

    values: Sequence[float]

    def __format__(self, form: str) -> str:
        """Return one number where the ends read alike, else both."""
        least = format(min(self.values), form)
        most = format(max(self.values), form)
        return least if least == most else f"{least} to {most}"


def groups_of(
    names: Sequence[str],
    models: Sequence[ModelSummary],
    unregistered: Mapping[str, Missing],
) -> list[Group]:
    """Return why photographs are not sure or not placed.

    Numbers that differ between photographs are told as a range: a reason for each degree by which a
    rotation may be off would be as long as the list of the photographs.

    Args:
        names: of all photographs, in the order of their numbers.
        models: the largest first.
        unregistered: why photographs are not in the largest model.

    Returns:
        Reasons, those of most photographs first.
    """
    doubts = _doubts_by_name(models, unregistered)
    by_kind = dict[tuple[Value, ...], list[tuple[int, Doubt]]]()
    for number, name in enumerate(names):
        for doubt in doubts.get(name, ()):
            by_kind.setdefault(_kind(doubt), []).append((number, doubt))
    found = []
    for members in by_kind.values():
        text = _text([doubt for _, doubt in members])
        found.append(Group(text, tuple(number for number, _ in members)))
    lost = {name: why for name, why in unregistered.items() if name not in doubts}
    found += _groups_of_lost(names, lost)
    found.sort(key=lambda group: -len(group.photographs))
    return found


def _groups_of_lost(
    names: Sequence[str], unregistered: Mapping[str, Missing]
) -> list[Group]:
    """Return what became of photographs that are in no model."""
    fates = dict[str, list[tuple[int, Missing]]]()
    for number, name in enumerate(names):
        missing = unregistered.get(name)
        if missing and not missing.model:
            fates.setdefault(missing.fate(), []).append((number, missing))
    found = []
    for lost in fates.values():
        text = _fate_text([missing for _, missing in lost])
        found.append(Group(text, tuple(number for number, _ in lost)))
    return found


def _doubts_by_name(
    models: Sequence[ModelSummary], unregistered: Mapping[str, Missing]
) -> dict[str, Sequence[Doubt]]:
    """Return why photographs are doubted; those of models that are kept come first."""
    found = dict[str, Sequence[Doubt]]()
    for name, missing in unregistered.items():
        if missing.doubts:
            found[name] = missing.doubts
    for model in models:
        found |= {**model.unsure, **model.doubtful}
    return found


def _kind(doubt: Doubt) -> tuple[Value, ...]:
    """Return what doubts share that are told together: the code, and all words."""
    words = [value for value in doubt.values.values() if isinstance(value, str)]
    return (doubt.code, *words)


def _fate_text(missing: Sequence[Missing]) -> str:
    """Return what became of photographs, and why, where their matches say it."""
    first = missing[0]
    best = [max(one.partners.values(), default=0) for one in missing]
    if first.code != "not_registered" or not all(best):
        return first.fate()
    return NO_PLACE.format(num_inliers=_Range(best))


def _text(doubts: Sequence[Doubt]) -> str:
    """Return a reason with the ranges of its numbers."""
    values = dict[str, Value | _Range](doubts[0].values)
    for key, value in doubts[0].values.items():
        if isinstance(value, str):
            continue
        numbers = []
        for doubt in doubts:
            number = doubt.values[key]
            if not isinstance(number, str):
                numbers.append(number)
        values[key] = _Range(numbers)
    return SENTENCES[doubts[0].code].format(**values)
