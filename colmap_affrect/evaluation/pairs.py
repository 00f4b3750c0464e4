"""Any pairs of images with a truth, described by ``pairs.json`` in their folder.

::

    {
      "pixel_origin": "center",
      "pairs": [
        {"name": "cafe", "image1": "a.png", "image2": "b.png", "category": "indoors",
         "homography": [[1, 0, 5], [0, 1, 0], [0, 0, 1]]},
        {"image1": "c.png", "image2": "d.png", "correspondences": [[490.7, 39.2, 462.2, 18.7]]},
        {"image1": "e.png", "image2": "f.png",
         "relative_pose": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [1, 0, 0],
                           "intrinsics1": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
                           "intrinsics2": [[500, 0, 320], [0, 500, 240], [0, 0, 1]]}}
      ]
    }

Each pair has one of the three: a homography, image2_from_image1; correspondences, rows x1, y1, x2,
y2 (both may also be the name of a text file of numbers); or a relative pose of undistorted images,
x_camera2 = R x_camera1 + t. ``name`` is that of the images by default, ``category`` groups pairs in
tables and plots and may be left out, and so may ``pixel_origin``: ``center`` when (0, 0) is the
centre of the first pixel (default), ``corner`` when it is its corner. ``convention`` is for people.

Scores: of homographies as :mod:`evd <colmap_affrect.evaluation.evd>` has them; of poses as
:mod:`svp <colmap_affrect.evaluation.svp>`; of correspondences as WxBS, see
:mod:`correspondences <colmap_affrect.evaluation.correspondences>`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.conventions import colmap_from_pixel, pixel_from_colmap
from colmap_affrect.errors import AffrectError, EvaluationError
from colmap_affrect.evaluation.correspondences import (
    SHOWN_THRESHOLDS_PX,
    FundamentalEstimator,
    checked_correspondences,
    correspondence_doubts,
    score_correspondences,
)
from colmap_affrect.evaluation.homographies import (
    HomographyEstimator,
    TrueHomography,
    checked_homography,
    homography_counts,
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
from colmap_affrect.evaluation.relative_pose import RelativePoseProtocol, posed_image
from colmap_affrect.evaluation.tables import GROUP
from colmap_affrect.evaluation.truth_checks import contradictions, rotation_fault
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.imaging import read_gray

LIST = "pairs.json"
KINDS = ("homography", "correspondences", "relative_pose")
KEYS = ("name", "image1", "image2", "category", *KINDS)
POSE_KEYS = ("rotation", "translation", "intrinsics1", "intrinsics2")
ORIGINS = ("center", "corner")
NO_CATEGORY = "0°"
"""Of all poses, whose categories here are no angles."""

MAX_OFF_CENTRE = 0.25
"""A principal point further from the middle, in image sizes, does not fit the image."""


@dataclass(frozen=True)
class Pairs:
    """Homographies, epipolar geometries and relative poses of any pairs.

    Attributes:
        threshold_px: inliers of RANSAC for homographies and essential matrices, as the paper.
        confidence: of all estimators.
        max_num_iterations: of all estimators.
        magsac_threshold_px: largest noise that USAC_MAGSAC reckons with for homographies.
        epipolar_threshold_px: the same for fundamental matrices.
        num_magsac_estimates: of so many orders of the matches the one of median error counts.
        max_error_px: a homography counts below this error.
        max_error_deg: a pose counts below this rotation error.
        check_truth: see whether the images confirm the truth.
    """

    name = "pairs"
    error_title = "error (px; poses: degrees)"
    category_title = "category"

    threshold_px: float = 0.5
    confidence: float = 0.9999
    max_num_iterations: int = 100_000
    magsac_threshold_px: float = 5.0
    epipolar_threshold_px: float = 1.0
    num_magsac_estimates: int = 5
    max_error_px: float = 5.0
    max_error_deg: float = 5.0
    check_truth: bool = True

    def load(self, dataset_path: Path) -> Dataset:
        """See :class:`EvaluationProtocol`."""
        entries, offset_px = _read_list(dataset_path / LIST)

        def load_pair(entry: Mapping[str, Any]) -> tuple[EvaluationPair, list[str]]:
            return _load_pair(entry, dataset_path, offset_px, check=self.check_truth)

        loaded = list(map_ordered(load_pair, entries, available_cores()))
        notes = [note for _, found in loaded for note in found]
        pairs = [pair for pair, _ in loaded]
        posed = [pair for pair in pairs if isinstance(pair.truth, tuple)]
        if self.check_truth and posed:
            notes += contradictions(posed)
        return Dataset(tuple(pairs), tuple(notes))

    def score(
        self,
        pair: EvaluationPair,
        points1: NDArray[np.float64],
        points2: NDArray[np.float64],
        random_seed: int,
    ) -> PairScore:
        """See :class:`EvaluationProtocol`."""
        if isinstance(pair.truth, TrueHomography):
            return score_homography(pair.truth, points1, points2, self._homographies, random_seed)
        if isinstance(pair.truth, tuple):
            return self._poses.score(pair, points1, points2, random_seed)
        estimator = FundamentalEstimator(
            self.epipolar_threshold_px,
            self.confidence,
            self.max_num_iterations,
            self.num_magsac_estimates,
        )
        return score_correspondences(pair.truth, points1, points2, estimator, random_seed)

    @property
    def _homographies(self) -> HomographyEstimator:
        return HomographyEstimator(
            self.threshold_px,
            self.confidence,
            self.max_num_iterations,
            self.magsac_threshold_px,
            self.num_magsac_estimates,
        )

    @property
    def _poses(self) -> RelativePoseProtocol:
        return RelativePoseProtocol(
            self.threshold_px,
            self.confidence,
            self.max_num_iterations,
            max_error_deg=self.max_error_deg,
        )

    def success(self, score: PairScore) -> float:
        """1 if the error is below the limit of its kind; for correspondences the score of WxBS."""
        if "wxbs_score" in score.details:
            return score.details["wxbs_score"]
        is_pose = "direction_error_deg" in score.details
        return float(score.error < (self.max_error_deg if is_pose else self.max_error_px))

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """See :class:`EvaluationProtocol`; a table for each kind of truth that there is.

        Pairs whose truth cannot be read are in none of them; they count in the mean success.
        """
        columns: dict[str, float] = {}
        homographies = [result for result in results if "magsac_error" in result.score.details]
        if homographies:
            columns |= homography_counts(homographies, "homographies: ")
        marked = [result.score.details for result in results]
        marked = [details for details in marked if "wxbs_score" in details]
        if marked:
            keys = {"WxBS score": "wxbs_score"}
            keys |= {f"within {limit} px": f"recall_{limit}px" for limit in SHOWN_THRESHOLDS_PX}
            columns |= {
                f"correspondences: {name}": fmean(details[key] for details in marked)
                for name, key in keys.items()
            }
        poses = [result for result in results if "direction_error_deg" in result.score.details]
        if poses:
            together = [replace(result, category=NO_CATEGORY) for result in poses]
            columns |= {
                f"poses, {name}" if GROUP in name else f"poses{GROUP}{name}": value
                for name, value in self._poses.summarize(together).items()
                if name.rpartition(GROUP)[2] != NO_CATEGORY
            }
        return columns

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        return {
            "homographies": self._homographies.settings(),
            "correspondences": "OpenCV USAC_MAGSAC fundamental matrix; error: median symmetric "
            "epipolar distance sqrt(d1^2 + d2^2), px; WxBS score: mean over thresholds 0, 1, ... "
            "19 px of the share of correspondences within",
            "poses": self._poses.settings(),
            **asdict(self),
        }


def _read_list(path: Path) -> tuple[list[Mapping[str, Any]], float]:
    """Read ``pairs.json``; also return what must be added to its coordinates for pixel centres."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise EvaluationError(
            f"{path}: cannot be read ({error}); it describes the pairs, see the module "
            "colmap_affrect.evaluation.pairs"
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get("pairs"), list):
        raise EvaluationError(f"{path}: has no list 'pairs'")
    unknown = sorted(content.keys() - {"pairs", "pixel_origin", "convention"})
    if unknown:
        raise EvaluationError(f"{path}: unknown key '{unknown[0]}'")
    origin = content.get("pixel_origin", "center")
    if origin not in ORIGINS:
        raise EvaluationError(f"{path}: pixel_origin={origin!r} is not one of {', '.join(ORIGINS)}")
    entries = content["pairs"]
    if not entries:
        raise EvaluationError(f"{path}: lists no pairs")
    names = [_named(entry, path, number) for number, entry in enumerate(entries)]
    for name in names:
        if names.count(name) > 1:
            raise EvaluationError(f"{path}: two pairs are called '{name}'; give them names")
    corner_px = float(pixel_from_colmap(np.zeros(1))[0])
    return [
        {**entry, "name": name} for name, entry in zip(names, entries, strict=True)
    ], corner_px if origin == "corner" else 0.0


