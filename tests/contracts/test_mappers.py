"""Every mapper that is registered keeps the contract."""

from __future__ import annotations

import pytest
from contracts.mapper_contract import MapperContract

from colmap_affrect.mappers.base import MAPPERS, MapperOptions


@pytest.mark.parametrize("name", MAPPERS.names())
class TestMappers(MapperContract):
    @pytest.fixture(autouse=True)
    def _named(self, name: str) -> None:
        self.name = name

    def options(self) -> MapperOptions:
        return MAPPERS.options(self.name)
