"""Commands of advice are those that were given, with other options, and can be pasted."""

from __future__ import annotations

import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.cli.parser import build_parser
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.project.advised import Advice, least_work_first
from colmap_affrect.report.pasted_commands import (
    again,
    anew,
    with_default_mapper,
    without,
)
from colmap_affrect.session.context import Inputs


def context_of(command: str, *, is_foreign: bool = False) -> Any:
    """What commands are made from, of a folder ``out`` in this one."""
    return SimpleNamespace(
        workspace=SimpleNamespace(
            path=Path("out"),
            is_foreign=is_foreign,
            database=Path("out/database.db"),
            photographs=lambda: Path("photos"),
        ),
        command=tuple(shlex.split(command)),
        inputs=Inputs(image_path="photos"),
    )


def parsed(command: str) -> Any:
    return build_parser().parse_args(shlex.split(command)[1:])


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("run --mapper-options a=1 b=2 -q", "run -q"),
        ("run --mapper=global --json", "run --json"),
        ("run --mapper_options=a=1 b=2 --json", "run --json"),
        ("run --mapper -odd --json", "run --json"),
        ("run --json --mapper global", "run --json"),
        ("run --max-time 3", "run --max-time 3"),
    ],
)
def test_flags_are_left_out_with_all_of_their_values(given: str, kept: str) -> None:
    left = without(given.split(), ["--mapper", "--mapper-options"])
    assert left == kept.split()


def test_pairs_that_were_rejected_before_are_rejected_still() -> None:
    command = "colmap-affrect run --image-path a --output-path out --reject-pair a,b"
    assert again(context_of(command), "--reject-pair", "a,b") == command
    more = again(context_of(command), "--reject-pair", "a,c")
    assert more == f"{command} --reject-pair a,c"
    parsed(more)


def test_other_options_take_the_place_of_those_given_in_another_folder() -> None:
    command = "colmap-affrect run --image-path a --ignore-exif --output-path=out --recipe x.toml"
    found = anew(context_of(command), "--recipe", "default")
    assert found == (
        "colmap-affrect run --image-path a --ignore-exif --recipe default --output-path out-2"
    )
    assert parsed(anew(context_of(""), "--ignore-exif")).image_path == Path("photos")


@pytest.mark.parametrize(
    ("given", "is_foreign", "expected"),
    [
        (
            "run --image-path a --output-path out --mapper global", False,
            "run --image-path a --output-path out-2",
        ),
        (
            "map --output-path out --mapper incremental --mapper-options a=1 b=2", False,
            "map --output-path out --mapper sparse --overwrite",
        ),
        (
            "map --from-database x.db --output-path out --mapper=global -q", True,
            "map --from-database x.db -q --mapper sparse --output-path out-2",
        ),
        (
            "map --output-path out", True,
            "map --from-database out/database.db --mapper sparse --output-path out-2",
        ),
    ],
)  # fmt: skip
def test_the_default_mapper_takes_the_place_of_another_one(
    given: str, expected: str, *, is_foreign: bool
) -> None:
    context = context_of(f"colmap-affrect {given}", is_foreign=is_foreign)
    found = with_default_mapper(context)
    assert found == f"colmap-affrect {expected}"
    assert parsed(found).mapper in (None, "sparse")


def test_a_run_by_stages_is_run_anew_with_all_that_is_known_of_its_photographs() -> (
    None
):
    context = context_of("colmap-affrect map --output-path out")
    cameras = CameraOptions(
        mode="single", params="-1,2", focal_mm=50.0, ignore_exif=True
    )
    masks = MaskOptions(path="masks", camera_path="mask.png")
    context.inputs = Inputs(
        image_path="photos", image_list_path="a b", cameras=cameras, masks=masks
    )
    found = parsed(anew(context, "--recipe", "default"))
    assert getattr(found, "cameras.params") == "-1,2"
    assert getattr(found, "cameras.focal_mm") == 50.0
    assert getattr(found, "cameras.ignore_exif")
    assert found.image_list_path == Path("a b")
    assert found.recipe == "default"


def test_what_takes_a_person_less_work_is_advised_first() -> None:
    given = [
        Advice("photographs", "more"),
        Advice("masks", "paint"),
        Advice("tie_points", "mark"),
        Advice("recipe", "more"),
        Advice("effort", "longer"),
    ]
    assert [(one.work, one.code) for one in least_work_first(given)] == [
        ("nothing", "recipe"),
        ("nothing", "effort"),
        ("minutes", "masks"),
        ("minutes", "tie_points"),
        ("hours", "photographs"),
    ]
