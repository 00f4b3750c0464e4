"""Image pairs with known homographies: the Extreme View Dataset and Oxford's sequences."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SETS = ("evd_sample", "oxford_graf", "oxford_wall")


@dataclass(frozen=True)
class HomographyPair:
    """Two images of one plane.

    Attributes:
        name: name in the tables.
        path1: file of image 1.
        path2: file of image 2.
        truth: (3, 3) image2_from_image1 of pixel-centre px.
    """

    name: str
    path1: Path
    path2: Path
    truth: NDArray[np.float64]


def load_pairs(pairs_path: Path, set_name: str) -> list[HomographyPair]:
    """List the pairs of one of ``SETS``, below the folder of all sets, sorted by name."""
    folder = pairs_path / set_name
    if (folder / "h").is_dir():
        return [
            HomographyPair(
                path.stem,
                folder / "1" / f"{path.stem}.png",
                folder / "2" / f"{path.stem}.png",
                np.loadtxt(path),
            )
            for path in sorted((folder / "h").glob("*.txt"))
        ]
    pairs = []
    for path in sorted(folder.glob("H_*_*_*.txt")):
        _, sequence, first, second = path.stem.split("_")
        path1, path2 = (folder / f"{sequence}_{number}.png" for number in (first, second))
        pairs.append(HomographyPair(f"{first}-{second}", path1, path2, np.loadtxt(path)))
    return pairs
