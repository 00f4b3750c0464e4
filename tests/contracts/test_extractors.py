"""Every feature extractor that is registered keeps the contract; networks have random weights."""

from __future__ import annotations

from pathlib import Path

import pytest
from contracts.extractor_contract import ExtractorContract
from random_weights import write_random_weights

from colmap_affrect.features.base import EXTRACTORS, FeatureExtractor, NetworkContext

NETWORKS = {
    f"affnet-hardnet {detector}": {
        "name": "affnet-hardnet",
        "detector": detector,
        "descriptor": "tfeat",
        "max_num_features": 60,
    }
    for detector in ("dog", "keynet", "hessian")
}
CASES = {
    **{name: {"name": name} for name in EXTRACTORS.names() if name != "affnet-hardnet"},
    **NETWORKS,
    "xfeat": {"name": "xfeat", "score_threshold": 0.0},  # random scores are far below the default
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


LONG = ["affnet-hardnet keynet", "affnet-hardnet hessian", "aliked", "disk"]
"""Detectors of kornia, which take seconds; the quickest of the learned features stays."""


@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in CASES]
)
class TestExtractors(ExtractorContract):
    @pytest.fixture(autouse=True)
    def _case(self, case: str, weights: dict[str, Path]) -> None:
        self.options, self.network = EXTRACTORS.options(CASES[case]), NetworkContext(weights)

    def make(self) -> FeatureExtractor:
        return EXTRACTORS.make(self.options, self.network)
