"""Make the photographs of a scene look as if they were of different years, light and sensors.

Each photograph in turn stays as it is, becomes a soft gray print, a thermal picture (inverted,
blurred, with colours of its own) or one of evening light. No pixel moves, so that ground truth
stays true; EXIF is gone. Usage:

    python tests/benchmarks/mixed.py SCENE/images OUT/images
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from machine import parser_of
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def as_it_is(picture: Picture, _: np.random.Generator) -> Picture:
    return picture


def print_of(picture: Picture, drawn: np.random.Generator) -> Picture:
    """A soft gray print with grain, and little contrast."""
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float64) / 255
    gray = cv2.GaussianBlur(gray, (0, 0), max(gray.shape) / 1600)
    gray = (
        0.2 + 0.6 * gray ** drawn.uniform(0.7, 1.4) + drawn.normal(0, 0.03, gray.shape)
    )
    return cv2.merge([np.clip(255 * gray, 0, 255).astype(np.uint8)] * 3)


def thermal(picture: Picture, drawn: np.random.Generator) -> Picture:
    """Bright is dark, edges are soft, colours say what is warm."""
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    soft = cv2.GaussianBlur(gray, (0, 0), 2.0 * max(gray.shape) / 1600)
    levels = np.clip(255 - 0.8 * soft + drawn.normal(0, 2, gray.shape), 0, 255)
    return cv2.applyColorMap(levels.astype(np.uint8), cv2.COLORMAP_INFERNO)


def evening(picture: Picture, drawn: np.random.Generator) -> Picture:
    """Low warm light from one side, deep shadows."""
    width = picture.shape[1]
    across = np.linspace(0.3, 1.1, width)[None, :, None]
    across = across if drawn.random() < 0.5 else across[:, ::-1]
    warm = np.array([0.45, 0.75, 1.1])
    lit = 255 * (picture / 255.0) ** 1.8 * across * warm
    return np.clip(lit, 0, 255).astype(np.uint8)


LOOKS: tuple[Callable[[Picture, np.random.Generator], Picture], ...] = (
    as_it_is,
    print_of,
    thermal,
    evening,
)


def main() -> None:
    """Change all photographs of a folder."""
    parser = parser_of(__doc__)
    parser.add_argument("source", type=Path, help="folder of the photographs")
    parser.add_argument("target", type=Path, help="folder for the changed ones")
    arguments = parser.parse_args()
    target = arguments.target
    target.mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(sorted(arguments.source.iterdir())):
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        # Every second photograph has all looks, too.
        turn = number + number // len(LOOKS)
        look = LOOKS[turn % len(LOOKS)]
        changed = look(picture, np.random.default_rng(number))
        cv2.imwrite(
            str(target / f"{path.stem}.jpg"), changed, [cv2.IMWRITE_JPEG_QUALITY, 90]
        )


if __name__ == "__main__":
    main()
