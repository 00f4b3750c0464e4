"""Recipes: those in the repository, single options on top, and mistakes in them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
import tomli_w

from colmap_affrect.errors import OptionError
from colmap_affrect.features.second_moment import SecondMomentOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.recipes import ExtractionOptions, Recipe, load_recipe, recipe_names
from colmap_affrect.rectifiers.affine_warps import (
    AffNetShapesOptions,
    DenseShapesOptions,
)
from colmap_affrect.rectifiers.base import CoverOptions

NAMES = [
    "affnet-shapes", "aliked-lightglue", "asift", "asift-recommended", "default", "dense-affnet",
    "dense-affnet-recommended", "depth-affnet", "depth-affnet-recommended", "depth-planes",
    "depth-planes-recommended", "lines", "on-demand", "rectified", "second-moment-shapes",
    "unrectified", "unrectified-rootsift",
]  # fmt: skip

OF_THE_PAPER = {
    "unrectified": "identity", "asift": "asift", "affnet-shapes": "affnet-shapes",
    "depth-planes": "depth-planes", "depth-affnet": "depth-affnet", "dense-affnet": "dense-shapes",
}  # fmt: skip


def test_recipes_have_summaries_and_options_that_survive_being_written_down() -> None:
    assert recipe_names() == NAMES
    for name in NAMES:
        recipe = load_recipe(name)
        assert recipe.name == name
        assert 10 < len(recipe.summary) < 110
        written = tomllib.loads(tomli_w.dumps(recipe.extraction.to_mapping()))
        assert (
            ExtractionOptions.from_mapping(written, "config.toml") == recipe.extraction
        )


@pytest.mark.parametrize(("name", "rectifier"), OF_THE_PAPER.items())
def test_recipes_of_the_paper_have_its_settings(name: str, rectifier: str) -> None:
    recipe = load_recipe(name)
    extraction = recipe.extraction
    features = recipe.extraction.features
    assert extraction.rectifier.name == rectifier
    assert (features.name, features.descriptor) == ("affnet-hardnet", "hardnet")
    assert features.contrast_threshold == 0.04
    assert features.max_num_features == features.max_num_rectified_features == 1_000_000
    assert (recipe.matching.max_ratio, recipe.matching.ratio_both_ways) == (0.85, False)
    if isinstance(extraction.rectifier, CoverOptions):
        cover = extraction.rectifier
        assert (cover.tilt_radius, cover.max_tilt, cover.covered_frac) == (
            1.7,
            5.8,
            0.95,
        )
        assert (cover.shape_source.name, cover.area_preserving) == ("affnet", False)


def test_levels_build_on_the_lowest_one_with_their_features() -> None:
    recipe = load_recipe("default")
    levels = recipe.extraction.levels
    matchers = [level.matching and level.matching.name for level in levels]
    assert [level.base for level in levels] == [0, 0, 2, 3, 2]
    assert [level.max_image_size_px for level in levels] == [
        2400,
        2400,
        1024,
        2400,
        1024,
    ]
    assert matchers == [None, None, "lightglue", None, "lightglue"]
    assert len({level.name for level in levels}) == len(levels)
    assert set(recipe.weights) == {"aliked-n16", "lightglue-aliked"}
    assert load_recipe("on-demand").extraction.levels[3].base == 0


def test_matcher_must_take_the_features() -> None:
    with pytest.raises(OptionError) as error:
        load_recipe("default", ["matching=lightglue"])
    assert str(error.value).endswith(
        "lightglue takes features of aliked, not of rootsift; use --recipe aliked-lightglue"
    )


def test_matching_of_a_level_must_take_its_features() -> None:
    values = {
        "escalation": [
            {"features": "affnet-hardnet", "matching": {"name": "lightglue"}}
        ]
    }
    with pytest.raises(
        OptionError, match="takes features of aliked, not of affnet-hardnet"
    ):
        Recipe.from_mapping(values, "mine")


def test_settings_change_single_options() -> None:
    settings = [
        "matching.max_ratio=0.7",
        "max_image_size_px=1000",
        "rectifier=affnet-shapes",
        "rectifier.tilt_radius=1.8",
        "rectifier.shape_source.integration_sigmas_px=[4.0, 9.0]",
    ]
    extraction = load_recipe("default", settings).extraction
    shapes = SecondMomentOptions(integration_sigmas_px=(4.0, 9.0))
    assert extraction.rectifier == AffNetShapesOptions(
        tilt_radius=1.8, shape_source=shapes
    )
    assert extraction.max_image_size_px == 1000
    assert load_recipe("default", settings).matching.max_ratio == 0.7
    assert extraction.features == load_recipe("default").extraction.features


@pytest.mark.parametrize(("setting", "message"), [
    ("rectifier.tilt_radius", "expected OPTION=VALUE"),
    ("=3", "expected OPTION=VALUE"),
    ("rectifyer.tilt_radius=1.8", "did you mean 'rectifier'"),
    ("rectifier.tilt_radius=0.5", r"tilt_radius=0\.5: should be greater"),
    ("rectifier.tilt_radius=wide", "=.wide.: should be a valid number"),
    ("matching.max_ratio.deep=1", "is not a section"),
    ("escalate=3", "escalate=3: should be a valid dict"),
    ("rectifier=dense", "unknown rectifier 'dense' .did you mean 'dense-shapes'"),
])  # fmt: skip
def test_wrong_setting_is_one_clear_line(setting: str, message: str) -> None:
    with pytest.raises(OptionError, match=message) as error:
        load_recipe("default", [setting])
    assert "\n" not in str(error.value)


def test_recipe_file_is_read_and_what_it_leaves_out_is_default(tmp_path: Path) -> None:
    path = tmp_path / "mine č.toml"
    text = 'summary = "mine"\n[rectifier]\nmax_num_rectifications = 2\n'
    path.write_text(text, encoding="utf-8-sig")  # as editors of Windows do
    recipe = load_recipe(str(path))
    assert (recipe.name, recipe.summary) == (str(path), "mine")
    rectifier = DenseShapesOptions(max_num_rectifications=2)
    assert recipe.extraction == ExtractionOptions(rectifier=rectifier)
    assert recipe.matching == NearestOptions()


def test_unusable_recipe_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[rectifier\n")
    (tmp_path / "b.toml").write_text("[rectifier]\ntilt = 3\n")
    for recipe, message in (
        (str(tmp_path / "a.toml"), r"a\.toml: cannot be read"),
        (str(tmp_path / "b.toml"), r"b\.toml: rectifier: unknown option 'tilt'"),
        (str(tmp_path / "c.toml"), r"c\.toml: no such file"),
        ("defualt", r"'defualt' .did you mean .default."),
    ):
        with pytest.raises(OptionError, match=message) as error:
            load_recipe(recipe)
        assert "\n" not in str(error.value)
