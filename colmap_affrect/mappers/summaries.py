"""What is known of a finished model, kept beside it: COLMAP's files cannot hold it all."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from colmap_affrect.colmap.model_files import RECORDS
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary

FILE_NAME = "summary.json"
"""Beside cameras.bin; other programs ignore it."""


@dataclass(frozen=True)
class _Kept:
    """The content of the file."""

    model: str
    """Digest of the files of the model."""
    summary: ModelSummary


_KEPT = TypeAdapter(_Kept)


def write_summary(summary: ModelSummary, folder: Path) -> None:
    """Keep the summary of the model in a folder."""
    text = _KEPT.dump_json(_Kept(_digest(folder), summary), indent=2).decode()
    replace_text(folder / FILE_NAME, text + "\n")


def read_summary(folder: Path, *, of_any: bool = False) -> ModelSummary | None:
    """Return the summary in a folder; None if damaged or, unless ``of_any``, of another model."""
    try:
        kept = _KEPT.validate_json((folder / FILE_NAME).read_bytes())
        return kept.summary if of_any or kept.model == _digest(folder) else None
    except (OSError, ValidationError):
        return None


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in sorted(RECORDS):
        with (folder / name).open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
