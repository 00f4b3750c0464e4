"""Recipes: those in the repository, single options on top, and mistakes in them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from colmap_affrect.errors import OptionError
from colmap_affrect.options import DenseShapesOptions, ExtractionOptions, MatchingOptions
from colmap_affrect.recipes import load_recipe, recipe_folder, recipe_names

NAMES = ["default", "unrectified-rootsift"]


def test_recipe_names_are_those_in_the_repository() -> None:
    assert recipe_names() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_recipe_has_a_summary_and_only_known_options(name: str) -> None:
    recipe = load_recipe(name)
    assert recipe.name == name
    assert 10 < len(recipe.summary) < 100
    with (recipe_folder() / f"{name}.toml").open("rb") as file:
        assert set(tomllib.load(file)) <= {
            "summary", "rectifier", "second_moment", "features", "matching", "max_image_size_px",
        }  # fmt: skip


def test_default_recipe_rectifies_with_the_values_of_the_paper() -> None:
    rectifier = load_recipe("default").extraction.rectifier
    assert (rectifier.name, rectifier.shape_source) == ("dense-shapes", "second-moment")
    assert (rectifier.tilt_radius, rectifier.max_tilt, rectifier.covered_frac) == (1.7, 5.8, 0.95)


def test_recipes_differ_in_the_rectifier_only() -> None:
    default, plain = (load_recipe(name) for name in NAMES)
    assert plain.extraction.rectifier.name == "identity"
    assert plain.extraction.features == default.extraction.features
    assert plain.matching == default.matching


def test_settings_change_single_options() -> None:
    recipe = load_recipe(
        "default",
        [
            "rectifier.tilt_radius=1.8",
            "second_moment.integration_sigmas_px=[4.0, 9.0]",
            "matching.max_ratio=0.7",
            "max_image_size_px=1000",
            "rectifier.name=identity",
        ],
    )
    assert recipe.extraction.rectifier.tilt_radius == 1.8
    assert recipe.extraction.rectifier.name == "identity"
    assert recipe.extraction.second_moment.integration_sigmas_px == (4.0, 9.0)
    assert recipe.extraction.max_image_size_px == 1000
    assert recipe.matching.max_ratio == 0.7
    assert recipe.extraction.features == load_recipe("default").extraction.features


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("rectifier.tilt_radius", "expected section.option=value"),
        ("=3", "expected section.option=value"),
        ("rectifier.tilt_radios=1.8", "did you mean 'tilt_radius'"),
        ("rectifyer.tilt_radius=1.8", "did you mean 'rectifier'"),
        ("rectifier.tilt_radius=0.5", r"tilt_radius=0\.5 is outside"),
        ("rectifier.tilt_radius=wide", "expected float, got str"),
        ("features.max_num_features=1.5", "expected int, got float"),
        ("matching.max_ratio.deep=1", "is not a section"),
        ("rectifier.name=dense", "not one of dense-shapes, identity"),
    ],
)
def test_wrong_setting_is_one_clear_line(setting: str, message: str) -> None:
    with pytest.raises(OptionError, match=message) as error:
        load_recipe("default", [setting])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("setting", ["rectifier=3", "matching=3", "features=[1]"])
def test_value_in_the_place_of_a_section_is_one_clear_line(setting: str) -> None:
    with pytest.raises(OptionError, match=setting.partition("=")[0]):
        load_recipe("default", [setting])


def test_unknown_recipe_is_named_with_a_suggestion_and_the_known_ones() -> None:
    with pytest.raises(OptionError, match=r"'defualt': did you mean 'default'\? known are default"):
        load_recipe("defualt")


def test_recipe_file_is_read_and_what_it_leaves_out_is_default(tmp_path: Path) -> None:
    path = tmp_path / "mine č.toml"
    path.write_text('summary = "mine"\n[rectifier]\nmax_num_rectifications = 2\n')
    recipe = load_recipe(str(path))
    assert (recipe.name, recipe.summary) == (str(path), "mine")
    assert recipe.extraction == ExtractionOptions(
        rectifier=DenseShapesOptions(max_num_rectifications=2)
    )
    assert recipe.matching == MatchingOptions()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[rectifier\n", r"mine\.toml: cannot be read"),
        (b"\xff\xfe", r"mine\.toml: cannot be read"),
        (b"[rectifier]\ntilt = 3\n", r"mine\.toml\.rectifier: unknown option 'tilt'"),
        (b"[mapping]\nx = 3\n", r"unknown option 'mapping'"),
        (None, "unknown recipe"),
    ],
)
def test_unusable_recipe_file_is_one_clear_line(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(OptionError, match=message) as error:
        load_recipe(str(path))
    assert "\n" not in str(error.value)
