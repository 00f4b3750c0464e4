"""Show what a recipe does to an image: sheets to look at, and the plan as data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.extraction import ImageExtractor
from colmap_affrect.report.levels import describe_level, inspect_level, summary
from colmap_affrect.report.sheet import draw_sheet
from colmap_affrect.types import Mask


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect_image` wrote.

    Attributes:
        sheet_paths: one PNG per level.
        plan_path: the JSON file.
        lines: one line about each level, for people.
    """

    sheet_paths: tuple[Path, ...]
    plan_path: Path
    lines: tuple[str, ...]

    def summary(self) -> str:
        """Return the lines and where the files are."""
        return "\n".join([*self.lines, *map(str, self.sheet_paths), str(self.plan_path)])


def inspect_image(
    extractor: ImageExtractor,
    path: Path,
    output_path: Path,
    *,
    name: str = "",
    intrinsics: NDArray[np.float64] | None = None,
    mask: Mask | None = None,
    level: int | None = None,
) -> Inspection:
    """Carry out a recipe on one image and draw every step.

    Each level has a sheet: ``<stem>-inspection.png`` is that of every image,
    ``<stem>-inspection-level-<k>.png`` is level k of escalation. ``<stem>-plan.json`` lists the
    levels (:func:`colmap_affrect.report.levels.describe_level`). Where a depth map cannot be
    used the level has no warps and a ``warning``, as in extraction.

    Args:
        extractor: the recipe.
        path: the image file.
        output_path: folder of the results, made if it is not there.
        name: key of its depth map; the file's name by default.
        intrinsics: (3, 3) camera matrix in pixel-centre px of the stored image; by default
            COLMAP's guess of a focal length of 1.2 times the longer side.
        mask: (H, W) bool of the stored image, where features may be; None means everywhere.
        level: draw only this one; by default all of them.

    Raises:
        ImageError: when the file cannot be read.
    """
    photograph, stored_size = extractor.photograph(path, name, intrinsics, mask)
    output_path.mkdir(parents=True, exist_ok=True)
    numbers = range(len(extractor.rectifiers)) if level is None else [level]
    sheet_paths, lines, descriptions = [], [], []
    for number in numbers:
        inspected = inspect_level(extractor, photograph, number)
        suffix = f"-level-{number}" if number else ""
        sheet_paths.append(output_path / f"{path.stem}-inspection{suffix}.png")
        draw_sheet(inspected, stored_size, sheet_paths[-1])
        lines.append(f"level {number}, {inspected.options.name}: {summary(inspected)}")
        descriptions.append(describe_level(inspected))
    description = {
        "image": photograph.name,
        "stored_size": list(stored_size),
        "size": list(photograph.size),
        "options": extractor.options.to_mapping(),
        "levels": descriptions,
    }
    plan_path = output_path / f"{path.stem}-plan.json"
    text = json.dumps(description, indent=2, ensure_ascii=False)
    plan_path.write_text(text + "\n", encoding="utf-8")
    return Inspection(tuple(sheet_paths), plan_path, tuple(lines))
