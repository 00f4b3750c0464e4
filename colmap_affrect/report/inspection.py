"""Show what a recipe does to an image: sheets to look at, and the plan as data."""

import json
from pathlib import Path

from colmap_affrect.data import Mask
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.workspace import Workspace
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
    stored image. Raises ImageError when the file cannot be read, OptionError for an output folder
    that is not ours.
    """
    workspace = Workspace(output_path)
    workspace.require_own(path.parent)
    numbers = range(len(extractor.rectifiers))
    read = [extractor.photograph(path, mask=mask, level=number) for number in numbers]
    stored_size = read[0][1]
    workspace.begin()
    lines, descriptions = [], []
    suffixes = [f"-level-{number}" if number else "" for number in numbers]
    sheets = [output_path / f"{path.stem}-inspection{suffix}.png" for suffix in suffixes]
    paths = [*sheets, output_path / f"{path.stem}-plan.json"]
    with new_results(*paths, replaces=True) as (*new_sheets, plan):
        for number, (photograph, _) in enumerate(read):
            level = inspect_level(extractor, photograph, number)
            draw_sheet(level, new_sheets[number])
            lines.append(f"level {number}, {level.rectifier}: {summary(level)}")
            descriptions.append(describe_level(level))
        description = {
            "image": path.name,
            "stored_size": list(stored_size),
            "options": extractor.options.to_mapping(),
            "levels": descriptions,
        }
        text = json.dumps(description, indent=2, ensure_ascii=False)
        plan.write_text(text + "\n", encoding="utf-8")
    return "\n".join([*lines, *map(str, paths)])
