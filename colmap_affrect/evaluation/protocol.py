"""What an evaluation protocol is: pairs of images with truth, and a score for their matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class EvaluationImage:
    """An image of a dataset.

    Attributes:
        name: unique in the dataset, the key of its features and depth map.
        path: the file.
        intrinsics: (3, 3) camera matrix in pixel-centre px; None where the dataset has none.
    """

    name: str
    path: Path
    intrinsics: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class EvaluationPair:
    """Two images whose matches are scored.

    Attributes:
        name: unique in the dataset.
        images: the two.
        category: of difficulty, as the protocol's tables group pairs; empty where it does not.
        truth: what the score needs; known to the protocol only.
    """

    name: str
    images: tuple[EvaluationImage, EvaluationImage]
    category: str = ""
    truth: Any = None


@dataclass(frozen=True)
class PairScore:
    """How good the matches of one pair are.

    Attributes:
        error: of the protocol (px or degrees); infinite where no model was found.
        num_inliers: of the model that was estimated.
        num_correct: matches that agree with the truth; None where it cannot say.
        details: further figures by name.
    """

    error: float
    num_inliers: int
    num_correct: int | None = None
    details: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PairResult:
    """One pair and one recipe: what ``evaluation.json`` lists.

    Attributes:
        name: of the pair.
        category: of the pair.
        score: of its matches.
        num_matches: before the estimation.
        seconds: matching and estimation.
    """

    name: str
    category: str
    score: PairScore
    num_matches: int
    seconds: float


@dataclass(frozen=True)
class Dataset:
    """The pairs of a dataset that can be evaluated.

    Attributes:
        pairs: in a fixed order.
        notes: what is missing or odd, in words: files that are not there (counted), truth that
            failed its sanity check (named).
    """

    pairs: tuple[EvaluationPair, ...]
    notes: tuple[str, ...] = ()


class EvaluationProtocol(Protocol):
    """Loads a dataset, scores matches, and sums up, as one of the paper's tables does.

    Implementations are frozen dataclasses of their settings, named in ``registry.PROTOCOLS``.
    """

    name: str

    def load(self, dataset_path: Path) -> Dataset:
        """Find the pairs of a dataset.

        Raises:
            EvaluationError: when the layout is not that of the protocol.
        """

    def score(
        self,
        pair: EvaluationPair,
        points1: NDArray[np.float64],
        points2: NDArray[np.float64],
        random_seed: int,
    ) -> PairScore:
        """Score (M, 2) and (M, 2) matched points, pixel-centre px of the stored images."""

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return the columns of the protocol's table by name, in order (counts or shares)."""

    def settings(self) -> dict[str, Any]:
        """Return everything that decides scores, for the record."""
