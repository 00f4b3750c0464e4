"""What is known of finished models, kept beside them: COLMAP's files cannot hold it all."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from colmap_affrect.colmap.model_files import SUMMARY, file_digests, require_intact
from colmap_affrect.errors import DAMAGE, StoreError, made_again
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.contents import with_checksum, without_checksum
from colmap_affrect.project.report import ModelSummary


@dataclass(frozen=True)
class _Kept:
    """The content of the file."""

    model: dict[str, str] | str
    """Digests of the files of the model by name, or one of all of an older version."""
    summary: ModelSummary


_KEPT = TypeAdapter(_Kept)


def write_summary(summary: ModelSummary, folder: Path) -> None:
    """Keep the summary of the model in a folder."""
    text = _KEPT.dump_json(_Kept(file_digests(folder), summary), indent=2).decode()
    replace_text(folder / SUMMARY, with_checksum(text))


def read_summary(folder: Path) -> ModelSummary | None:
    """Return the summary of the model in a folder, None if there is none or it is damaged.

    StoreError if the model is damaged, or not the one that the summary is of.
    """
    require_intact(folder)
    with suppress(*DAMAGE):
        return _KEPT.validate_json(without_checksum((folder / SUMMARY).read_bytes())).summary
    return None


def model_folders(sparse_path: Path) -> list[Path]:
    """Return the folders of the models that mapping has written, 0, 1, ..."""
    folders = sparse_path.iterdir() if sparse_path.is_dir() else ()
    return sorted((p for p in folders if p.name.isdecimal()), key=lambda p: int(p.name))


def refuse_edited(sparse_path: Path) -> None:
    """Refuse to replace models that are not as they were written; StoreError names the first."""
    for folder in model_folders(sparse_path):
        if not read_summary(folder):
            raise StoreError(
                f"{folder}: may have been edited (it has no {SUMMARY}, or a damaged one) and would "
                "be replaced; if you need it copy it to a folder of its own, then "
                f"{made_again('map', sparse_path.parent)}"
            )
