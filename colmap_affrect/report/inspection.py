"""Show what a recipe does to an image: sheets to look at, and the plan as data."""

import json
from pathlib import Path

from colmap_affrect.data import Mask
from colmap_affrect.report.levels import describe_level, inspect_level, summary
from colmap_affrect.report.sheet import draw_sheet
from colmap_affrect.stages.one_image import ImageExtractor


def inspect_image(
    extractor: ImageExtractor, path: Path, output_path: Path, mask: Mask | None = None
) -> str:
    """Carry out a recipe on one image, draw every step, and return a summary for people.

    Each level has a sheet: ``<stem>-inspection.png`` is that of every image,
    ``<stem>-inspection-level-<k>.png`` is level k of escalation. ``<stem>-plan.json`` lists the
    levels (:func:`colmap_affrect.report.levels.describe_level`). Where a depth map cannot be used
    the level has no warps and a ``warning``, as in extraction. ``mask`` is (H, W) bool of the
    stored image. Raises ImageError when the file cannot be read.
    """
    numbers = range(len(extractor.rectifiers))
    read = [extractor.photograph(path, mask=mask, level=number) for number in numbers]
    stored_size = read[0][1]
    output_path.mkdir(parents=True, exist_ok=True)
    lines, paths, descriptions = [], [], []
    for number, (photograph, _) in enumerate(read):
        level = inspect_level(extractor, photograph, number)
        suffix = f"-level-{number}" if number else ""
        paths.append(output_path / f"{path.stem}-inspection{suffix}.png")
        draw_sheet(level, stored_size, paths[-1])
        lines.append(f"level {number}, {level.options.name}: {summary(level)}")
        descriptions.append(describe_level(level))
    description = {
        "image": path.name,
        "stored_size": list(stored_size),
        "options": extractor.options.to_mapping(),
        "levels": descriptions,
    }
    paths.append(output_path / f"{path.stem}-plan.json")
    text = json.dumps(description, indent=2, ensure_ascii=False)
    paths[-1].write_text(text + "\n", encoding="utf-8")
    return "\n".join([*lines, *map(str, paths)])
