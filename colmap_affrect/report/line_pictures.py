"""Straight lines of photographs to look at, and what they say of the cameras."""

import json
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import GrayImage, Mask
from colmap_affrect.errors import ImageError, OptionError, shown
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.conventions import HALF_PIXEL
from colmap_affrect.geometry.lines import DOWN, Explanation, Lines
from colmap_affrect.geometry.vanishing import CHANCE
from colmap_affrect.images import reading
from colmap_affrect.images.lines import lines_of
from colmap_affrect.images.orientation import picture_down
from colmap_affrect.options import Summarized, documented
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.image_failures import (
    ImageFailure,
    failure_of,
    failures_to_mapping,
)
from colmap_affrect.project.line_report import LineReport, line_report
from colmap_affrect.project.outputs import (
    fitting_name,
    new_results,
    refuse_taken_places,
)
from colmap_affrect.project.paths import (
    PathLike,
    as_path,
    as_path_or_none,
    resolved,
)
from colmap_affrect.report.sheets import Color, Panel, encode_png, rgb, row_of, text_row

logger = logging.getLogger(__name__)

UPRIGHT: Color = rgb("#009E73")
LEVEL: tuple[Color, Color] = (rgb("#0072B2"), rgb("#E69F00"))
HORIZON: Color = rgb("#CC79A7")
BY_CHANCE: Color = (150, 150, 150)
LEGEND = "green: upright; blue, orange: level; gray: no direction; pink: horizon"
FADING = 3  # contrast of a photograph under its lines is divided by it
WIDTH_PX = 2  # of lines
FAR = 3.0  # longer sides from the middle, where the horizon is surely outside


@documented
@dataclass(frozen=True)
class LineReports(Summarized):
    """What the straight lines of photographs say of their cameras."""

    photographs: dict[str, LineReport] = field(default_factory=dict)
    """What lines say, by path."""
    failed: dict[str, ImageFailure] = field(default_factory=dict)
    """Why photographs cannot be read, by path."""
    pictures: dict[str, Path] = field(default_factory=dict)
    """What was drawn, by path of the photograph."""

    @property
    def failures(self) -> dict[str, str]:
        """Why photographs cannot be read, in words without their paths."""
        return {name: why.what() for name, why in self.failed.items()}

    def summary(self) -> str:
        """Return a line for each photograph."""
        lines = [
            f"{shown(name)}: {one.sentence()}" for name, one in self.photographs.items()
        ]
        lines += [
            f"{shown(name)}: not read: {why}" for name, why in self.failures.items()
        ]
        lines += [str(path) for path in self.pictures.values()]
        return "\n".join(lines)

    def to_mapping(self) -> dict[str, Any]:
        """Return the content as plain values."""
        return {
            "photographs": {
                name: asdict(one) for name, one in self.photographs.items()
            },
            "failures": self.failures,
            "failed": failures_to_mapping(self.failed),
            "pictures": {name: str(path) for name, path in self.pictures.items()},
        }

    def to_json(self) -> str:
        """Return the same for programs."""
        return json.dumps(self.to_mapping(), indent=2, ensure_ascii=False)


