"""What is known of finished models, kept beside them: COLMAP's files cannot hold it all."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from colmap_affrect.colmap.model_files import SUMMARY, file_digests, require_intact
from colmap_affrect.errors import damage, made_again
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary


@dataclass(frozen=True)
class _Kept:
    """The content of the file."""

    model: dict[str, str]
    """Digests of the files of the model by name."""
    summary: ModelSummary


_KEPT = TypeAdapter(_Kept)


def write_summary(summary: ModelSummary, folder: Path) -> None:
    """Keep the summary of the model in a folder."""
    kept = _Kept(file_digests(folder), summary)
    replace_text(folder / SUMMARY, _KEPT.dump_json(kept, indent=2).decode())


def read_summary(folder: Path) -> ModelSummary:
    """Return the summary of the model in a folder.

    StoreError if there is none, or it or the model is damaged: somebody may have edited the model.
    """
    require_intact(folder)
    again = made_again("map", folder.parent.parent)
    mend = f"if you have edited the model, copy it to a folder of its own; then {again}"
    with damage(folder / SUMMARY, mend):
        return _KEPT.validate_json((folder / SUMMARY).read_bytes()).summary


def read_summaries(sparse_path: Path) -> list[ModelSummary]:
    """Return the summaries of the models that mapping has written, in their order."""
    return [read_summary(folder) for folder in model_folders(sparse_path)]


def model_folders(sparse_path: Path) -> list[Path]:
    """Return the folders of the models that mapping has written, 0, 1, ..."""
    folders = sparse_path.iterdir() if sparse_path.is_dir() else ()
    return sorted((p for p in folders if p.name.isdecimal()), key=lambda p: int(p.name))
