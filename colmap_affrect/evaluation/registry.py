"""The protocols by name."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence

from colmap_affrect.errors import OptionError
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.imc import Imc
from colmap_affrect.evaluation.pairs import Pairs
from colmap_affrect.evaluation.protocol import EvaluationProtocol
from colmap_affrect.evaluation.svp import Svp

PROTOCOLS: Mapping[str, type[EvaluationProtocol]] = {
    protocol.name: protocol for protocol in (Evd, Svp, Imc, Pairs)
}


def make_protocol(name: str, settings: Sequence[str] = ()) -> EvaluationProtocol:
    """Return a protocol, some of its options changed by ``KEY=VALUE``.

    Raises OptionError for an unknown protocol or option, or a value that it cannot have.
    """
    if name not in PROTOCOLS:
        raise OptionError(f"unknown protocol '{name}': known are {', '.join(PROTOCOLS)}")
    values = {}
    for setting in settings:
        key, separator, text = (part.strip() for part in setting.partition("="))
        if not separator:
            raise OptionError(f"{setting}: expected KEY=VALUE")
        try:
            values[key] = tomllib.loads(f"value = {text}")["value"]
        except ValueError:
            values[key] = text
    return PROTOCOLS[name].from_mapping(values, name)
