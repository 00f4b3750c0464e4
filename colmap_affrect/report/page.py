"""Pages that need nothing beside them, made from the parts in ``templates`` (home of jinja2)."""

import hashlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from colmap_affrect.errors import shown
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import resolved
from colmap_affrect.report.pictures import base64_text, thumbnails
from colmap_affrect.report.scene import View3D

TEMPLATES = Path(__file__).parent / "templates"
INLIER_COLORS = {
    1: "#e3b341", 30: "#f08c3c", 60: "#e2604f", 120: "#cf4080", 240: "#a14bb5", 480: "#6f60dd",
}  # fmt: skip
"""Colours of pairs by their smallest number of inliers; all stand out from white and black."""
FOLDERS = re.compile(
    r"(?<![^\s'\"(=\[])(?:[A-Za-z]:[\\/]|~?/)(?:[^/\\\s'\"]+[/\\])*(?=[^\s/])"
)
"""The folders at the beginning of a path of this machine."""


@dataclass(frozen=True)
class Page:
    """What a page is made of."""

    template: Path  # extends ``base.html`` and may use ``parts.html``
    content: Mapping[str, Any]  # variables of the template
    names: Sequence[str]  # of the photographs, in the order of their numbers
    image_path: Path | None  # their folder; without it there are no thumbnails
    views: Sequence[View3D]  # models, which the script draws
    inlier_matrix: str = ""  # base64: (N, N) uint16 numbers of inliers
    # What more the scripts read, and their files
    script_data: Mapping[str, Any] = field(default_factory=dict)
    scripts: Sequence[str] = ("page.js", "geometry.js", "viewer.js")
    reads_files: bool = False  # scripts beside it, at a click
    made_from: str = ""  # what :mod:`colmap_affrect.report.page_key` finds again


def write_page(path: Path, page: Page, progress: Progress = SILENT) -> Path:
    """Fill a template and write it as one file that loads nothing by itself.

    No folder of this machine is in the page, since pages are sent to others.

    Args:
        path: the HTML file, which is replaced.
        page: what is in it; its template gets thumbnails of the photographs, too.
        progress: where to show it.

    Returns:
        The path.

    Raises:
        WorkspaceError: the page cannot be written.
    """
    folders = []
    for folder in (path.parent, page.image_path):
        if folder:
            whole = resolved(folder)
            folders += [f"{whole}{os.sep}", f"{whole.parent}{os.sep}"]
    folders.sort(key=len, reverse=True)

    def finalized(value: Any) -> Any:
        return shown(without_folders(value, folders)) if type(value) is str else value

    import jinja2  # a run without a page needs none of it

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(
            [page.template.parent, TEMPLATES], encoding="utf-8"
        ),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=finalized,
    )
    environment.tests["contains"] = lambda values, value: value in values
    digests = {}  # of scripts, as the Content-Security-Policy of the page wants them
    for name in page.scripts:
        script = (TEMPLATES / name).read_text(encoding="utf-8")
        digests[script] = base64_text(hashlib.sha256(script.encode()).digest())
    content = {
        **page.content,
        "inlier_matrix": page.inlier_matrix,
        "inlier_colors": INLIER_COLORS,
        "style": (TEMPLATES / "page.css").read_text(encoding="utf-8"),
        "scripts": digests,
        "reads_files": page.reads_files,
        "made_from": page.made_from,
        "script_data": _script_data(page),
        "thumbnails": (
            thumbnails(page.image_path, page.names, progress) if page.image_path else {}
        ),
    }
    replace_text(path, environment.get_template(page.template.name).render(content))
    return path


def _script_data(page: Page) -> dict[str, Any]:
    """Return what the scripts of a page read, as JSON has it."""
    index = {name: number for number, name in enumerate(page.names)}
    return {
        "names": list(map(shown, page.names)),
        "starts": list(INLIER_COLORS),
        "colors": list(INLIER_COLORS.values()),
        "matrix": page.inlier_matrix,
        "views": [view.script_data(index) for view in page.views],
        **page.script_data,
    }


def without_folders(text: str, folders: Iterable[str] = ()) -> str:
    r"""Shorten paths of this machine to their last part, and those in known folders less.

    Args:
        text: with paths in it.
        folders: of which only what is below them stays, with a separator at the end.

    >>> without_folders(r"/home/me/a.jpg: damaged, see C:\x\b.txt and c/d.jpg or 1/2")
    'a.jpg: damaged, see b.txt and c/d.jpg or 1/2'
    """
    for folder in folders:
        text = text.replace(folder, "")
    return FOLDERS.sub("", text)
