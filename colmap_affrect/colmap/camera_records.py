"""What is known of the cameras of a run, and from where: ``cameras.json`` beside the database.

COLMAP's database has one flag for a focal length, that somebody knows it. Here is who.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from colmap_affrect.errors import WorkspaceError
from colmap_affrect.project.atomic_files import replace_text

Source = Literal["given", "exif", "exif-rescaled", "pairs", "guess"]
"""By the user; by EXIF as it is, or scaled to a photograph that was shrunk; by the votes of
verified pairs; or COLMAP's usual guess."""

TRUSTED: tuple[Source, ...] = ("given", "exif", "exif-rescaled")
"""Sources whose focal lengths are priors before any pair has been verified."""

MAX_LINES = 5
"""Cameras that are logged one by one."""

MAX_NAMES = 3
"""Images that are named of a camera."""


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
        is_fixed: intrinsics are the user's and complete, to be left as they are.
    """

    names: tuple[str, ...]
    source: Source
    focal_px: float
    low_px: float | None = None
    high_px: float | None = None
    why: str = ""
    size: tuple[int, int] = (0, 0)
    is_fixed: bool = False

    def to_report(self, camera_id: int) -> dict[str, Any]:
        """Return the entry of ``report.json``."""
        longer = max(self.size)
        has_spread = self.low_px is not None and self.high_px is not None
        return {
            "id": camera_id,
            "num_images": len(self.names),
            "names": list(self.names),
            "source": self.source,
            "focal_px": self.focal_px,
            "focal_longer_sides": self.focal_px / longer if longer else None,
            "spread_px": [self.low_px, self.high_px] if has_spread else None,
            "why": self.why,
        }

    def text(self) -> str:
        """Return one line."""
        names = ", ".join(self.names[:MAX_NAMES])
        more = f" and {len(self.names) - MAX_NAMES} more" if len(self.names) > MAX_NAMES else ""
        spread = (
            f" ({self.low_px:.0f} to {self.high_px:.0f})" if self.low_px and self.high_px else ""
        )
        return f"{names}{more}: focal {self.focal_px:.0f} px{spread}, {self.source}; {self.why}"


def read_camera_records(path: Path) -> dict[int, CameraRecord]:
    """Return the records by camera id of the database; none where there is no file.

    Raises:
        WorkspaceError: when the file is damaged.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {int(key): _from_mapping(values) for key, values in content.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise WorkspaceError(f"{path}: damaged ({error}); remove it") from error


def _from_mapping(values: Mapping[str, Any]) -> CameraRecord:
    width, height = values["size"]
    return CameraRecord(**{**values, "names": tuple(values["names"]), "size": (width, height)})


def write_camera_records(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Replace the file as a whole."""
    content = {str(key): asdict(records[key]) for key in sorted(records)}
    replace_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def notable_lines(records: Iterable[CameraRecord]) -> list[str]:
    """Return a line for each camera that is not just as EXIF or the user has it, at most a few."""
    texts = [record.text() for record in records if record.why and record.source != "given"]
    more = len(texts) - MAX_LINES
    return texts if more <= 1 else [*texts[:MAX_LINES], f"and {more} cameras more"]
