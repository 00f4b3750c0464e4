"""Pages of the documentation that lie elsewhere, or that the program writes about itself."""

from __future__ import annotations

import inspect
import os
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import colmap_affrect
from colmap_affrect.cli.parser import COMMANDS, build_parser
from colmap_affrect.recipes import load_recipe, recipe_names
from colmap_affrect.report.inspection import inspect_image
from colmap_affrect.stages.one_image import prepare

OUTSIDE = {"README.md": "index.md"}
OUTSIDE |= {
    name: name
    for name in ("ARCHITECTURE.md", "BENCHMARKS.md", "CHANGELOG.md", "CONTRIBUTING.md")
}
PHOTOGRAPH = "sample_scenes/facade/images/view_3_tilt45.jpg"
"""One plane, seen at 45 degrees."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, with the links of a file that lies in docs/."""
    root = Path(config.config_file_path).parent
    for source, target in OUTSIDE.items():
        text = (root / source).read_text(encoding="utf-8")
        files.append(
            File.generated(config, target, content=text.replace("](docs/", "]("))
        )
    for name, text in {
        "commands.md": commands_page(),
        "functions.md": functions_page(),
    }.items():
        files.append(File.generated(config, name, content=text))
    page, pictures = recipes_page(root / PHOTOGRAPH)
    files.append(File.generated(config, "recipes.md", content=page))
    for name, picture in pictures.items():
        files.append(File.generated(config, name, content=picture))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Make links to the pages that lie one folder higher in the repository."""
    for source, target in OUTSIDE.items():
        markdown = markdown.replace(f"](../{source}", f"]({target}")
    return markdown


def commands_page() -> str:
    """Return what each command says with --help."""
    os.environ["COLUMNS"] = "100"
    (choices,) = (
        a.choices for a in build_parser()._actions if isinstance(a.choices, dict)
    )
    parts = [
        f"## {name}\n\n```text\n{choices[name].format_help()}```\n" for name in COMMANDS
    ]
    return "# Commands\n\n" + "\n".join(parts)


def functions_page() -> str:
    """Return the docstrings of the public functions and classes."""
    parts = []
    for name in sorted(colmap_affrect.__all__):
        text = inspect.getdoc(getattr(colmap_affrect, name))
        parts.append(f"## {name}\n\n```text\n{text}\n```\n")
    return "# Functions\n\n" + "\n".join(parts)


def recipes_page(photograph: Path) -> tuple[str, dict[str, bytes]]:
    """Return what the recipes are for, and what those without weights do to a photograph."""
    parts, pictures = [], {}
    for name in recipe_names():
        recipe = load_recipe(name)
        parts.append(f"## {name}\n\n{recipe.summary}\n")
        if recipe.extraction.weights or recipe.extraction.uses_depth:
            continue
        with tempfile.TemporaryDirectory() as folder:
            inspect_image(prepare(recipe.extraction), photograph, Path(folder))
            drawing = Path(folder) / f"{photograph.stem}-inspection.png"
            pictures[f"recipes/{name}.png"] = drawing.read_bytes()
        parts.append(f"![What {name} does to a photograph](recipes/{name}.png)\n")
    return "# Recipes\n\n" + "\n".join(parts), pictures
