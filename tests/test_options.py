"""Options are checked when they are made, and say what is wrong with them."""

from __future__ import annotations

import json
import pickle
import re
from importlib import metadata

import pytest

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import OptionError
from colmap_affrect.features.sift import SiftOptions
from colmap_affrect.mappers.incremental import IncrementalOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.options import Options, Registry, from_record
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.dense import DenseShapesOptions

ALL_OPTIONS = [ExtractionOptions, IncrementalOptions, NearestOptions, VerificationOptions]


@pytest.mark.parametrize("cls", ALL_OPTIONS)
def test_from_mapping_inverts_to_mapping_and_options_can_be_pickled(cls: type[Options]) -> None:
    options = cls()
    assert cls.from_mapping(options.to_mapping(), "recipe") == options
    assert cls.from_mapping({}, "recipe") == options
    assert pickle.loads(pickle.dumps(options)) == options
    json.dumps(options.to_mapping())


def test_from_mapping_suggests_the_option_that_was_meant() -> None:
    with pytest.raises(OptionError, match=r"^matching: .*'max_ration'.*did you mean 'max_ratio'"):
        NearestOptions.from_mapping({"max_ration": 0.7}, "matching")


@pytest.mark.parametrize("value", [3, None])
def test_from_mapping_rejects_a_section_that_is_no_table(value: object) -> None:
    with pytest.raises(OptionError, match="rectifier"):
        ExtractionOptions.from_mapping({"rectifier": value}, "recipe")


def test_from_mapping_builds_nested_options() -> None:
    options = ExtractionOptions.from_mapping(
        {"rectifier": {"max_tilt": 4}, "features": {"max_num_features": 100}}, "recipe"
    )
    assert options.rectifier == DenseShapesOptions(max_tilt=4.0)
    assert options.features == SiftOptions(max_num_features=100)


def test_from_mapping_names_the_path_of_a_nested_mistake() -> None:
    with pytest.raises(OptionError, match=r"recipe: rectifier: unknown option 'max_tild'"):
        ExtractionOptions.from_mapping({"rectifier": {"max_tild": 4.0}}, "recipe")
    with pytest.raises(OptionError, match=r"recipe: rectifier: max_tilt=99"):
        ExtractionOptions.from_mapping({"rectifier": {"max_tilt": 99.0}}, "recipe")


@pytest.mark.parametrize(
    ("cls", "name", "low", "high"),
    [
        (DenseShapesOptions, "tilt_radius", 1.05, 10.0),
        (SiftOptions, "max_num_features", 1, 1_000_000),
        (NearestOptions, "max_ratio", 0.1, 1.0),
    ],
)
def test_options_accept_the_ends_of_their_range_and_nothing_beyond(
    cls: type[Options], name: str, low: float, high: float
) -> None:
    for value in (low, high):
        assert getattr(cls(**{name: value}), name) == value
    step = 1 if isinstance(low, int) else 1e-3
    for value in (low - step, high + step):
        with pytest.raises(OptionError, match=re.escape(f" is outside [{low:g}, {high:g}]")):
            cls(**{name: value})


def test_parts_of_this_package_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    others = [metadata.EntryPoint(name, "module:Class", "group") for name in ("theirs", "ours")]
    monkeypatch.setattr(metadata, "entry_points", lambda **_: others)
    assert Registry("thing", "group", {"ours": "a:B"}, "ours").names() == ["ours", "theirs"]


def test_records_of_other_versions_are_read_without_their_options(
    caplog: pytest.LogCaptureFixture,
) -> None:
    old = {"max_image_size_px": 99, "gone": 1, "features": {"name": "rootsift", "lost": 2}}
    for _ in range(2):
        found = from_record("c.toml", lambda: ExtractionOptions.from_mapping(old, "c.toml"))
        assert (found.max_image_size_px, found.features) == (99, SiftOptions())
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith(
        "c.toml: options of another version are left out: gone, lost"
    )
