"""The protocols by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.imc import Imc
from colmap_affrect.evaluation.pairs import Pairs
from colmap_affrect.evaluation.protocol import EvaluationProtocol
from colmap_affrect.evaluation.svp import Svp

PROTOCOLS: Mapping[str, Callable[[], EvaluationProtocol]] = {
    "evd": Evd,
    "svp": Svp,
    "imc": Imc,
    "pairs": Pairs,
}
