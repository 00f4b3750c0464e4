"""The Extreme View Dataset, and other pairs with homographies in files.

Layouts: ``1/NAME.png``, ``2/NAME.png``, ``h/NAME.txt`` (EVD; any image suffix), and sequences as
Oxford's, ``NAME_1.png``, ``NAME_2.png``, ..., ``H_NAME_1_2.txt``, ... Homographies map pixel-centre
px of image 1 to those of image 2.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import AffrectError, EvaluationError
from colmap_affrect.evaluation.homographies import (
    HomographyEstimator,
    homography_counts,
    read_homography,
    score_homography,
    true_homography,
)
from colmap_affrect.evaluation.protocol import (
    Dataset,
    EvaluationImage,
    EvaluationPair,
    PairResult,
    PairScore,
)
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.imaging import IMAGE_SUFFIXES

SUCCESS_PX = 5.0
NUM_PAPER_PAIRS = 15


@dataclass(frozen=True)
class Evd(HomographyEstimator):
    """Number of pairs with a homography error below 1, 2, 3, 5, 10 and 20 px.

    Attributes:
        check_truth: see whether the images confirm the homographies.
    """

    name = "evd"
    error_title = "mean reprojection error of the visible part (px)"
    category_title = ""

    check_truth: bool = True

    def load(self, dataset_path: Path) -> Dataset:
        """See :class:`EvaluationProtocol`."""
        if (dataset_path / "h").is_dir():
            found, notes = _extreme_views(dataset_path)
        else:
            found, notes = _sequences(dataset_path), []
        if not found:
            raise EvaluationError(
                f"{dataset_path}: holds neither 1/NAME.png, 2/NAME.png, h/NAME.txt nor "
                "NAME_1.png, NAME_2.png, H_NAME_1_2.txt"
            )

        def load_pair(files: _Files) -> tuple[EvaluationPair, str]:
            return files.load(check_truth=self.check_truth)

        loaded = list(map_ordered(load_pair, found, available_cores()))
        notes += [note for _, note in loaded if note]
        return Dataset(tuple(pair for pair, _ in loaded), tuple(notes))

    def score(
        self,
        pair: EvaluationPair,
        points1: NDArray[np.float64],
        points2: NDArray[np.float64],
        random_seed: int,
    ) -> PairScore:
        """See :class:`EvaluationProtocol`."""
        return score_homography(pair.truth, points1, points2, self, random_seed)

    def success(self, score: PairScore) -> float:
        """1 if the error is below 5 px."""
        return float(score.error < SUCCESS_PX)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """See :class:`EvaluationProtocol`."""
        return homography_counts(results)

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        return {"success": f"error < {SUCCESS_PX:g} px", **super().settings()}


@dataclass(frozen=True)
class _Files:
    """Files of a pair, which may be missing."""

    name: str
    image_names: tuple[str, str]
    paths: tuple[Path, Path]
    homography: Path

    def load(self, *, check_truth: bool) -> tuple[EvaluationPair, str]:
        """Return the pair, and a note where there is something to say about it."""
        images = [
            EvaluationImage(name, path)
            for name, path in zip(self.image_names, self.paths, strict=True)
        ]
        pair = EvaluationPair(self.name, (images[0], images[1]))
        try:
            for path in (*self.paths, self.homography):
                if not path.is_file():
                    raise EvaluationError(f"{path}: missing")
            truth, doubt = true_homography(
                read_homography(self.homography), self.paths, check=check_truth
            )
        except AffrectError as error:
            problem = EvaluationPair(pair.name, pair.images, problem=str(error))
            return problem, f"{self.name}: cannot be evaluated and counts as failed: {error}"
        note = f"{self.name}: the homography {self.homography} {doubt}" if doubt else ""
        return EvaluationPair(pair.name, pair.images, truth=truth), note


def _extreme_views(folder: Path) -> tuple[list[_Files], list[str]]:
    """List all names that one of the folders 1, 2 and h has."""
    stems = {path.stem for path in (folder / "h").glob("*.txt")}
    for part in ("1", "2"):
        stems |= {p.stem for p in (folder / part).glob("*") if p.suffix.lower() in IMAGE_SUFFIXES}
    found = []
    for stem in sorted(stems):
        path1, path2 = (_image(folder / part / stem) for part in ("1", "2"))
        names = f"1/{path1.name}", f"2/{path2.name}"
        found.append(_Files(stem, names, (path1, path2), folder / "h" / f"{stem}.txt"))
    notes = []
    if len(found) < NUM_PAPER_PAIRS:
        notes.append(f"{len(found)} pairs; the dataset of the paper has {NUM_PAPER_PAIRS}")
    return found, notes


def _image(stem: Path) -> Path:
    """Return the image of a stem; the name that is expected where there is none."""
    paths = (stem.with_name(stem.name + suffix) for suffix in IMAGE_SUFFIXES)
    return next((path for path in paths if path.is_file()), stem.with_name(f"{stem.name}.png"))


def _sequences(folder: Path) -> list[_Files]:
    """List the pairs of sequences that have a homography."""
    found = []
    for path in sorted(folder.glob("H_*.txt")):
        parts = re.fullmatch(r"H_(.+)_([^_]+)_([^_]+)", path.stem)
        if parts:
            sequence, first, second = parts.groups()
            path1, path2 = (_image(folder / f"{sequence}_{part}") for part in (first, second))
            name = f"{sequence} {first}-{second}"
            found.append(_Files(name, (path1.name, path2.name), (path1, path2), path))
    return found
