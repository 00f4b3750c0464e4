"""What several tests of escalation share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from colmap_affrect.features.base import EXTRACTORS


@pytest.fixture(scope="package")
def shapeless_features_are_known() -> Iterator[None]:
    """Recipes may name features without shapes, as learned ones are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXTRACTORS.built_in, "shapeless", "shapeless_features:Shapeless")
        yield
