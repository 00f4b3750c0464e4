"""What ``features.h5`` has of each photograph, in short: ``features.json``, all an idle run reads.

Opening thousands of groups takes seconds. The file is derived: it counts while ``features.h5`` has
the size and times that it names, and is left out where it is damaged. Whoever changes
``features.h5`` removes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import TypeAdapter

from colmap_affrect.geometry.lines import LineCamera, LineFindings
from colmap_affrect.project.record import Content
from colmap_affrect.project.sealed_json import read_sealed, write_sealed


class ImageSummary(NamedTuple):
    """What the file of features has of one photograph."""

    content: Content  # of the files that it was extracted from
    num_features: int
    image_size: tuple[int, int]  # width and height in px
    lines: LineFindings | None  # None where none were measured


class _LineRow(NamedTuple):
    num_segments: int
    says_shifted: bool
    # Focal length, shift, each followed by its deviation, nine numbers of the rotation, three of
    # the upright and its deviation; or none
    camera: list[float]


class _Row(NamedTuple):
    content: tuple[str, str]
    num_features: int
    image_size: tuple[int, int]
    lines: _LineRow | None


@dataclass(frozen=True)
class _Table:
    format_version: int
    stamp: str
    images: dict[str, _Row]


TABLE_JSON = TypeAdapter(_Table)
NUM_CAMERA_VALUES = 17  # format
# Counts up when the same features give other summaries, as by other priors of lines; format
FORMAT_VERSION = 2


def summary_path(features_path: Path) -> Path:
    """Return the file of summaries that belongs to a file of features."""
    return features_path.with_suffix(".json")


def read_summaries(features_path: Path, stamp: str) -> dict[str, ImageSummary] | None:
    """Return what is known of each photograph.

    Args:
        features_path: the file of features.
        stamp: its size and times now.

    Returns:
        Summaries by name; None where there is no file, or one that is damaged or of other features.
    """
    expected = (FORMAT_VERSION, stamp)
    try:
        values = read_sealed(summary_path(features_path))
        if (values.get("format_version"), values.get("stamp")) != expected:
            return None
        found = {}
        for name, row in TABLE_JSON.validate_python(values).images.items():
            found[name] = ImageSummary(
                content=Content(*row.content),
                num_features=row.num_features,
                image_size=row.image_size,
                lines=_findings_of(row.lines) if row.lines else None,
            )
    except (OSError, ValueError, RecursionError):
        return None
    return found


def write_summaries(
    features_path: Path, stamp: str, summaries: Mapping[str, ImageSummary]
) -> None:
    """Write what is known of each photograph.

    Args:
        features_path: the file of features.
        stamp: its size and times.
        summaries: by name.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    rows = {}
    for name, summary in summaries.items():
        rows[name] = _Row(
            content=(summary.content.digest, summary.content.stamp),
            num_features=summary.num_features,
            image_size=summary.image_size,
            lines=_line_row(summary.lines) if summary.lines else None,
        )
    content = TABLE_JSON.dump_json(_Table(FORMAT_VERSION, stamp, rows))
    write_sealed(summary_path(features_path), content)


def _line_row(found: LineFindings) -> _LineRow:
    camera = found.camera
    values = list[float]()
    if camera:
        values = [camera.focal, camera.focal_sigma, camera.shift, camera.shift_sigma]
        values += camera.rotation.ravel().tolist()
        values += [*camera.up.tolist(), camera.up_sigma]
    return _LineRow(found.num_segments, found.says_shifted, values)


def _findings_of(row: _LineRow) -> LineFindings:
    """Return what lines say; ValueError where numbers are missing."""
    if not row.camera:
        return LineFindings(row.num_segments, None, row.says_shifted)
    if len(row.camera) != NUM_CAMERA_VALUES:
        raise ValueError(f"a camera of {len(row.camera)} numbers")
    focal, focal_sigma, shift, shift_sigma, *values = row.camera
    rotation = np.array(values[:9]).reshape(3, 3)
    camera = LineCamera(
        focal=focal,
        focal_sigma=focal_sigma,
        shift=shift,
        shift_sigma=shift_sigma,
        rotation=rotation,
        up=np.array(values[9:12]),
        up_sigma=values[12],
    )
    return LineFindings(row.num_segments, camera, row.says_shifted)
