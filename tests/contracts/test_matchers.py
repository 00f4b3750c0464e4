"""Every matcher that is registered keeps the contract; networks only compare descriptors."""

from __future__ import annotations

from pathlib import Path

import pytest
from contracts.matcher_contract import MatcherContract
from random_weights import write_comparing_lightglue

from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext

CHOICES = {"lightglue": {"name": "lightglue", "trained_for": "sift"}}
"""The contract's features are those of RootSIFT."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    path = tmp_path_factory.mktemp("weights") / "lightglue.pth"
    return {"lightglue-sift": write_comparing_lightglue(path)}


@pytest.mark.parametrize("name", MATCHERS.names(), scope="class")
class TestMatchers(MatcherContract):
    @pytest.fixture(autouse=True)
    def _named(self, name: str, weights: dict[str, Path]) -> None:
        self.name, self.weights = name, weights

    def make(self) -> Matcher:
        options = MATCHERS.options(CHOICES.get(self.name, self.name))
        assert options.name == self.name
        return MATCHERS.make(options, MatcherContext(self.weights))
