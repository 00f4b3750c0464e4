"""Pages of the documentation that lie outside docs/: README.md is its index."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

OUTSIDE = {"README.md": "index.md", "BENCHMARKS.md": "BENCHMARKS.md",
           "ARCHITECTURE.md": "ARCHITECTURE.md"}  # fmt: skip


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, with the links of a file that lies in docs/."""
    for source, target in OUTSIDE.items():
        text = Path(config.config_file_path).with_name(source).read_text(encoding="utf-8")
        files.append(File.generated(config, target, content=text.replace("](docs/", "](")))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Make links to the pages that lie one folder higher in the repository."""
    for source, target in OUTSIDE.items():
        markdown = markdown.replace(f"](../{source}", f"]({target}")
    return markdown
