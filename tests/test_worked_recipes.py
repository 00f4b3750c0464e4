"""The scripts beside the recipes do what their README says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from small_scene import write_photographs

from colmap_affrect.imaging import read_mask
from colmap_affrect.recipes import recipe_folder, recipe_names

RECIPES = Path(__file__).parents[1] / "recipes"


def run_script(*arguments: object) -> str:
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_script_with_the_features_replaced_registers_the_scene(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos")
    script = RECIPES / "replace-sift" / "reconstruct.py"
    printed = run_script(script, tmp_path / "photos", tmp_path / "out")
    assert printed.startswith("model 0: 4 images, ")


def test_masks_leave_out_borders_and_captions(tmp_path: Path) -> None:
    names = write_photographs(tmp_path / "photos")  # 320 x 240 px
    script = RECIPES / "historical-photographs" / "border_masks.py"
    run_script(
        script, tmp_path / "photos", tmp_path / "masks", "--border", "0.05", "--caption", "0.2"
    )
    expected = np.zeros((240, 320), bool)
    expected[12 : 240 - 48, 12 : 320 - 12] = True
    for name in names:
        np.testing.assert_array_equal(read_mask(tmp_path / "masks" / f"{name}.png"), expected)


def test_worked_recipes_are_no_recipes_of_the_command_line() -> None:
    assert recipe_folder() == RECIPES
    assert not {"historical-photographs", "replace-sift"} & set(recipe_names())