def _named(entry: Any, path: Path, number: int) -> str:
    """Return the name of an entry whose keys are right."""
    where = f"{path}: pairs[{number}]"
    if not isinstance(entry, dict):
        raise EvaluationError(f"{where}: is not an object")
    unknown = sorted(entry.keys() - set(KEYS))
    if unknown:
        raise EvaluationError(f"{where}: unknown key '{unknown[0]}'; known are {', '.join(KEYS)}")
    for key in ("image1", "image2"):
        if not isinstance(entry.get(key), str) or not _stays_below(entry[key]):
            raise EvaluationError(f"{where}: {key} must be the path of an image in the folder")
    kinds = [kind for kind in KINDS if kind in entry]
    if len(kinds) != 1:
        raise EvaluationError(
            f"{where}: needs one of {', '.join(KINDS)}, and has {' and '.join(kinds) or 'none'}"
        )
    stems = [PurePosixPath(entry[key]).with_suffix("").as_posix() for key in ("image1", "image2")]
    return str(entry.get("name") or " ".join(stems))


def _stays_below(name: str) -> bool:
    return ".." not in PurePosixPath(name).parts and not name.startswith("/")


def _load_pair(
    entry: Mapping[str, Any], folder: Path, offset_px: float, *, check: bool
) -> tuple[EvaluationPair, list[str]]:
    """Return a pair, and notes where there is something to say about it."""
    images = [EvaluationImage(entry[key], folder / entry[key]) for key in ("image1", "image2")]
    name, category = entry["name"], str(entry.get("category", ""))
    pair = EvaluationPair(name, (images[0], images[1]), category)
    try:
        for image in images:
            if not image.path.is_file():
                raise EvaluationError(f"{image.path}: missing")
        if "relative_pose" in entry:
            return _posed(pair, entry["relative_pose"], offset_px)
        if "homography" in entry:
            doubtful, doubt = _homography(pair, entry["homography"], folder, offset_px, check=check)
            what = "its homography"
        else:
            values = _numbers(entry["correspondences"], folder)
            truth = checked_correspondences(values, name) + offset_px
            doubtful = replace(pair, truth=truth)
            doubt = correspondence_doubts(truth, [i.path for i in images]) if check else ""
            what = "its correspondences"
    except AffrectError as error:
        note = f"{name}: cannot be evaluated and counts as failed: {error}"
        return replace(pair, problem=str(error)), [note]
    return doubtful, [f"{name}: {what} {doubt}"] if doubt else []


