"""A rectifier of another package: found by its entry point, chosen by a recipe, held to account."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
from contracts.rectifier_contract import photograph_of
from synthetic import texture

from colmap_affrect.errors import OptionError
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.one_image import prepare

MODULE = """
    from typing import Literal

    from colmap_affrect.geometry.affine import fit_canvas, image_corners, rectifying_affine
    from colmap_affrect.rectifiers.base import RectifierOptions
    from colmap_affrect.data import Rectification, RectificationPlan


    class SkewOptions(RectifierOptions):
        name: Literal["skew"] = "skew"
        tilt: float = 2.0


    class Skew:
        Options = SkewOptions

        def __init__(self, options, sources):
            self.options = options

        def plan(self, photograph):
            linear = rectifying_affine(self.options.tilt, 0.5)
            matrix, canvas = fit_canvas(linear, image_corners(photograph.size), 0.0)
            item = Rectification(matrix, canvas, None, self.options.tilt, 0.5)
            return RectificationPlan(photograph.size, (item,))
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package ``skew-affrect`` on the path, as pip leaves it."""
    (tmp_path / "skew_affrect.py").write_text(textwrap.dedent(MODULE))
    info = tmp_path / "skew_affrect-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: skew-affrect\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[colmap_affrect.rectifiers]\nskew = skew_affrect:Skew\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("installed")
def test_rectifier_of_another_package_is_chosen_by_its_name() -> None:
    recipe = load_recipe("default", ["rectifier.name=skew", "rectifier.tilt=3.0"])
    extractor = prepare(recipe.extraction)
    photograph = photograph_of(texture((140, 105), 4))
    plan = extractor.plan(photograph)
    assert [item.tilt for item in plan.items] == [3.0]
    features = extractor.execute(photograph, plan)
    assert (features.rectification_ids == 1).any()


@pytest.mark.usefixtures("installed")
def test_options_of_another_package_are_checked_as_our_own() -> None:
    with pytest.raises(OptionError, match=r"unknown option 'tlit' .did you mean 'tilt'"):
        load_recipe("default", ["rectifier.name=skew", "rectifier.tlit=3.0"])
    with pytest.raises(OptionError, match=r"unknown rectifier 'skev' .did you mean 'skew'"):
        load_recipe("default", ["rectifier.name=skev"])
