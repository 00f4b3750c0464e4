"""What a person has drawn on the page of a run, checked and kept below the output folder."""

import base64
import binascii
import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.errors import OptionError
from colmap_affrect.project.atomic_files import replace_bytes, replace_text
from colmap_affrect.project.outputs import refuse_link
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.workspace import Workspace

COLUMNS = ("point", "photograph", "x", "y")
MAX_NUM_LETTERS = 200  # of the name of a tie point; resource


@dataclass(frozen=True)
class Mark:
    """A tie point in a photograph, px from the upper left corner."""

    point: str
    photograph: str
    x: float
    y: float


@dataclass(frozen=True)
class Drawn:
    """Tie points and masks of a page."""

    marks: Sequence[Mark]
    # PNG by name of the photograph, black where nothing counts
    masks: Mapping[str, bytes]

    @classmethod
    def of_request(cls, content: Any, names: Collection[str]) -> "Drawn":
        """Check what a browser has sent.

        Args:
            content: as JSON has it: ``marks`` is a list of point, photograph, x and y; ``masks``
                maps names of photographs to PNG in base64.
            names: of all photographs.

        Raises:
            OptionError: something else was sent, or a photograph is not there.
        """
        if not isinstance(content, dict) or not {"marks", "masks"} <= content.keys():
            raise OptionError(
                "the page sent no marks and masks", advice="load it again"
            )
        rows = content["marks"]
        pictures = content["masks"]
        if not (isinstance(rows, list) and isinstance(pictures, dict)):
            raise OptionError(
                "the page sent no marks and masks", advice="load it again"
            )
        marks = []
        for row in rows:
            marks.append(_mark(row, names))
        masks = {}
        for name, text in pictures.items():
            masks[_known(name, names)] = _png(name, text)
        return cls(marks, masks)

    def keep(self, workspace: Workspace, before: ByHand) -> ByHand:
        """Write it below the output folder, in the place of what was drawn before.

        Args:
            workspace: of the run.
            before: what else is said by hand.

        Returns:
            What is said by hand, with the files that were written.
        """
        folder = folder_by_hand(workspace)
        tie_points = folder / "tie-points.csv"
        masks = folder / "masks"
        masks.mkdir(parents=True, exist_ok=True)
        _remove_masks(masks)
        for name, content in self.masks.items():
            path = _mask_path(masks, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_bytes(path, content)
        replace_text(tie_points, self._table())
        return before.changed(
            tie_points_path=tie_points if self.marks else None,
            masks_path=masks if self.masks else None,
        )

    def _table(self) -> str:
        """Return the marks as ``--tie-points`` takes them."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(COLUMNS)
        for mark in self.marks:
            position = [f"{mark.x:.2f}", f"{mark.y:.2f}"]
            writer.writerow([mark.point, mark.photograph, *position])
        return text.getvalue()


FOLDER = "by-hand"
"""Below the output folder: what was drawn on its page."""


def folder_by_hand(workspace: Workspace) -> Path:
    """Return where what was drawn is kept; OptionError where a link leads elsewhere."""
    folder = workspace.path / FOLDER
    for path in (folder, folder / "masks", folder / "before"):
        refuse_link(path)
    return folder


def _mark(row: Any, names: Collection[str]) -> Mark:
    """Return a mark that a browser has sent; OptionError unless it is one."""
    if not (isinstance(row, list) and len(row) == len(COLUMNS)):
        raise OptionError("the page sent a mark without point, photograph, x and y")
    point = row[0]
    is_name = isinstance(point, str) and 0 < len(point) <= MAX_NUM_LETTERS
    if not (is_name and point.isprintable()):
        raise OptionError("give it a short name", where=f"point {point!r:.50}")
    position = []
    for value in row[2:]:
        is_number = isinstance(value, int | float) and math.isfinite(value)
        if not is_number:
            raise OptionError(
                "x and y must be finite numbers of px", where=f"point {point}"
            )
        position.append(float(value))
    return Mark(point, _known(row[1], names), *position)


def _known(name: Any, names: Collection[str]) -> str:
    """Return the name of a photograph; OptionError if there is none of it."""
    if not isinstance(name, str) or name not in names:
        raise OptionError(
            "no such photograph", where=f"{name!r:.200}", advice="load the page again"
        )
    return name


def _png(name: str, text: Any) -> bytes:
    """Return a mask that a browser has sent; OptionError unless it is a picture."""
    try:
        content = base64.b64decode(str(text), validate=True)
    except binascii.Error as error:
        raise OptionError(f"the mask of {name} is no picture") from error
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise OptionError(f"the mask of {name} is no picture")
    return content


def _mask_path(folder: Path, name: str) -> Path:
    """Return where the mask of a photograph is kept; OptionError for names that lead out."""
    path = folder / f"{name}.png"
    if not resolved(path).is_relative_to(resolved(folder)):
        raise OptionError("is outside of the folder of the photographs", where=name)
    return path


def _remove_masks(folder: Path) -> None:
    """Remove the masks of before."""
    for path in sorted(folder.rglob("*.png")):
        path.unlink()
