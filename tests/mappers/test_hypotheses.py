"""Each model names the hypotheses that made it, and no others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.hypotheses import ALL_PAIRS, MEASURED_PAIRS
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.search import Search


def test_a_model_that_grew_anew_does_not_name_the_hypothesis_it_was_not_made_by(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=3, num_points3D=100)
    names = sorted(image.name for image in truth.images.values())
    scores = count()

    def known(*_: Any) -> list[MappedModel]:
        return [MappedModel(pycolmap.Reconstruction(truth))]

    def extended(
        _: Search, __: PairGraph, before: Sequence[MappedModel]
    ) -> list[MappedModel]:
        return [MappedModel(pycolmap.Reconstruction(truth)), *before]

    monkeypatch.setattr(Search, "best", known)
    monkeypatch.setattr(Search, "extend_models", extended)
    monkeypatch.setattr(Search, "is_certain", lambda *_, **__: False)
    monkeypatch.setattr(Search, "best_score", lambda *_: float(next(scores)))
    monkeypatch.setattr(PairGraph, "unexplained_by", lambda *_: ["a pair"])
    unmeasured = frozenset({(names[0], names[1])})
    task = replace(task_with_given_cameras(path), unmeasured_pairs=unmeasured)
    grown, extended_one = mapper_of("sparse").map(task, tmp_path, 0, lambda _: None)
    assert grown.hypotheses == (ALL_PAIRS,)
    assert extended_one.hypotheses == (MEASURED_PAIRS, ALL_PAIRS)
