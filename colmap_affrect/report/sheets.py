"""Sheets to look at: rows of panels, each an image under a title."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import cv2
import numpy as np

from colmap_affrect.data import ColorImage, LocalFeatures
from colmap_affrect.geometry.affine import project, transform_lafs
from colmap_affrect.geometry.arrays import Array, Bytes
from colmap_affrect.geometry.conventions import (
    MEASUREMENT_SIGMAS,
    resized_from_original,
)

Color = tuple[int, int, int]  # red, green, blue
Point = tuple[float, float]  # x, y, px

PALETTE: Sequence[str] = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#882255",
)  # fmt: skip
"""Okabe and Ito's colours for all kinds of colour vision, and one of Paul Tol's."""

# Sizes were chosen by eye, so that a sheet can be read on a screen of full HD.
WIDTH_PX = 1596  # of a sheet
TITLE_PX = 24  # height of a title
MARGIN_PX = 4  # between panels
TITLE_BASELINE_PX = 8  # of the text of a title, above the panel
FONT_SCALE = 0.4  # of OpenCV's Hershey Simplex, whose capitals are 21 px high at 1
FEATURE_SIGMAS = 2.0  # radius of the ellipses drawn for features, in Gaussian sigmas
NUM_OUTLINE_POINTS = 25  # of an ellipse


@dataclass(frozen=True)
class Panel:
    """An image that was resized for a sheet, and its title."""

    image: ColorImage
    title: str = ""
    # (3, 3) map of pixel-centre px; the identity for one that was not resized
    panel_from_image: Array = field(default_factory=lambda: np.eye(3))

    @classmethod
    def fit(cls, image: Bytes, per_row: int, title: str = "") -> Self:
        """Resize an image to the largest size that fits into a row.

        Args:
            image: (H, W) or (H, W, 3) uint8.
            per_row: number of panels in a row of the sheet.
            title: text above the panel.
        """
        side_px = WIDTH_PX // per_row - MARGIN_PX
        height, width = image.shape[:2]
        scale = side_px / max(width, height)
        panel_width = max(1, round(scale * width))
        panel_height = max(1, round(scale * height))
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        resized = cv2.resize(
            image, (panel_width, panel_height), interpolation=interpolation
        )
        panel: ColorImage = np.empty((panel_height, panel_width, 3), np.uint8)
        panel[:] = resized.reshape(panel_height, panel_width, -1)
        panel_from_image = resized_from_original(
            (width, height), (panel_width, panel_height)
        )
        return cls(panel, title, panel_from_image)

    def draw_features(
        self, features: LocalFeatures, colors: Sequence[Color], max_num_features: int
    ) -> None:
        """Draw the strongest features as ellipses.

        Args:
            features: (N,) features, LAFs in px of the image.
            colors: one for each feature.
            max_num_features: number of features that are drawn.
        """
        strongest = np.argsort(-features.responses, kind="stable")[:max_num_features]
        lafs = transform_lafs(self.panel_from_image, features.lafs[strongest])
        angles = np.linspace(0.0, 2.0 * np.pi, NUM_OUTLINE_POINTS)
        unit_circle = np.stack([np.cos(angles), np.sin(angles)])
        offsets = lafs[:, :, :2] @ unit_circle * (FEATURE_SIGMAS / MEASUREMENT_SIGMAS)
        outlines = np.rint(np.swapaxes(offsets + lafs[:, :, 2:], 1, 2)).astype(np.int32)
        for index, outline in zip(strongest.tolist(), outlines, strict=True):
            cv2.polylines(self.image, [outline], True, colors[index], 1, cv2.LINE_AA)

    def draw_labels(self, labels: Mapping[Point, str]) -> None:
        """Draw texts at points of the image, pixel-centre px."""
        for point, text in labels.items():
            in_panel = project(self.panel_from_image, np.array([point]))[0]
            x, y = np.rint(in_panel).astype(int).tolist()
            draw_text(self.image, text, (x, y))


def row_of(panels: Sequence[Panel], per_row: int) -> ColorImage:
    """Return a row of a sheet: panels side by side, each under its title."""
    height = max(len(panel.image) for panel in panels) + TITLE_PX
    row = np.full((height, WIDTH_PX, 3), 255, np.uint8)
    for index, panel in enumerate(panels):
        left = index * WIDTH_PX // per_row
        right = left + panel.image.shape[1]
        row[TITLE_PX : TITLE_PX + len(panel.image), left:right] = panel.image
        draw_text(row, panel.title, (left + MARGIN_PX, TITLE_PX - TITLE_BASELINE_PX))
    return row


def text_row(text: str) -> ColorImage:
    """Return a row of a sheet that has a text and no panel."""
    return row_of([Panel(np.zeros((0, WIDTH_PX, 3), np.uint8), text)], 1)


def draw_text(image: ColorImage, text: str, position: tuple[int, int]) -> None:
    """Draw a text, black with a white outline.

    Args:
        image: (H, W, 3) uint8, changed in place.
        text: one line.
        position: x, y of the left end of the base line, px.
    """
    for gray, thickness in ((255, 3), (0, 1)):
        cv2.putText(
            image,
            text,
            position,
            cv2.FONT_HERSHEY_SIMPLEX,
            FONT_SCALE,
            (gray, gray, gray),
            thickness,
            cv2.LINE_AA,
        )


def encode_png(rows: Sequence[ColorImage]) -> bytes:
    """Return a sheet of rows of equal width as the content of a PNG file."""
    _, data = cv2.imencode(".png", np.concatenate(rows)[:, :, ::-1])
    return data.tobytes()


def rgb(color: str) -> Color:
    """Return red, green and blue of a colour as HTML writes it.

    >>> rgb("#0072B2")
    (0, 114, 178)
    """
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue
