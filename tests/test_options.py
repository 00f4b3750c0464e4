"""Options are checked when they are made, and say what is wrong with them."""

from __future__ import annotations

import json
import pickle
import re
from importlib import metadata

import pytest

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import OptionError
from colmap_affrect.features.affnet_hardnet import AffNetHardNetOptions
from colmap_affrect.features.second_moment import SecondMomentOptions
from colmap_affrect.features.sift import SiftOptions
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.global_mapper import GlobalOptions
from colmap_affrect.mappers.incremental import IncrementalOptions
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.options import Options, Registry
from colmap_affrect.pairs.base import PairOptions
from colmap_affrect.recipes import EscalateOptions, ExtractionOptions
from colmap_affrect.rectifiers.dense import DenseShapesOptions
from colmap_affrect.rectifiers.whole_image import AsiftOptions

ALL_OPTIONS = [
    CameraOptions, EscalateOptions, ExtractionOptions, GlobalOptions, IncrementalOptions,
    GuidedOptions, NearestOptions, PairOptions, SecondMomentOptions, SiftOptions,
    VerificationOptions, AffNetHardNetOptions, AsiftOptions,
]  # fmt: skip


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


def test_from_mapping_lists_the_known_options_when_none_is_similar() -> None:
    with pytest.raises(OptionError, match=r"'zzz'.*known: .*max_ratio, .*duplicate_radius_px"):
        NearestOptions.from_mapping({"zzz": 1}, "matching")


@pytest.mark.parametrize(
    ("cls", "values", "message"),
    [
        (NearestOptions, {"max_ratio": "0.8"}, r"here: max_ratio: expected float, got str"),
        (NearestOptions, {"max_ratio": True}, r"here: max_ratio: expected float, got bool"),
        (NearestOptions, {"max_ratio": None}, r"here: max_ratio: expected float, got NoneType"),
        (SiftOptions, {"max_num_features": 10.0}, r"max_num_features: expected int, got float"),
        (SiftOptions, {"max_num_features": True}, r"max_num_features: expected int, got bool"),
        (IncrementalOptions, {"ignore_two_view_tracks": 0}, r"expected bool, got int"),
        (SecondMomentOptions, {"integration_sigmas_px": 8.0}, r"expected list, got float"),
    ],
)
def test_from_mapping_rejects_values_of_a_wrong_type(
    cls: type[Options], values: dict[str, object], message: str
) -> None:
    with pytest.raises(OptionError, match=message):
        cls.from_mapping(values, "here")


def test_from_mapping_takes_integers_in_lists_as_floats() -> None:
    options = SecondMomentOptions.from_mapping({"integration_sigmas_px": [4, 9]}, "x")
    assert options.integration_sigmas_px == (4.0, 9.0)
    assert [type(value) for value in options.integration_sigmas_px] == [float, float]


def test_from_mapping_names_the_path_of_a_nested_mistake() -> None:
    with pytest.raises(OptionError, match=r"recipe: rectifier: unknown option 'max_tild'"):
        ExtractionOptions.from_mapping({"rectifier": {"max_tild": 4.0}}, "recipe")
    with pytest.raises(OptionError, match=r"recipe: rectifier: max_tilt=99"):
        ExtractionOptions.from_mapping({"rectifier": {"max_tilt": 99.0}}, "recipe")


@pytest.mark.parametrize(
    ("cls", "name", "low", "high"),
    [
        (DenseShapesOptions, "tilt_radius", 1.05, 10.0),
        (DenseShapesOptions, "max_tilt", 1.0, 20.0),
        (DenseShapesOptions, "covered_frac", 0.0, 1.0),
        (DenseShapesOptions, "max_num_rectifications", 0, 192),
        (DenseShapesOptions, "min_region_frac", 0.0, 1.0),
        (SecondMomentOptions, "derivative_sigma_px", 0.3, 20.0),
        (SecondMomentOptions, "min_gradient", 0.0, 255.0),
        (SiftOptions, "max_num_features", 1, 1_000_000),
        (SiftOptions, "max_num_rectified_features", 1, 1_000_000),
        (SiftOptions, "contrast_threshold", 0.0, 1.0),
        (SiftOptions, "num_octave_layers", 1, 10),
        (SiftOptions, "sigma_px", 0.5, 10.0),
        (ExtractionOptions, "max_image_size_px", 16, 1_000_000),
        (NearestOptions, "max_ratio", 0.1, 1.0),
        (NearestOptions, "min_contrast_distance_px", 0.1, 1000.0),
        (NearestOptions, "duplicate_radius_px", 0.01, 1000.0),
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


@pytest.mark.parametrize(
    ("cls", "values"),
    [
        (DenseShapesOptions, {"name": "asift"}),
        (DenseShapesOptions, {"shape_source": "sobel"}),
        (SiftOptions, {"name": "sift"}),
        (CameraOptions, {"mode": "shared"}),
        (SecondMomentOptions, {"integration_sigmas_px": ()}),
        (SecondMomentOptions, {"integration_sigmas_px": (0.5, 8.0)}),
    ],
)
def test_options_reject_names_and_lists_they_do_not_know(
    cls: type[Options], values: dict[str, object]
) -> None:
    (name,) = values
    with pytest.raises(OptionError, match=name):
        cls(**values)


def test_parts_of_this_package_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    others = [metadata.EntryPoint(name, "module:Class", "group") for name in ("theirs", "ours")]
    monkeypatch.setattr(metadata, "entry_points", lambda **_: others)
    assert Registry("thing", "group", {"ours": "a:B"}, "ours").names() == ["ours", "theirs"]
