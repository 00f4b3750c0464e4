"""The protocols by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from colmap_affrect.errors import OptionError
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.imc import Imc
from colmap_affrect.evaluation.pairs import Pairs
from colmap_affrect.evaluation.protocol import EvaluationProtocol
from colmap_affrect.evaluation.svp import Svp
from colmap_affrect.options import suggestion

PROTOCOLS: Mapping[str, Callable[..., EvaluationProtocol]] = {
    "evd": Evd,
    "svp": Svp,
    "imc": Imc,
    "pairs": Pairs,
}


def make_protocol(name: str, settings: Sequence[str] = ()) -> EvaluationProtocol:
    """Return a protocol, some of its fields changed by ``KEY=VALUE``.

    Raises OptionError for an unknown protocol or setting, or a value of the wrong type.
    """
    if name not in PROTOCOLS:
        raise OptionError(f"unknown protocol '{name}': known are {', '.join(PROTOCOLS)}")
    protocol: Any = PROTOCOLS[name]()
    known = {field.name: getattr(protocol, field.name) for field in dataclasses.fields(protocol)}
    changes = {}
    for setting in settings:
        key, separator, text = (part.strip() for part in setting.partition("="))
        if not separator:
            raise OptionError(f"{setting}: expected KEY=VALUE")
        if key not in known:
            raise OptionError(f"{name} has no setting '{key}'{suggestion(key, known)}")
        changes[key] = _value(text, known[key], f"{name}: {setting}")
    changed: EvaluationProtocol = dataclasses.replace(protocol, **changes)
    return changed


def _value(text: str, default: Any, where: str) -> Any:
    if isinstance(default, bool):
        if text not in ("true", "false"):
            raise OptionError(f"{where}: expected true or false")
        return text == "true"
    try:
        value = type(default)(text)
    except ValueError as error:
        raise OptionError(f"{where}: expected {type(default).__name__}") from error
    if not 0 < value < float("inf"):
        raise OptionError(f"{where}: must be positive")
    return value
