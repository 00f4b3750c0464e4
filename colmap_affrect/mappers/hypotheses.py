"""The names of the hypotheses that made a model, in the words of a report."""

from collections.abc import Sequence
from dataclasses import replace

from colmap_affrect.mappers.base import MappedModel


def made_by(name: str, models: Sequence[MappedModel]) -> list[MappedModel]:
    """Return models with the name of a hypothesis before those that each of them has."""
    found = list[MappedModel]()
    for mapped in models:
        hypotheses = tuple(dict.fromkeys((name, *mapped.hypotheses)))
        found.append(replace(mapped, hypotheses=hypotheses))
    return found


def also_by(name: str, mapped: MappedModel) -> MappedModel:
    """Return a model with the name of a hypothesis after those that it has."""
    hypotheses = tuple(dict.fromkeys((*mapped.hypotheses, name)))
    return replace(mapped, hypotheses=hypotheses)
