"""The Extreme View Dataset, and other pairs with homographies in files.

Layouts: ``1/NAME.png``, ``2/NAME.png``, ``h/NAME.txt`` (EVD; any image suffix), and sequences as
Oxford's, ``NAME_1.png``, ``NAME_2.png``, ..., ``H_NAME_1_2.txt``, ... Homographies map pixel-centre
px of image 1 to those of image 2.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.homographies import (
    HomographyProtocol,
    checked_homography,
    true_homography,
)
from colmap_affrect.evaluation.protocol import (
    Dataset,
    EvaluationImage,
    EvaluationPair,
    read_numbers,
    with_truth,
)
from colmap_affrect.images.reading import IMAGE_SUFFIXES
from colmap_affrect.parallel.executor import available_cores, map_ordered

NUM_PAPER_PAIRS = 15


class Evd(HomographyProtocol):
    """Number of pairs with a homography error below 1, 2, 3, 5, 10 and 20 px."""

    name: ClassVar[str] = "evd"

    def load(self, dataset_path: Path) -> Dataset:
        """See :class:`EvaluationProtocol`."""
        is_evd = (dataset_path / "h").is_dir()
        found = _extreme_views(dataset_path) if is_evd else _sequences(dataset_path)
        if not found:
            raise EvaluationError(
                f"{dataset_path}: holds neither 1/NAME.png, 2/NAME.png, h/NAME.txt nor "
                "NAME_1.png, NAME_2.png, H_NAME_1_2.txt"
            )
        dataset = Dataset.united(map_ordered(self._load_pair, found, available_cores()))
        if not is_evd or len(found) >= NUM_PAPER_PAIRS:
            return dataset
        note = f"{len(found)} pairs; the dataset of the paper has {NUM_PAPER_PAIRS}"
        return Dataset(dataset.pairs, (note, *dataset.notes))

    def _load_pair(self, found: tuple[EvaluationPair, Path]) -> Dataset:
        pair, homography_path = found
        paths = [image.path for image in pair.images]

        def read(pair: EvaluationPair) -> EvaluationPair:
            values = read_numbers(homography_path)
            matrix = checked_homography(values, f"{homography_path}: homography")
            return replace(pair, truth=true_homography(matrix, paths))

        return with_truth(pair, [*paths, homography_path], read)


def _extreme_views(folder: Path) -> list[tuple[EvaluationPair, Path]]:
    """List the pairs of all names that one of the folders 1, 2 and h has, with the homographies."""
    names = {path.stem for path in (folder / "h").glob("*.txt")}
    for part in ("1", "2"):
        names |= {p.stem for p in (folder / part).glob("*") if p.suffix.lower() in IMAGE_SUFFIXES}
    found = []
    for name in sorted(names):
        images = _image(folder, f"1/{name}"), _image(folder, f"2/{name}")
        found.append((EvaluationPair(name, images), folder / "h" / f"{name}.txt"))
    return found


def _sequences(folder: Path) -> list[tuple[EvaluationPair, Path]]:
    found = []
    for path in sorted(folder.glob("H_*.txt")):
        if parts := re.fullmatch(r"H_(.+)_([^_]+)_([^_]+)", path.stem):
            sequence, first, second = parts.groups()
            images = _image(folder, f"{sequence}_{first}"), _image(folder, f"{sequence}_{second}")
            found.append((EvaluationPair(f"{sequence} {first}-{second}", images), path))
    return found


def _image(folder: Path, stem: str) -> EvaluationImage:
    """Return the image of a stem; the name that is expected where there is none."""
    names = (stem + suffix for suffix in IMAGE_SUFFIXES)
    name = next((name for name in names if (folder / name).is_file()), f"{stem}.png")
    return EvaluationImage(name, folder / name)
