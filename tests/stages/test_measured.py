"""Pairs of levels without measured frames: they replace no others, and must not contradict them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from small_scene import INTRINSICS, NAMES, write_photographs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.features.base import EXTRACTORS
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages import map as stage
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import Escalation, escalate, measured_database
from colmap_affrect.stages.extract import Inputs, extract
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

RECIPE = """
[rectifier]
name = "identity"
[[escalation]]
features = "shapeless"
[escalate]
strong_num_inliers = 1000000
min_num_consistent = 0
"""


@pytest.fixture(scope="module", autouse=True)
def _shapeless() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXTRACTORS.built_in, "shapeless", "shapeless_features:Shapeless")  # type: ignore[arg-type]
        yield


@pytest.fixture(scope="module")
def verified(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("verified")
    write_photographs(folder / "photos")
    (folder / "recipe.toml").write_text(RECIPE)
    workspace = Workspace(folder / "out")
    cameras = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)
    with workspace.locked():
        context = Context(workspace)
        inputs = Inputs.of(folder / "photos", cameras=cameras)
        extract(context, inputs, load_recipe(str(folder / "recipe.toml")))
        choose_pairs(context)
        match(context)
        verify_matches(context)
    return workspace


@pytest.fixture
def context(verified: Workspace, tmp_path: Path) -> Context:
    return Context(Workspace(Path(shutil.copytree(verified.path, tmp_path / "out"))))


def with_level_1(context: Context, *pairs: tuple[str, str]) -> None:
    """Say that the matches of pairs are those of the level without measured frames."""
    found = [replace(item, level=1) for item in context.matches.read(pairs)]
    context.matches.write(found)


def test_what_measured_frames_verified_is_left_alone(context: Context) -> None:
    pairs = Escalation(context, load_recipe("default").escalate).pairs
    assert len(verified_pairs(context.workspace.database, 1)) == len(pairs) == 6
    assert escalate(context).num_done == 0
    assert set(context.matches.tried_levels(pairs).values()) == {0}


def test_measured_database_has_the_pairs_of_levels_with_measured_frames(context: Context) -> None:
    with measured_database(context) as path:
        assert path is None
    with_level_1(context, (NAMES[0], NAMES[1]), (NAMES[1], NAMES[3]))
    everything = verified_pairs(context.workspace.database, 1)
    with measured_database(context) as path:
        assert path is not None
        measured = verified_pairs(path, 1)
    assert len(measured) == len(everything) - 2
    assert measured.items() <= everything.items()


@pytest.mark.parametrize("is_wrong", [False, True])
def test_models_that_contradict_measured_pairs_give_way(
    context: Context, monkeypatch: pytest.MonkeyPatch, is_wrong: bool
) -> None:
    @contextmanager
    def all_pairs(_: Context) -> Iterator[Path]:
        folder = context.workspace.path / "measured"
        folder.mkdir()
        copy_database(context.workspace.database, folder / "database.db")
        yield folder / "database.db"

    mapper = MAPPERS.make(MAPPERS.options("sparse"))
    stage.map_images(context, mapper)
    sparse = context.workspace.sparse
    model = pycolmap.Reconstruction(sparse / "0")
    if is_wrong:  # two photographs stand where the other one was
        frames = [model.frames[image.frame_id] for image in model.images.values()][:2]
        poses = [frame.rig_from_world for frame in frames]
        frames[0].rig_from_world, frames[1].rig_from_world = poses[1], poses[0]
        model.write(sparse / "0")
    task = MappingTask(context.workspace.database, None, True)
    monkeypatch.setattr(stage, "measured_database", all_pairs)
    models = stage.read_models(sparse, task)
    kept = stage._or_measured(context, mapper, task, models)
    assert (kept is models) == (not is_wrong)
    assert kept[0].registered_names == tuple(sorted(NAMES))
    again = pycolmap.Reconstruction(sparse / "0")
    same = all(
        again.find_image_with_name(name).cam_from_world().matrix().tolist()
        == model.find_image_with_name(name).cam_from_world().matrix().tolist()
        for name in NAMES
    )
    assert same == (not is_wrong)
