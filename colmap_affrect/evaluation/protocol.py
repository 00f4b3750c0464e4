"""What an evaluation protocol is: pairs of images with truth, and a score for their matches."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BeforeValidator

from colmap_affrect.errors import AffrectError, EvaluationError
from colmap_affrect.evaluation.two_views import Points, Ransac
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import Options, within
from colmap_affrect.shown import such_as

MAX_NOT_ORTHONORMAL = 1e-3  # largest element of R Rᵀ - I of what passes for a rotation

Number = Annotated[int | float, BeforeValidator(lambda value: math.inf if value is None else value)]
"""Infinite where JSON has null."""

POSITIVE = within(1e-6, 1e9)

GROUP = ": "  # separates the name of a table from that of its column in the names of columns


@dataclass(frozen=True)
class EvaluationImage:
    """An image of a dataset.

    ``name`` is the key of its features and depth map; ``intrinsics`` is its (3, 3) camera matrix in
    pixel-centre px, None where the dataset has none.
    """

    name: str
    path: Path
    intrinsics: Array | None = None


@dataclass(frozen=True)
class EvaluationPair:
    """Two images whose matches are scored.

    Attributes:
        category: of difficulty, as the protocol's tables group pairs; empty where it does not.
        truth: what the score needs; known to the protocol only.
        problem: why it cannot be scored and counts as failed; empty for the others.
    """

    name: str
    images: tuple[EvaluationImage, EvaluationImage]
    category: str = ""
    truth: Any = None
    problem: str = ""


@dataclass(frozen=True)
class PairScore:
    """How good the matches of one pair are.

    Attributes:
        error: of the protocol (px or degrees); infinite where no model was found.
        num_inliers: of the model that was estimated.
        num_correct: matches that agree with the truth; None where it cannot say.
    """

    error: Number
    num_inliers: int
    num_correct: int | None = None
    details: Mapping[str, Number] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class PairResult(PairScore):
    """The score of one pair by one recipe: what ``evaluation.json`` lists.

    Attributes:
        seconds_by_step: the same by step, ``match`` and ``estimate``.
        level: rectifier of the level of escalation that decided; empty without escalation.
        num_levels: levels whose features were extracted for the pair, 1 without escalation.
        failure: why the pair counts as failed, with an infinite error.
    """

    name: str
    category: str = ""
    num_matches: int = 0
    num_keypoints: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    seconds_by_step: Mapping[str, float] = field(default_factory=dict)
    level: str = ""
    num_levels: int = 0
    failure: str = ""


@dataclass(frozen=True)
class Dataset:
    """The pairs of a dataset that can be evaluated, and what is missing or odd, in words."""

    pairs: tuple[EvaluationPair, ...]
    notes: tuple[str, ...] = ()

    @classmethod
    def united(cls, parts: Iterable[Self]) -> Self:
        """Return the pairs and notes of all parts of a dataset."""
        parts = list(parts)
        return cls(
            tuple(pair for part in parts for pair in part.pairs),
            tuple(note for part in parts for note in part.notes),
        )


class EvaluationProtocol(Options, ABC):
    """Loads a dataset, scores matches, and sums up, as one of the paper's tables does."""

    name: ClassVar[str]
    """As the command line has it."""
    error_title: ClassVar[str]
    """What the error of a score is, with its unit, for axes of plots."""
    category_title: ClassVar[str] = ""
    """What the categories are; empty without."""

    threshold_px: Annotated[float, POSITIVE] = 0.5
    """Of an inlier of plain RANSAC (the paper: 0.5)."""
    confidence: Annotated[float, within(1e-6, 1.0)] = 0.9999
    """At which estimators may end."""
    max_num_iterations: Annotated[int, within(1, 1_000_000_000)] = 100_000
    """Of estimators, as the paper says; 1000 gave its numbers of relative poses, for the function
    of OpenCV that its code called takes no number."""

    def ransac(self, method: int, threshold: float, random_seed: int) -> Ransac:
        """Return how to look for a model."""
        return Ransac(method, threshold, self.confidence, self.max_num_iterations, random_seed)

    @abstractmethod
    def load(self, dataset_path: Path) -> Dataset:
        """Find the pairs of a dataset; EvaluationError when the layout is another one."""

    @abstractmethod
    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score (M, 2) and (M, 2) matched points, pixel-centre px of the stored images."""

    @abstractmethod
    def success(self, score: PairScore) -> float:
        """Return how far a pair counts as matched, in [0, 1]: 1 or 0 where there is a threshold.

        Plots and intervals are of its mean; the test against the baseline compares it pair by pair.
        """

    @abstractmethod
    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return the columns of the protocol's table by name, in order (counts or shares).

        Failed pairs are among the results. A name ``group: column`` puts the column into a table
        of its own. Names are those of the paper's rows where it has the same number. Of an empty
        sequence all columns are 0.
        """

    def settings(self) -> dict[str, Any]:
        """Return everything that decides scores, for the record."""
        return self.to_mapping()


def with_truth(
    pair: EvaluationPair,
    paths: Sequence[Path],
    read: Callable[[EvaluationPair], EvaluationPair],
) -> Dataset:
    """Return a pair with its truth; one that cannot be used with its problem, which is a note too.

    ``paths`` must be there; ``read`` returns the pair with its truth.
    """
    try:
        if missing := [path for path in paths if not path.is_file()]:
            raise EvaluationError(f"{missing[0]}: missing")
        return Dataset((read(pair),))
    except AffrectError as error:
        note = f"{pair.name}: cannot be evaluated and counts as failed: {error}"
        return Dataset((replace(pair, problem=str(error)),), (note,))


def counted(names: Sequence[str], what: str) -> list[str]:
    """Return a note of how many there are of something, with examples; nothing of nothing."""
    return [f"{len(names)} {what}: {such_as(names)}"] if names else []


def stem(name: str) -> str:
    """Return a name without its suffix.

    >>> stem("left/a.1.png")
    'left/a.1'
    """
    return PurePosixPath(name).with_suffix("").as_posix()


def read_numbers(path: Path) -> Array:
    """Read a table of numbers from text; EvaluationError when it is none."""
    try:
        return np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read as numbers ({error})") from error


def finite_numbers(given: Any, shape: tuple[int, ...], what: str) -> Array:
    """Return an array of some shape, -1 in it for any number of rows but none.

    EvaluationError says what is wrong with ``what``.
    """
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(f"{what} is not numbers") from error
    fits = values.ndim == len(shape) and all(
        wanted in (has, -1) for has, wanted in zip(values.shape, shape, strict=True)
    )
    if not fits or not values.size:
        expected = str(shape).replace("-1", "N")
        raise EvaluationError(f"{what} has shape {values.shape}, expected {expected}")
    if not np.isfinite(values).all():
        raise EvaluationError(f"{what} has values that are not finite")
    return values


def rotation_fault(rotation: Array) -> str:
    """Tell why a (3, 3) matrix is not a rotation; empty if it is one.

    >>> rotation_fault(2.0 * np.eye(3))
    'the rotation is scaled by 2'
    """
    if not np.isfinite(rotation).all():
        return "the rotation has values that are not finite"
    determinant = float(np.linalg.det(rotation))
    scale = float(np.cbrt(determinant))
    if scale and np.abs(rotation @ rotation.T / scale**2 - np.eye(3)).max() < MAX_NOT_ORTHONORMAL:
        if scale < 0:
            return "the rotation is a reflection"
        if abs(scale - 1) > MAX_NOT_ORTHONORMAL:
            return f"the rotation is scaled by {scale:.3g}"
        return ""
    return "the rotation is not orthogonal"