def camera_from_lines(
    image: PathLike | NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> LineReport:
    """Return what the straight lines of a photograph say of its camera.

    Args:
        image: path of a photograph, or its (H, W) gray values or (H, W, 3) colours, uint8.
        mask: (H, W) where lines may be; None: everywhere.

    Returns:
        Focal length, optical axis and upright direction, each with how sure it is.

    Raises:
        ImageError: the photograph cannot be read.
        OptionError: the array is no photograph, or the mask has another size.
    """
    down = DOWN
    if isinstance(image, np.ndarray):
        gray = _gray_values(image)
    else:
        path = as_path(image, "image")
        gray = read_gray(path)
        down = picture_down(path)
    if mask is not None and mask.shape != gray.shape:
        raise OptionError(
            f"has the shape {mask.shape}, and the photograph {gray.shape}", where="mask"
        )
    found = lines_of(gray, mask, down).findings()
    return line_report(found, (gray.shape[1], gray.shape[0]))


@checks_arguments
def report_lines(
    paths: Sequence[PathLike], output_path: PathLike | None = None
) -> LineReports:
    """Measure the straight lines of photographs; what cannot be read is passed over.

    Args:
        paths: of the photographs.
        output_path: folder for a picture of the lines of each photograph; None: none are drawn.
            Where two photographs have one name, pictures stand in the folders of their photographs.

    Returns:
        What the lines say, and why photographs cannot be read.

    Raises:
        OptionError: the paths are none, or a picture is there already, or would lie among
            the photographs; nothing is measured then.
        WorkspaceError: a picture cannot be written.
    """
    folder = as_path_or_none(output_path, "output_path")
    photographs = list(dict.fromkeys(as_path(given, "paths") for given in paths))
    pictures = {} if folder is None else _picture_paths(photographs, folder)
    for path, picture in pictures.items():
        refuse_taken_places(picture, names=[path.name])
    found = LineReports()
    for path in photographs:
        try:
            gray = read_gray(path)
        except ImageError as error:
            logger.warning("%s", error)
            found.failed[str(path)] = failure_of(error)
            continue
        lines = lines_of(gray, down=picture_down(path))
        report = line_report(lines.findings(), (gray.shape[1], gray.shape[0]))
        found.photographs[str(path)] = report
        if path in pictures:
            picture = pictures[path]
            with new_results(picture, names=[path.name]) as (new_picture,):
                new_picture.write_bytes(line_sheet(gray, lines, report))
            found.pictures[str(path)] = picture
    return found


def _picture_paths(photographs: Sequence[Path], folder: Path) -> dict[Path, Path]:
    """Return where the lines of each photograph are drawn: in one folder, if names differ."""
    parents = [resolved(path.parent) for path in photographs]
    names = {path.name for path in photographs}
    is_flat = len(names) == len(photographs)
    found = {}
    for path, parent in zip(photographs, parents, strict=True):
        inner = Path() if is_flat else _below_common(parent, parents)
        found[path] = folder / inner / fitting_name(path.name, "-lines.png")
    return found


def _below_common(parent: Path, parents: Sequence[Path]) -> Path:
    """Return a folder as seen from the one that all of these are in."""
    return parent.relative_to(os.path.commonpath(parents))


def read_gray(path: Path) -> GrayImage:
    """Read a photograph as gray values, faded ones stretched; ImageError where that fails."""
    stored = reading.decode(path)
    return reading.in_eight_bits(stored, reading.tones(stored))


def _gray_values(image: NDArray[Any]) -> GrayImage:
    """Return the gray values of an array; OptionError where it is no photograph."""
    is_photograph = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not is_photograph or not image.size:
        raise OptionError(
            f"is an array of the shape {image.shape} and type {image.dtype}",
            where="image",
            advice="give (H, W) or (H, W, 3) of uint8, or a path",
        )
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8
    )


def line_sheet(
    gray: GrayImage,
    lines: Lines,
    report: LineReport,
    mask: Mask | None = None,
) -> bytes:
    """Draw a photograph with its lines in the colours of their directions, as PNG.

    Args:
        gray: (H, W) of the photograph, of any size.
        lines: of the photograph.
        report: what they say.
        mask: (H, W) where lines were looked for; None: everywhere.
    """
    image = 255 - (255 - gray) // FADING
    if mask is not None:
        image = np.where(mask, image, image // 2)
    panel = Panel.fit(image, 1, LEGEND)
    size = (gray.shape[1], gray.shape[0])
    explanation = lines.explanation()
    ends = np.stack([lines.segments.starts, lines.segments.ends], axis=1)
    colors = _colors(lines, explanation)
    for pair, color in zip(_in_panel(panel, ends, size), colors, strict=True):
        cv2.polylines(panel.image, [pair], False, color, WIDTH_PX, cv2.LINE_AA)
    if explanation is not None and (report.is_known or report.is_shifted):
        horizon = _in_panel(panel, _horizon_ends(explanation)[None], size)[0]
        cv2.polylines(panel.image, [horizon], False, HORIZON, WIDTH_PX, cv2.LINE_AA)
    return encode_png([text_row(report.sentence()), row_of([panel], 1)])


def _colors(lines: Lines, explanation: Explanation | None) -> list[Color]:
    """Return the colour of each segment."""
    if explanation is None:
        return [BY_CHANCE] * len(lines.segments)
    upright = int(np.abs(explanation.rotation @ explanation.up).argmax())
    level = [number for number in range(3) if number != upright]
    by_kind: Mapping[int, Color] = {
        CHANCE: BY_CHANCE,
        upright: UPRIGHT,
        level[0]: LEVEL[0],
        level[1]: LEVEL[1],
    }
    return [by_kind[kind] for kind in explanation.kinds.tolist()]


def _horizon_ends(explanation: Explanation) -> Floats:
    """Return (2, 2) points of the horizon, outside of the image, longer sides from its middle."""
    a, b, c = explanation.horizon
    along = np.array([b, -a]) / np.hypot(a, b)
    nearest = -c * np.array([a, b]) / (a * a + b * b)
    return np.stack([nearest - FAR * along, nearest + FAR * along])


def _in_panel(panel: Panel, points: Floats, size: tuple[int, int]) -> NDArray[np.int32]:
    """Return (N, 2, 2) points, longer sides from the middle of an image, in px of its panel."""
    middle = np.asarray(size) / 2.0 - HALF_PIXEL
    pixels = points.reshape(-1, 2) * max(size) + middle
    in_panel = project(panel.panel_from_image, pixels)
    return np.rint(in_panel).astype(np.int32).reshape(-1, 2, 2)