def _homography(
    pair: EvaluationPair, given: Any, folder: Path, offset_px: float, *, check: bool
) -> tuple[EvaluationPair, str]:
    matrix = checked_homography(_numbers(given, folder), pair.name)
    center = np.array([[1.0, 0.0, offset_px], [0.0, 1.0, offset_px], [0.0, 0.0, 1.0]])
    matrix = center @ matrix @ np.linalg.inv(center)
    paths = pair.images[0].path, pair.images[1].path
    truth, doubt = true_homography(matrix, paths, check=check)
    return replace(pair, truth=truth), doubt


def _numbers(given: Any, folder: Path) -> Any:
    """Return numbers, out of a text file where its name is given."""
    if not isinstance(given, str):
        return given
    if not _stays_below(given):
        raise EvaluationError(f"{given}: must be a file in the folder of the pairs")
    try:
        return np.loadtxt(folder / given, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{folder / given}: cannot be read as numbers ({error})") from error


def _posed(pair: EvaluationPair, given: Any, offset_px: float) -> tuple[EvaluationPair, list[str]]:
    """Return a pair with a relative pose: the first camera stands at the origin."""
    if not isinstance(given, dict) or given.keys() != set(POSE_KEYS):
        raise EvaluationError(f"{pair.name}: relative_pose needs {', '.join(POSE_KEYS)}")
    shapes = {"rotation": (3, 3), "translation": (3,), "intrinsics1": (3, 3), "intrinsics2": (3, 3)}
    arrays: dict[str, NDArray[np.float64]] = {}
    for key, shape in shapes.items():
        try:
            arrays[key] = np.asarray(given[key], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise EvaluationError(f"{pair.name}: {key} is not numbers") from error
        if arrays[key].shape != shape or not np.isfinite(arrays[key]).all():
            raise EvaluationError(f"{pair.name}: {key} is not {shape} finite numbers")
    fault = rotation_fault(arrays["rotation"])
    if fault:
        raise EvaluationError(f"{pair.name}: {fault}")
    nowhere = (np.eye(3), np.zeros(3))
    poses = (nowhere, (arrays["rotation"], arrays["translation"]))
    notes, posed = [], []
    for image, key, pose in zip(pair.images, POSE_KEYS[2:], poses, strict=True):
        matrix = arrays[key].copy()
        matrix[:2, 2] += offset_px
        height, width = read_gray(image.path).shape
        offset = matrix[:2, 2] / (width, height) - 1 / 2
        if np.abs(offset).max() > MAX_OFF_CENTRE:
            notes.append(
                f"{pair.name}: the principal point of {key} is far from the middle of the "
                f"{width} x {height} px of {image.name}"
            )
        posed.append(posed_image(image.name, image.path, _camera(matrix, (width, height)), pose))
    images = (posed[0].image, posed[1].image)
    return replace(pair, images=images, truth=(posed[0], posed[1])), notes


def _camera(matrix: NDArray[np.float64], size: tuple[int, int]) -> pycolmap.Camera:
    """Return a pinhole camera of (3, 3) intrinsics in pixel-centre px."""
    center = colmap_from_pixel(matrix[:2, 2])
    params = [matrix[0, 0], matrix[1, 1], *center]
    return pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=params)
