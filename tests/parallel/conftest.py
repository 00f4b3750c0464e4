"""A cluster for the tests of work elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from local_cluster import local_cluster


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A scheduler and two workers of one thread each, in processes of their own."""
    with local_cluster(tmp_path_factory.mktemp("cluster"), 2) as started:
        yield started
