"""Every matcher that is registered keeps the contract."""

from __future__ import annotations

import pytest
from contracts.matcher_contract import MatcherContract

from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext


@pytest.mark.parametrize("name", MATCHERS.names(), scope="class")
class TestMatchers(MatcherContract):
    @pytest.fixture(autouse=True)
    def _named(self, name: str) -> None:
        self.name = name

    def make(self) -> Matcher:
        options = MATCHERS.options(self.name)
        assert options.name == self.name
        return MATCHERS.make(options, MatcherContext())
