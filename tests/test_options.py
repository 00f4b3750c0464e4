"""Options are checked when they are made, and say what is wrong with them."""

from __future__ import annotations

import json
import pickle
from importlib import metadata

import pytest

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import OptionError
from colmap_affrect.features.sift import SiftOptions
from colmap_affrect.mappers.incremental import IncrementalOptions
from colmap_affrect.options import Options, Registry
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.affine_warps import DenseShapesOptions


@pytest.mark.parametrize(
    "cls", [ExtractionOptions, IncrementalOptions, VerificationOptions]
)
def test_options_come_back_from_what_they_are_written_as(cls: type[Options]) -> None:
    options = cls()
    written = json.loads(json.dumps(options.to_mapping()))
    assert (
        cls.from_mapping(written, "recipe") == cls.from_mapping({}, "recipe") == options
    )
    assert pickle.loads(pickle.dumps(options)) == options


def test_nested_options_are_built_and_their_mistakes_named_by_their_path() -> None:
    options = ExtractionOptions.from_mapping(
        {"rectifier": {"max_tilt": 4}, "features": {"max_num_features": 100}}, "recipe"
    )
    assert options.rectifier == DenseShapesOptions(max_tilt=4.0)
    assert options.features == SiftOptions(max_num_features=100)
    for rectifier, said in (
        (
            {"max_tild": 4.0},
            r"^recipe: rectifier: unknown option 'max_tild' .did you mean 'max_ti",
        ),
        ({"max_tilt": 99.0}, r"^recipe: rectifier: max_tilt=99\.0: should be less"),
        (3, "rectifier"),
        (None, "rectifier"),
    ):
        with pytest.raises(OptionError, match=said):
            ExtractionOptions.from_mapping({"rectifier": rectifier}, "recipe")


def test_parts_of_this_package_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    others = [
        metadata.EntryPoint(name, "module:Class", "group")
        for name in ("theirs", "ours")
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda **_: others)
    assert Registry("thing", "group", {"ours": "a:B"}, "ours").names() == [
        "ours",
        "theirs",
    ]
