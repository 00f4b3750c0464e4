"""Output folders after the stages that every recipe has, and copies of folders."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from small_scene import INTRINSICS

from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

CAMERAS = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)
"""Of the small scene."""


def verified(
    photos: Path,
    output: Path,
    recipe: str = "unrectified-rootsift",
    settings: Sequence[str] = (),
    cameras: CameraOptions = CAMERAS,
) -> Workspace:
    """Extract, match and verify all pairs."""
    workspace = Workspace(output)
    with workspace.locked():
        context = Context(workspace)
        extract(
            context, Inputs.of(photos, cameras=cameras), load_recipe(recipe, settings)
        )
        choose_pairs(context)
        match(context)
        verify_matches(context)
    return workspace


def copy_of(workspace: Workspace, folder: Path) -> Workspace:
    """Copy an output folder, to be changed."""
    return Workspace(Path(shutil.copytree(workspace.path, folder, dirs_exist_ok=True)))
