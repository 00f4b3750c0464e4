"""Procedural building materials: masonry, plaster, paving, windows, doors, posters and dirt.

Everything is drawn from a seeded ``numpy.random.Generator``. A material is a `Surface`: its colour
(float32 BGR in 0..1), one row or column per ``1 / ppm`` metres, rows running downwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

Array = np.ndarray[Any, Any]
Color = tuple[float, float, float]


@dataclass
class Surface:
    """The painted surface of one plane.

    Attributes:
        color: Float32 BGR colour in 0..1, of shape (height, width, 3).
        ppm: Pixels (texels) per metre.
    """

    color: Array
    ppm: float

    def pixel(self, x: float, y: float) -> tuple[int, int]:
        """Convert a position in metres from the top left into a texel."""
        return round(x * self.ppm), round(y * self.ppm)


def texture_shape(width: float, height: float, ppm: float) -> tuple[int, int]:
    """Return (rows, columns) of the texture of a plane of the given size in metres."""
    return round(height * ppm), round(width * ppm)


def noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float | tuple[float, float],
    gain: float = 0.6,
    finest: float = 1.5,
) -> Array:
    """Sum octaves of smooth random grids into 1/f-like noise of zero mean and unit deviation.

    Args:
        rng: The source of randomness.
        shape: Rows and columns of the result.
        cell: Size in texels of the coarsest blobs, or (vertical, horizontal) sizes.
        gain: Amplitude of an octave relative to the one before it.
        finest: Stop before blobs get smaller than this many texels.

    Returns:
        A float32 array of the given shape.
    """
    rows, cols = shape
    cell_y, cell_x = cell if isinstance(cell, tuple) else (cell, cell)
    total = np.zeros(shape, np.float32)
    amplitude = 1.0
    while min(cell_y, cell_x) >= finest:
        grid_shape = (int(rows / cell_y) + 4, int(cols / cell_x) + 4)
        grid = rng.standard_normal(grid_shape).astype(np.float32)
        size = (round(grid_shape[1] * cell_x), round(grid_shape[0] * cell_y))
        octave = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
        top, left = int(cell_y), int(cell_x)
        total += amplitude * octave[top : top + rows, left : left + cols]
        amplitude *= gain
        cell_y, cell_x = cell_y / 2, cell_x / 2
    return np.asarray((total - total.mean()) / (total.std() + 1e-9))


def smoothstep(value: Array, low: float, high: float) -> Array:
    """Rise smoothly from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def relief_shading(height: Array, strength: float) -> Array:
    """Return the brightness factor of a bumpy surface lit from the upper left."""
    along_x = cv2.Sobel(height, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    along_y = cv2.Sobel(height, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    shade = np.clip(1 + strength * (0.7 * along_x + along_y), 0.45, 1.6)
    return np.asarray(shade)[..., None]


def _cuts(rng: np.random.Generator, length: float, low: float, high: float) -> Array:
    """Cut a length into pieces of random sizes and return the borders."""
    sizes = rng.uniform(low, high, int(length / low) + 2)
    borders = np.concatenate([[0.0], np.cumsum(sizes)]) - rng.uniform(0, low)
    return borders[: int(np.searchsorted(borders, length)) + 1]


def _courses(
    rng: np.random.Generator,
    shape: tuple[int, int],
    ppm: float,
    course: tuple[float, float],
    stone: tuple[float, float],
) -> tuple[Array, Array]:
    """Lay courses of rectangular stones; return labels and distances (metres) to the joints."""
    rows, cols = shape
    labels = np.zeros(shape, np.int32)
    distance = np.zeros(shape, np.float32)
    xs = (np.arange(cols) + 0.5) / ppm
    ys = (np.arange(rows) + 0.5) / ppm
    tops = _cuts(rng, rows / ppm, *course)
    for row, (top, bottom) in enumerate(itertools.pairwise(tops)):
        inside = np.flatnonzero((ys >= top) & (ys < bottom))
        if not len(inside):
            continue
        borders = _cuts(rng, cols / ppm, *stone)
        index = np.clip(np.searchsorted(borders, xs, "right") - 1, 0, len(borders) - 2)
        across = np.minimum(xs - borders[index], borders[index + 1] - xs)
        up = np.minimum(ys[inside] - top, bottom - ys[inside])
        span = slice(inside[0], inside[-1] + 1)
        labels[span] = row * 1000 + index
        distance[span] = np.minimum(across[None, :], up[:, None])
    return labels, distance


def _flagstones(
    rng: np.random.Generator, shape: tuple[int, int], ppm: float, size: float
) -> tuple[Array, Array]:
    """Lay irregular polygonal slabs; return labels and distances (metres) to the joints."""
    rows, cols = shape
    step = size * ppm
    grid_y, grid_x = np.mgrid[step / 2 : rows : step, step / 2 : cols : step]
    jitter = rng.uniform(-0.42, 0.42, (2, *grid_x.shape)) * step
    seeds = np.ones(shape, np.uint8)
    seed_y = np.clip(grid_y + jitter[0], 0, rows - 1).astype(int)
    seed_x = np.clip(grid_x + jitter[1], 0, cols - 1).astype(int)
    seeds[seed_y, seed_x] = 0
    _, labels = cv2.distanceTransformWithLabels(
        seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP
    )
    low = cv2.erode(labels.astype(np.float32), np.ones((3, 3), np.uint8))
    joints = (low == labels).astype(np.uint8)
    distance = cv2.distanceTransform(joints, cv2.DIST_L2, 5) / ppm
    return labels.astype(np.int32), distance.astype(np.float32)


def masonry(
    rng: np.random.Generator,
    shape: tuple[int, int],
    ppm: float,
    palette: Sequence[Color],
    *,
    course: tuple[float, float] = (0.22, 0.4),
    stone: tuple[float, float] = (0.3, 0.8),
    joint: float = 0.008,
    joint_color: Color = (0.55, 0.6, 0.63),
    flagstones: float = 0.0,
    variation: float = 0.1,
) -> Surface:
    """Build stonework, brickwork or paving, every stone with its own tone and grain.

    Args:
        rng: The source of randomness.
        shape: Rows and columns of the texture.
        ppm: Texels per metre.
        palette: Colours the stones are drawn from.
        course: Smallest and largest height of a course in metres.
        stone: Smallest and largest length of a stone in metres.
        joint: Half the width of a joint in metres.
        joint_color: Colour of the mortar.
        flagstones: Lay polygonal slabs of this size in metres instead of courses.
        variation: Deviation of the brightness from stone to stone.

    Returns:
        The surface.
    """
    if flagstones:
        labels, distance = _flagstones(rng, shape, ppm, flagstones)
    else:
        labels, distance = _courses(rng, shape, ppm, course, stone)
    wobble_x = (noise(rng, shape, 0.25 * ppm) * 0.005 * ppm).astype(np.float32)
    wobble_y = (noise(rng, shape, 0.25 * ppm) * 0.005 * ppm).astype(np.float32)
    map_y, map_x = np.indices(shape, dtype=np.float32)
    maps = (map_x + wobble_x, map_y + wobble_y)
    distance = cv2.remap(
        distance, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    labels = cv2.remap(
        labels.astype(np.float32),
        *maps,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.int32)

    count = int(labels.max()) + 1
    tones: Array = np.asarray(palette, np.float32)[rng.integers(0, len(palette), count)]
    colors = tones * (1 + variation * rng.standard_normal((count, 1)))
    colors = colors + 0.011 * rng.standard_normal((count, 3))
    slopes = rng.normal(0, 0.6, (count, 2)).astype(np.float32)
    grain = noise(rng, shape, 0.12 * ppm, gain=0.75)
    blotches = noise(rng, shape, 0.5 * ppm, gain=0.6)
    chips = 0.006 * noise(rng, shape, 0.06 * ppm)
    solid = smoothstep(distance + chips, joint * 0.6, joint * 1.8)[..., None]
    tilt = slopes[labels, 0] * np.sin(map_x / (0.2 * ppm)) + slopes[labels, 1]
    face = colors[labels].astype(np.float32)
    face *= 1 + (0.055 * grain + 0.07 * blotches + 0.03 * tilt)[..., None]
    mortar = np.asarray(joint_color, np.float32) * (1 + 0.1 * grain[..., None])
    height = smoothstep(distance + chips, 0, joint * 3) * 2.0 + 0.35 * grain
    color = (mortar + solid * (face - mortar)) * relief_shading(height, 0.55)
    return Surface(np.clip(color, 0, 1).astype(np.float32), ppm)


def plaster(
    rng: np.random.Generator,
    under: Surface,
    base: Color,
    *,
    fallen: float = 1.2,
    cracks: int = 14,
) -> Surface:
    """Plaster a surface: stained, cracked, and fallen off in places.

    Args:
        rng: The source of randomness.
        under: What shows where the plaster has fallen off.
        base: Colour of the plaster.
        fallen: Noise level above which the plaster is gone (lower: more is gone).
        cracks: Number of cracks.

    Returns:
        The plastered surface.
    """
    ppm = under.ppm
    shape = under.color.shape[:2]
    cloud = noise(rng, shape, 1.6 * ppm, gain=0.65)
    fine = noise(rng, shape, 0.1 * ppm, gain=0.85)
    tint = noise(rng, shape, 0.8 * ppm)[..., None] * np.array(
        [0.03, 0.008, -0.02], np.float32
    )
    coat = (
        np.asarray(base, np.float32) * (1 + (0.07 * cloud + 0.022 * fine)[..., None])
        + tint
    )
    repair = smoothstep(noise(rng, shape, 1.2 * ppm, gain=0.5), 1.25, 1.32)[..., None]
    coat = coat * (1 - repair * np.array([0.12, 0.14, 0.16], np.float32))
    edge = noise(rng, shape, 1.3 * ppm, gain=0.62)
    gone = smoothstep(edge, fallen, fallen + 0.035)
    shade = relief_shading(-2.5 * smoothstep(edge, fallen - 0.05, fallen + 0.08), 1.2)
    color = (coat + gone[..., None] * (0.85 * under.color - coat)) * shade
    color = color * (1 - 0.55 * _cracks(rng, shape, ppm, cracks)[..., None])
    return Surface(np.clip(color, 0, 1).astype(np.float32), ppm)


def _cracks(
    rng: np.random.Generator, shape: tuple[int, int], ppm: float, count: int
) -> Array:
    """Draw random walks with branches; return their opacity in 0..1."""
    canvas = np.zeros(shape, np.uint8)
    for _ in range(count):
        walks = [
            (
                rng.uniform(0, shape[1]),
                rng.uniform(0, shape[0]),
                rng.uniform(0, 2 * np.pi),
            )
        ]
        for branch in range(3):
            if branch >= len(walks):
                break
            x, y, heading = walks[branch]
            for _ in range(int(rng.integers(15, 45))):
                heading += rng.normal(0, 0.35)
                step = rng.uniform(0.02, 0.06) * ppm
                end_x, end_y = x + step * np.cos(heading), y + step * np.sin(heading)
                cv2.line(
                    canvas,
                    (int(x * 16), int(y * 16)),
                    (int(end_x * 16), int(end_y * 16)),
                    255 if branch == 0 else 170,
                    2 if branch == 0 else 1,
                    cv2.LINE_AA,
                    4,
                )
                x, y = end_x, end_y
                if rng.random() < 0.04:
                    walks.append((x, y, heading + rng.choice([-0.9, 0.9])))
    return canvas.astype(np.float32) / 255


def weather(rng: np.random.Generator, surface: Surface, *, rising: float = 0.5) -> None:
    """Add rain streaks from above, damp rising from below, lichen and speckles, in place.

    Args:
        rng: The source of randomness.
        surface: The surface to weather.
        rising: Strength of the dark damp zone at the foot of the surface.
    """
    shape = surface.color.shape[:2]
    ppm = surface.ppm
    metres = (np.arange(shape[0], dtype=np.float32) / ppm)[:, None]
    streaks = smoothstep(noise(rng, shape, (2.0 * ppm, 0.12 * ppm), gain=0.7), 0.5, 2.4)
    fade = 0.35 + 0.65 * np.exp(-metres / 1.5)
    height = metres[-1] - metres + 0.25 * noise(rng, shape, 0.7 * ppm)
    damp = rising * (1 - smoothstep(height, 0.1, 0.9))
    color = surface.color * (1 - 0.42 * fade * streaks - 0.5 * damp)[..., None]
    lichen = smoothstep(noise(rng, shape, 0.5 * ppm, gain=0.8), 1.9, 2.5)[..., None]
    color += 0.5 * lichen * (np.array([0.25, 0.42, 0.45], np.float32) - color)
    color *= 1 + 0.03 * noise(rng, shape, 5, gain=0.8)[..., None]
    np.clip(color, 0, 1, out=surface.color)


class Painter:
    """Paints things onto a surface with anti-aliased edges and a worn, uneven coat.

    Args:
        rng: The source of randomness.
        surface: The surface to paint on; changed by `finish`.
    """

    def __init__(self, rng: np.random.Generator, surface: Surface) -> None:
        """Start with nothing painted."""
        self.rng = rng
        self.surface = surface
        self.canvas = (surface.color * 255).astype(np.uint8)

    def tone(self, color: Color, spread: float = 0.08) -> Color:
        """Vary a colour (0..1) randomly and scale it to 0..255."""
        b, g, r = np.clip(
            np.asarray(color) * (1 + spread * self.rng.standard_normal()), 0, 1
        )
        return float(b * 255), float(g * 255), float(r * 255)

    def polygon(self, points: Sequence[tuple[float, float]], color: Color) -> None:
        """Fill a polygon given in metres."""
        corners = np.round(np.asarray(points) * self.surface.ppm * 16).astype(np.int32)
        cv2.fillPoly(self.canvas, [corners], color, cv2.LINE_AA, 4)

    def box(self, x0: float, y0: float, x1: float, y1: float, color: Color) -> None:
        """Fill an upright rectangle given in metres."""
        self.polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], color)

    def line(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        color: Color,
        width: float,
    ) -> None:
        """Draw a line with a width in metres."""
        cv2.line(
            self.canvas,
            self.surface.pixel(*start),
            self.surface.pixel(*end),
            color,
            max(1, round(width * self.surface.ppm)),
            cv2.LINE_AA,
        )

    def disc(self, x: float, y: float, radius: float, color: Color) -> None:
        """Fill a circle given in metres."""
        cv2.circle(
            self.canvas,
            self.surface.pixel(x, y),
            round(radius * self.surface.ppm),
            color,
            -1,
            cv2.LINE_AA,
        )

    def text(self, text: str, x: float, y: float, height: float, color: Color) -> None:
        """Write text with its baseline at (x, y) in metres."""
        fonts = (
            cv2.FONT_HERSHEY_TRIPLEX,
            cv2.FONT_HERSHEY_DUPLEX,
            cv2.FONT_HERSHEY_COMPLEX,
        )
        font = fonts[int(self.rng.integers(len(fonts)))]
        size = height * self.surface.ppm
        cv2.putText(
            self.canvas,
            text,
            self.surface.pixel(x, y),
            font,
            size / 22,
            color,
            max(1, round(size / 11)),
            cv2.LINE_AA,
        )

    def finish(self, wear: float = 0.12) -> None:
        """Move the paint onto the surface, keeping some of the texture below it."""
        shape = self.canvas.shape[:2]
        ppm = self.surface.ppm
        before = self.surface.color
        after = self.canvas.astype(np.float32) / 255
        changed = np.abs(after - before).max(axis=2, keepdims=True) > 2 / 255
        grain = 1 + 0.05 * noise(self.rng, shape, 0.08 * ppm, gain=0.8)[..., None]
        worn = smoothstep(noise(self.rng, shape, 0.4 * ppm, gain=0.75), 1.5, 2.0)[
            ..., None
        ]
        keep = np.clip(wear + 0.7 * worn, 0, 1)
        painted = after * grain * (1 - keep) + before * keep
        self.surface.color = np.where(changed, np.clip(painted, 0, 1), before).astype(
            np.float32
        )


def rosette(painter: Painter, x: float, y: float, radius: float, color: Color) -> None:
    """Paint a carved rosette: a ring with a random number of petals."""
    rng = painter.rng
    dark = (color[0] * 0.55, color[1] * 0.55, color[2] * 0.55)
    painter.disc(x, y, radius, painter.tone(color))
    painter.disc(x, y, radius * 0.86, painter.tone(dark))
    petals = int(rng.integers(4, 10))
    start = rng.uniform(0, np.pi)
    for petal in range(petals):
        angle = start + 2 * np.pi * petal / petals
        reach = radius * rng.uniform(0.5, 0.6)
        px, py = x + reach * np.cos(angle), y + reach * np.sin(angle)
        painter.disc(
            px, py, radius * rng.uniform(0.16, 0.27), painter.tone(color, 0.12)
        )
        painter.disc(px, py, radius * 0.08, painter.tone(dark))
    painter.disc(x, y, radius * rng.uniform(0.15, 0.3), painter.tone(color))
    painter.disc(x, y, radius * 0.09, painter.tone(dark))


def window(
    painter: Painter,
    x: float,
    y: float,
    width: float,
    height: float,
    stone: Color,
    *,
    arched: bool = False,
) -> None:
    """Paint a window with stone surround, sill, frame, panes and a curtain.

    Args:
        painter: Where to paint.
        x: Centre of the window in metres.
        y: Top of the opening in metres.
        width: Width of the opening in metres.
        height: Height of the opening in metres.
        stone: Colour of the surround.
        arched: Lay an arch with a rosette above the opening.
    """
    rng = painter.rng
    half, jamb = width / 2, 0.17
    for side in (-1, 1):
        top = y
        while top < y + height:
            bottom = min(top + rng.uniform(0.16, 0.34), y + height)
            reach = half + jamb + rng.choice([0.0, 0.09])
            painter.box(
                x + side * half,
                top,
                x + side * reach,
                bottom - 0.012,
                painter.tone(stone, 0.13),
            )
            top = bottom
    _lintel(painter, x, y, half + jamb, stone, arched)
    painter.box(
        x - half - 0.25,
        y + height,
        x + half + 0.25,
        y + height + 0.12,
        painter.tone(stone),
    )
    painter.box(
        x - half - 0.2,
        y + height + 0.12,
        x + half + 0.2,
        y + height + 0.16,
        painter.tone((0.12, 0.13, 0.14)),
    )
    frame = painter.tone((0.28, 0.34, 0.38), 0.3)
    painter.box(x - half, y, x + half, y + height, frame)
    columns, lines = int(rng.integers(2, 4)), int(rng.integers(3, 5))
    pane_w, pane_h = (width - 0.08) / columns, (height - 0.08) / lines
    for column in range(columns):
        for line in range(lines):
            left = x - half + 0.04 + column * pane_w
            top = y + 0.04 + line * pane_h
            glass = painter.tone((0.2, 0.17, 0.14), 0.35)
            painter.box(
                left + 0.02,
                top + 0.02,
                left + pane_w - 0.02,
                top + pane_h - 0.02,
                glass,
            )
            if rng.random() < 0.45:
                drop = rng.uniform(0.3, 0.9)
                painter.polygon(
                    [
                        (left + 0.02, top + 0.02),
                        (left + pane_w - 0.02, top + 0.02),
                        (left + 0.02, top + pane_h * drop),
                    ],
                    painter.tone((0.5, 0.5, 0.48), 0.3),
                )
    painter.box(x - half, y, x + half, y + 0.05, painter.tone((0.08, 0.08, 0.08)))


def _lintel(
    painter: Painter, x: float, y: float, reach: float, stone: Color, arched: bool
) -> None:
    """Paint the stones above an opening, straight or as an arch around a carved field."""
    rng = painter.rng
    if not arched:
        left = x - reach
        while left < x + reach - 0.01:
            right = min(left + rng.uniform(0.14, 0.3), x + reach)
            painter.polygon(
                [
                    (left, y),
                    (right - 0.012, y),
                    (right + (right - x) * 0.12, y - 0.24),
                    (left + (left - x) * 0.12 + 0.012, y - 0.24),
                ],
                painter.tone(stone, 0.14),
            )
            left = right
        return
    borders = np.sort(
        np.concatenate([[np.pi, 2 * np.pi], rng.uniform(np.pi, 2 * np.pi, 9)])
    )
    painter.polygon(
        [
            (x + reach * np.cos(a), y + reach * np.sin(a))
            for a in np.linspace(np.pi, 2 * np.pi, 40)
        ],
        painter.tone(stone, 0.05),
    )
    for start, end in itertools.pairwise(borders):
        angles = np.linspace(start, max(start, end - 0.015), 8)
        outer = [(x + reach * np.cos(a), y + reach * np.sin(a)) for a in angles]
        inner = [
            (x + reach * 0.74 * np.cos(a), y + reach * 0.74 * np.sin(a))
            for a in angles[::-1]
        ]
        painter.polygon(outer + inner, painter.tone(stone, 0.15))
    rosette(painter, x, y - reach * 0.36, reach * 0.31, stone)


def door(
    painter: Painter,
    x: float,
    y: float,
    width: float,
    height: float,
    wood: Color,
    stone: Color,
) -> None:
    """Paint an arched door of uneven planks with iron bands and nails."""
    rng = painter.rng
    half = width / 2
    window_top = y
    for side in (-1, 1):
        top = window_top
        while top < y + height:
            bottom = min(top + rng.uniform(0.2, 0.45), y + height)
            reach = half + 0.2 + rng.choice([0.0, 0.12])
            painter.box(
                x + side * half,
                top,
                x + side * reach,
                bottom - 0.015,
                painter.tone(stone, 0.14),
            )
            top = bottom
    _lintel(painter, x, y, half + 0.2, stone, True)
    left = x - half
    while left < x + half - 0.01:
        right = min(left + rng.uniform(0.09, 0.18), x + half)
        painter.box(left, y, right - 0.01, y + height, painter.tone(wood, 0.18))
        for _ in range(4):
            mark = rng.uniform(left, right - 0.02)
            top = rng.uniform(y, y + height - 0.4)
            painter.line(
                (mark, top),
                (mark + 0.01, top + rng.uniform(0.1, 0.4)),
                painter.tone((0.08, 0.1, 0.12)),
                0.006,
            )
        left = right
    for level in (0.18, 0.8):
        band = y + height * level
        painter.box(
            x - half,
            band,
            x + half * rng.uniform(0.5, 0.9),
            band + 0.07,
            painter.tone((0.1, 0.1, 0.1)),
        )
        for nail in np.arange(x - half + 0.06, x + half * 0.5, 0.11):
            painter.disc(nail, band + 0.035, 0.015, painter.tone((0.4, 0.42, 0.45)))
    painter.disc(
        x + half * 0.7, y + height * 0.52, 0.06, painter.tone((0.15, 0.3, 0.4))
    )


POSTER_WORDS = (
    "CONCERT",
    "MARKT",
    "CIRQUE",
    "REGATTA",
    "TEATRO",
    "EXPO 26",
    "BAZAR",
    "KINO",
    "OPERA",
    "TOMBOLA",
    "JAZZ",
    "FIERA",
    "ROUTE 7",
    "BALLET",
    "ZIRKUS",
    "MUSEUM",
    "LIBRI",
    "TANGO",
)


def poster(
    painter: Painter, x: float, y: float, width: float, height: float, word: str
) -> None:
    """Paint a poster with a headline, random shapes and lines of small print."""
    rng = painter.rng
    paper = tuple(rng.uniform(0.45, 0.92, 3))
    torn = rng.uniform(0, 0.25, 4) * width
    painter.polygon(
        [
            (x + torn[0], y),
            (x + width, y + torn[1] * 0.2),
            (x + width, y + height - torn[2]),
            (x + width - torn[2], y + height),
            (x, y + height - torn[3] * 0.2),
            (x, y + torn[0]),
        ],
        painter.tone(paper),
    )
    for _ in range(int(rng.integers(4, 8))):
        ink = painter.tone(tuple(rng.uniform(0.05, 0.8, 3)))
        cx, cy = x + width * rng.uniform(0.2, 0.8), y + height * rng.uniform(0.35, 0.7)
        size = width * rng.uniform(0.06, 0.2)
        corners = int(rng.integers(3, 12))
        angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
        painter.polygon(
            [(cx + size * np.cos(a), cy + size * np.sin(a)) for a in angles], ink
        )
    ink = painter.tone(tuple(rng.uniform(0.02, 0.35, 3)))
    letter = min(0.22 * height, 1.15 * width / max(len(word), 4))
    painter.text(word, x + 0.06 * width, y + 0.08 * height + letter, letter, ink)
    for line in range(int(rng.integers(2, 5))):
        level = y + height * (0.78 + 0.05 * line)
        left = x + 0.1 * width
        while left < x + 0.85 * width:
            right = left + width * rng.uniform(0.03, 0.16)
            painter.line(
                (left, level), (min(right, x + 0.9 * width), level), ink, 0.012
            )
            left = right + 0.03 * width


def frieze(
    painter: Painter, x0: float, x1: float, y: float, height: float, stone: Color
) -> None:
    """Paint a band of carved panels, each with another ornament."""
    rng = painter.rng
    painter.box(x0, y - 0.06, x1, y, painter.tone(stone, 0.03))
    left = x0
    while left < x1 - 0.05:
        right = min(left + rng.uniform(0.8, 1.5) * height, x1)
        tone = painter.tone(stone, 0.1)
        painter.box(left, y, right - 0.012, y + height, tone)
        middle, centre = (left + right) / 2, y + height / 2
        kind = rng.integers(4)
        dark = painter.tone((stone[0] * 0.5, stone[1] * 0.5, stone[2] * 0.5))
        size = 0.36 * min(height, right - left)
        if kind == 0:
            rosette(painter, middle, centre, size, stone)
        elif kind == 1:
            turns = np.linspace(0, rng.uniform(3, 5) * np.pi, 60)
            radii = size * turns / turns[-1]
            start = rng.uniform(0, 6)
            points = [
                (middle + r * np.cos(t + start), centre + r * np.sin(t + start))
                for t, r in zip(turns, radii, strict=True)
            ]
            for a, b in itertools.pairwise(points):
                painter.line(a, b, dark, 0.02)
        elif kind == 2:
            for _ in range(7):
                x_a, y_a, x_b, y_b = rng.uniform(-size, size, 4)
                painter.line(
                    (middle + x_a, centre + y_a),
                    (middle + x_b, centre + y_b),
                    dark,
                    rng.uniform(0.01, 0.03),
                )
        else:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
            painter.polygon(
                [
                    (middle + size * np.cos(a), centre + size * np.sin(a))
                    for a in angles
                ],
                dark,
            )
            painter.disc(middle, centre, size * 0.3, tone)
        left = right
    painter.box(
        x0,
        y + height,
        x1,
        y + height + 0.04,
        painter.tone((stone[0] * 0.45, stone[1] * 0.45, stone[2] * 0.45)),
    )


def leaves(
    painter: Painter,
    roots: Sequence[tuple[float, float]],
    reach: float,
    count: int,
    base: Color = (0.16, 0.36, 0.22),
) -> None:
    """Grow climbing plants: random walks upwards, thick with leaves.

    Args:
        painter: Where to paint.
        roots: Where the plants start, in metres.
        reach: How far the stems climb, in metres.
        count: Leaves per root.
        base: Colour of the leaves.
    """
    rng = painter.rng
    for root_x, root_y in roots:
        stems = []
        for _ in range(14):
            steps = int(reach / 0.08 * rng.uniform(0.4, 1))
            sideways = np.cumsum(rng.normal(0, 0.05, steps) + rng.normal(0, 0.025))
            upwards = np.cumsum(rng.uniform(0.02, 0.11, steps))
            stems.append(np.stack([root_x + sideways, root_y - upwards], axis=1))
        places = np.concatenate(stems)
        chosen = places[rng.integers(0, len(places), count)] + rng.normal(
            0, 0.06, (count, 2)
        )
        for order, (x, y) in enumerate(chosen):
            depth = 0.45 + 0.75 * order / count
            color = painter.tone(
                (base[0] * depth, base[1] * depth, base[2] * depth), 0.22
            )
            axes = np.round(rng.uniform(0.02, 0.05, 2) * painter.surface.ppm).astype(
                int
            )
            cv2.ellipse(
                painter.canvas,
                painter.surface.pixel(x, y),
                (int(axes[0]), int(axes[1])),
                rng.uniform(0, 180),
                0,
                360,
                color,
                -1,
                cv2.LINE_AA,
            )


def grass(rng: np.random.Generator, shape: tuple[int, int], ppm: float) -> Surface:
    """Build the rough lawn around the courtyard."""
    patches = noise(rng, shape, 3 * ppm, gain=0.7)
    blades = noise(rng, shape, 0.3 * ppm, gain=0.9)
    color = np.array([0.2, 0.36, 0.33], np.float32) * (
        1 + (0.12 * patches + 0.12 * blades)[..., None]
    )
    earth = smoothstep(noise(rng, shape, 2 * ppm, gain=0.7), 0.9, 1.6)[..., None]
    color += 0.7 * earth * (np.array([0.3, 0.38, 0.45], np.float32) - color)
    return Surface(np.clip(color, 0, 1).astype(np.float32), ppm)
