"""Pages that need nothing beside them, made from the parts in ``templates`` (home of jinja2)."""

import hashlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from colmap_affrect.errors import shown
from colmap_affrect.progress import Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import resolved
from colmap_affrect.report.pictures import base64_text, thumbnails
from colmap_affrect.report.scene import View3D

TEMPLATES = Path(__file__).parent / "templates"
INLIER_COLORS = {
    1: "#e3b341", 30: "#f08c3c", 60: "#e2604f", 120: "#cf4080", 240: "#a14bb5", 480: "#6f60dd",
}  # fmt: skip
"""Colours of pairs by their smallest number of inliers; all stand out from white and black."""
FOLDERS = re.compile(r"(?<![^\s'\"(=\[])(?:[A-Za-z]:[\\/]|~?/)(?:[^/\\\s'\"]+[/\\])*(?=[^\s/])")
"""The folders at the beginning of a path of this machine."""


def write_page(
    path: Path,
    template: Path,
    content: Mapping[str, Any],
    names: Sequence[str],
    image_path: Path | None,
    views: Iterable[tuple[View3D, Mapping[str, str]]],
    progress: Progress,
) -> Path:
    """Fill a template, write it as one file that loads nothing, and return its path.

    The template extends ``base.html`` and may use ``parts.html``. It gets thumbnails of the
    photographs that are called ``names``, and models with the kind of each camera by its name. No
    folder of this machine is in the page, since pages are sent to others. Raises WorkspaceError
    when it cannot be written.
    """
    folders = [resolved(folder) for folder in (path.parent, image_path) if folder]
    known = [f"{place}{os.sep}" for folder in folders for place in (folder, folder.parent)]
    hidden = sorted(known, key=len, reverse=True)

    def finalized(value: Any) -> Any:
        return shown(without_folders(value, hidden)) if type(value) is str else value

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, TEMPLATES], encoding="utf-8"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=finalized,
    )
    environment.tests["contains"] = lambda values, value: value in values
    files = ["page.js", *(["tie_points.js"] if content.get("can_mark") else [])]
    scripts = [(TEMPLATES / name).read_text(encoding="utf-8") for name in files]
    environment.globals |= {
        "inlier_colors": INLIER_COLORS,
        "scripts": {s: base64_text(hashlib.sha256(s.encode()).digest()) for s in scripts},
        "style": (TEMPLATES / "page.css").read_text(encoding="utf-8"),
    }
    index = {name: number for number, name in enumerate(names)}
    data = {
        "names": list(map(shown, names)),
        "starts": list(INLIER_COLORS),
        "colors": list(INLIER_COLORS.values()),
        "matrix": content.get("matrix", ""),
        "tie_points": content.get("tie_points"),
        "views": [view.script_data(index, kinds) for view, kinds in views],
    }
    pictures = thumbnails(image_path, names, progress) if image_path else {}
    page = environment.get_template(template.name)
    replace_text(path, page.render({**content, "thumbnails": pictures, "script_data": data}))
    return path


def without_folders(text: str, known: Iterable[str] = ()) -> str:
    r"""Leave of paths of this machine their last part, and of those in known folders what is below.

    >>> without_folders(r"/home/me/a.jpg: damaged, see C:\x\b.txt and c/d.jpg or 1/2")
    'a.jpg: damaged, see b.txt and c/d.jpg or 1/2'
    """
    for folder in known:
        text = text.replace(folder, "")
    return FOLDERS.sub("", text)
