from __future__ import annotations

from pathlib import Path

import pytest
from large_comparison import make_large_comparison

from colmap_affrect.report.page import write_page


@pytest.fixture(scope="session")
def large_page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a comparison on 200 photographs."""
    folder = tmp_path_factory.mktemp("large")
    return write_page(make_large_comparison(folder), folder)
