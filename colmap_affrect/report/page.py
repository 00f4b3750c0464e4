"""Pages that need nothing beside them, made from the parts in ``templates`` (home of jinja2)."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.report import match_plots, scene, view_graph
from colmap_affrect.shown import shown

TEMPLATES = Path(__file__).parent / "templates"


def write_page(path: Path, template: Path, content: Mapping[str, Any]) -> Path:
    """Fill a template and write it as one file that loads nothing; return its path.

    The template extends ``base.html`` and may use the macros of ``parts.html``, which say what they
    look for in the content; ``script_data`` of the content is for ``page.js``. Raises
    WorkspaceError when the page cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, TEMPLATES], encoding="utf-8"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: shown(value) if type(value) is str else value,
    )
    environment.tests["contains"] = lambda values, value: value in values
    script = (TEMPLATES / "page.js").read_text(encoding="utf-8")
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    environment.globals |= {
        "graph_constants": view_graph,
        "match_constants": match_plots,
        "scene_constants": scene,
        "script": script,
        "script_digest": base64.b64encode(digest).decode("ascii"),
        "style": (TEMPLATES / "page.css").read_text(encoding="utf-8"),
    }
    replace_text(path, environment.get_template(template.name).render(content))
    return path


def number_text(value: float, digits: int = 1) -> str:
    """Write a number with so many digits after the point, without trailing zeros.

    >>> number_text(3.0), number_text(1234.56), number_text(0.123, 2)
    ('3', '1,234.6', '0.12')
    """
    text = f"{value:,.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
