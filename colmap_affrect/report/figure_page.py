"""A picture filled from its top downwards, whose parts are placed in px."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.transforms import Bbox

from colmap_affrect.report.regions import Size

DPI = 100
WIDTH_PX = 1800
MARGIN_PX = 24
INNER_PX = WIDTH_PX - 2 * MARGIN_PX
HEAD_PX = 50
"""Title and caption of a section."""
FONT_PT, TITLE_PT = 9.0, 12.0
DARK = "#555555"

TILE_TITLE_PX = 36
TILE_GAP_PX = 14
MIN_TILE_WIDTH_PX = 190
MAX_TILE_WIDTH_PX = (INNER_PX - TILE_GAP_PX) // 2
MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX = 72, 440
ALL_TILES_PX = INNER_PX * 550
"""Area of all warps as they are shown, nearly."""

STYLE: list[str | dict[str, Any]] = [
    "default",
    {"font.family": "DejaVu Sans", "font.size": FONT_PT, "text.parse_math": False},
]


class FigurePage:
    """A figure that is filled from its top downwards; places are px from its top left corner.

    Attributes:
        figure: of any height; what is drawn lies below its top edge, also beyond its bottom.
        top: where the next section begins.
    """

    def __init__(self) -> None:
        self.figure = Figure(figsize=(WIDTH_PX / DPI, 1.0), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        self.top = MARGIN_PX

    def axes(self, left: float, top: float, size: Size) -> Axes:
        """Add axes without frame and ticks."""
        width, height = size
        bottom = 1.0 - (top + height) / DPI
        axes = self.figure.add_axes((left / WIDTH_PX, bottom, width / WIDTH_PX, height / DPI))
        axes.set_axis_off()
        return axes

    def text(self, left: float, top: float, text: str, **style: Any) -> None:
        """Write a line whose top left corner is given."""
        self.figure.text(left / WIDTH_PX, 1.0 - top / DPI, printable(text), va="top", **style)

    def heading(self, left: float, title: str, caption: str) -> None:
        """Write a title and, below it, how to read what follows; ``HEAD_PX`` high."""
        self.text(left, self.top, title, fontsize=TITLE_PT, weight="bold")
        self.text(left, self.top + 24, caption, color=DARK)


@contextmanager
def figure_page(path: Path) -> Iterator[FigurePage]:
    """Fill a page in the block; then what was drawn is written as PNG, ``WIDTH_PX`` wide."""
    with matplotlib.style.context(STYLE):
        page = FigurePage()
        yield page
        drawn = Bbox([[0.0, 1.0 - page.top / DPI], [WIDTH_PX / DPI, 1.0]])
        page.figure.savefig(path, format="png", bbox_inches=drawn)


def printable(text: str) -> str:
    """Replace the characters that the font of the sheets has no glyph for."""
    font = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return "".join(
        character if font.get_char_index(ord(character)) else "\N{REPLACEMENT CHARACTER}"
        for character in text
    )


def fitted(size: Size, box: Size) -> Size:
    """Scale (width, height) so that it just fits into a box."""
    scale = min(box[0] / size[0], box[1] / size[1])
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


Tile = tuple[int, int, Size]
"""Left, top and size of a picture in px, from the upper left corner of all."""


def tiles(sizes: Sequence[Size]) -> list[Tile]:
    """Place pictures of (width, height) in rows of ``INNER_PX``, large ones first.

    All have the same scale, so that they fill ``ALL_TILES_PX``, but none is lower than
    ``MIN_TILE_HEIGHT_PX``, higher than ``MAX_TILE_HEIGHT_PX`` or wider than half a row. A title
    has room above each.
    """
    scale = np.sqrt(ALL_TILES_PX / sum(width * height for width, height in sizes))
    heights = [np.clip(scale * h, MIN_TILE_HEIGHT_PX, MAX_TILE_HEIGHT_PX) for _, h in sizes]
    shown = [
        fitted(size, (MAX_TILE_WIDTH_PX, round(height)))
        for size, height in zip(sizes, heights, strict=True)
    ]
    placed: dict[int, Tile] = {}
    left = top = row_height = 0
    for index in sorted(range(len(sizes)), key=lambda index: -shown[index][1]):
        width = max(shown[index][0], MIN_TILE_WIDTH_PX)
        if left + width > INNER_PX:
            left, top = 0, top + TILE_TITLE_PX + row_height + TILE_GAP_PX
        row_height = shown[index][1] if left == 0 else row_height
        placed[index] = (left, top + TILE_TITLE_PX, shown[index])
        left += width + TILE_GAP_PX
    return [placed[index] for index in range(len(sizes))]


def ranges(numbers: Sequence[int], max_num: int) -> str:
    """Write rising numbers as ranges, the first ``max_num`` of them.

    >>> ranges([1, 2, 3, 5, 8, 9], 2)
    '1-3, 5 ...'
    """
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    texts = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]
    return ", ".join(texts[:max_num]) + " ..." * (len(texts) > max_num)
