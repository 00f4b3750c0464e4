"""Pairs of images with a known truth, and what scores of their matches consist of."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.conventions import pixel_from_colmap
from colmap_affrect.options import Options, within

Number = Annotated[int | float, BeforeValidator(lambda value: math.inf if value is None else value)]
"""Infinite where JSON has null."""


class ScoreOptions(Options):
    """How models are estimated from matches: ``--protocol-options`` of the command line."""

    threshold_px: Annotated[float, within(1e-6, 1e9)] = 0.5
    """Of an inlier of plain RANSAC, for homographies and poses (the paper: 0.5)."""
    max_num_iterations: Annotated[int, within(1, 1_000_000_000)] = 100_000
    """Of estimators, as the paper says; its numbers of relative poses are those of 1000."""


@dataclass(frozen=True)
class PairScore:
    """How good the matches of one pair are."""

    error: Number  # of the protocol, px or degrees; infinite where no model was found
    num_inliers: int  # of the model that was estimated
    num_correct: int | None = None  # matches that agree with the truth; None where it cannot say
    details: Mapping[str, Number] = field(default_factory=dict)  # beside the error
    solved: float = 0.0  # how far it counts as matched: 1 or 0 where there is a threshold
    kind: str = ""  # of the truth, as tables name it; empty without one


@dataclass(frozen=True, kw_only=True)
class PairResult(PairScore):
    """The score of one pair by one recipe: what ``evaluation.json`` lists.

    Attributes:
        level: rectifier of the level of escalation that decided, ``none`` if no level was verified;
            empty without escalation.
        num_levels: levels that were matched, 1 without escalation.
        failure: why the pair counts as failed, with an infinite error.
    """

    name: str
    category: str = ""
    num_matches: int = 0
    num_keypoints: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    seconds_by_step: Mapping[str, float] = field(default_factory=dict)  # ``match``, ``estimate``
    level: str = ""
    num_levels: int = 0
    failure: str = ""


@dataclass(frozen=True)
class EvaluationImage:
    """An image of a dataset; its name is the key of its features and depth map."""

    name: str
    path: Path
    camera: pycolmap.Camera | None = None  # None where it is not known

    @property
    def intrinsics(self) -> Array | None:
        """(3, 3) camera matrix in pixel-centre px, without distortion; None without a camera."""
        if self.camera is None:
            return None
        matrix = np.asarray(self.camera.calibration_matrix(), dtype=np.float64)
        matrix[:2, 2] = pixel_from_colmap(matrix[:2, 2])
        return matrix


@dataclass(frozen=True)
class EvaluationPair:
    """Two images whose matches are scored; one with a problem has no truth, and fails."""

    name: str
    images: tuple[EvaluationImage, EvaluationImage]
    category: str = ""  # of difficulty, as tables group pairs; empty for none
    truth: Any = None  # one of :mod:`colmap_affrect.evaluation.truths`
    problem: str = ""


@dataclass(frozen=True)
class Dataset:
    """The pairs of a dataset, and what is missing in it, in words."""

    pairs: tuple[EvaluationPair, ...]
    notes: tuple[str, ...] = ()
