"""What is known of the cameras of a run, and from where: ``cameras.json`` beside the database.

COLMAP's database has one flag for a focal length, that somebody knows it. Here is who.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from colmap_affrect.errors import WorkspaceError, damage, made_again, such_as
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.checked_json import with_checksum, without_checksum
from colmap_affrect.project.report import ModelSummary

Source = Literal["given", "exif", "exif-rescaled", "pairs", "guess"]
"""By the user; by EXIF as it is, or scaled to a photograph that was shrunk; by the votes of
verified pairs; or COLMAP's usual guess."""

Given = Literal["focal", "principal-point", "distortion"]
"""Parts of intrinsics; a model without distortion counts as given once its focal length is."""

TRUSTED: tuple[Source, ...] = ("given", "exif", "exif-rescaled")
"""Sources whose focal lengths are priors before any pair has been verified."""

MAX_LINES = 5  # groups of cameras that are logged


@dataclass(frozen=True)
class CameraRecord:
    """One camera of the database.

    Attributes:
        names: of its images, sorted.
        source: of the focal length.
        focal_px: in px of the stored file; the mean of two.
        low_px: lower end of what the focal length may be, None where nothing says so.
        high_px: upper end.
        why: what was decided and for what reason, one clause.
        size: (width, height) of its images in px.
        given: what of the intrinsics is the user's, to be left as it is.
        may_be_shared: the pairs do not tell whether other such images of this size have the same
            camera.
        is_contradicted: whether the verified pairs contradict a focal length that the user gave;
            None before they have been asked.
    """

    names: tuple[str, ...]
    source: Source
    focal_px: float
    low_px: float | None = None
    high_px: float | None = None
    why: str = ""
    size: tuple[int, int] = (0, 0)
    given: tuple[Given, ...] = ()
    may_be_shared: bool = False
    is_contradicted: bool | None = None

    def to_report(self, camera_id: int, model: ModelSummary | None) -> dict[str, Any]:
        """Return the entry of ``report.json``, with the focal length that a model ended with."""
        longer = max(self.size)
        used = next((name for name in self.names if model and name in model.focals_px), None)
        has_spread = self.low_px is not None and self.high_px is not None
        return {
            "id": camera_id,
            "num_images": len(self.names),
            "names": list(self.names),
            "source": self.source,
            "focal_px": self.focal_px,
            "focal_longer_sides": self.focal_px / longer if longer else None,
            "refined_px": model.focals_px[used] if model and used else None,
            "rival_px": model.rival_focals_px.get(used) if model and used else None,
            "spread_px": [self.low_px, self.high_px] if has_spread else None,
            "why": self.why,
        }

    @property
    def is_fixed(self) -> bool:
        """Whether nothing of the intrinsics that mapping would refine is free."""
        return {"focal", "distortion"} <= set(self.given)


_RECORDS = TypeAdapter(dict[int, CameraRecord])


def read_camera_records(path: Path) -> dict[int, CameraRecord]:
    """Return the records by camera id; none without the file, WorkspaceError if it is damaged."""
    with damage(path, made_again("verify", path.parent), WorkspaceError):
        if not path.exists():
            return {}
        return _RECORDS.validate_json(without_checksum(path.read_bytes()))


def write_camera_records(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Replace the file as a whole."""
    content = _RECORDS.dump_json(dict(sorted(records.items())), indent=1)
    replace_text(path, with_checksum(content.decode()))


def notable_lines(records: Iterable[CameraRecord]) -> list[str]:
    """Return a line for cameras of one source and story, at most a few; none for those without."""
    groups = defaultdict(list)
    for record in records:
        if record.why:
            groups[record.source, record.why].append(record)
    lines = [_line(same) for same in groups.values()]
    more = len(lines) - MAX_LINES
    return lines if more <= 1 else [*lines[:MAX_LINES], f"and {more} more, see report.json"]


def _line(records: Sequence[CameraRecord]) -> str:
    """Say what was decided for cameras of one source and story."""
    names = [name for record in records for name in record.names]
    first, spread = records[0], ""
    if len(records) == 1 and first.low_px and first.high_px:
        spread = f" ({first.low_px:.0f} to {first.high_px:.0f})"
    focals = sorted({round(record.focal_px) for record in records})
    focal = f"{focals[0]}" if len(focals) == 1 else f"{focals[0]} to {focals[-1]}"
    return f"{such_as(names)}: focal length {focal} px{spread}, {first.source}: {first.why}"
