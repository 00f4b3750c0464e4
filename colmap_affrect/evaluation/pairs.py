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
:mod:`svp <colmap_affrect.evaluation.posed_scenes>`; of correspondences as WxBS.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median_low
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import is_unsafe
from colmap_affrect.conventions import colmap_from_pixel, pixel_from_colmap
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.homographies import (
    HomographyProtocol,
    TrueHomography,
    checked_homography,
    true_homography,
)
from colmap_affrect.evaluation.protocol import (
    GROUP,
    POSITIVE,
    Dataset,
    EvaluationImage,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
    finite_numbers,
    read_numbers,
    rotation_fault,
    stem,
    with_truth,
)
from colmap_affrect.evaluation.relative_pose import RelativePoseProtocol, posed_image
from colmap_affrect.evaluation.two_views import Points, symmetric_epipolar_distances
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.reading import read_gray
from colmap_affrect.options import within
from colmap_affrect.parallel.executor import available_cores, map_ordered

LIST = "pairs.json"
KINDS = ("homography", "correspondences", "relative_pose")
KEYS = ("name", "image1", "image2", "category", *KINDS)
INTRINSICS = dict.fromkeys(("intrinsics1", "intrinsics2"), (3, 3))
POSE_SHAPES = {"rotation": (3, 3), "translation": (3,), **INTRINSICS}
ORIGINS = ("center", "corner")

WXBS_THRESHOLDS_PX = tuple(range(20))
"""The score of WxBS is the mean over these of the share of correspondences that agree."""

SHOWN_THRESHOLDS_PX = (1, 2, 3, 5, 10, 20)


class CorrespondenceProtocol(EvaluationProtocol):
    """Score of matches by the fundamental matrix that they give by OpenCV's USAC_MAGSAC."""

    epipolar_threshold_px: Annotated[float, POSITIVE] = 1.0
    """Largest noise that USAC_MAGSAC reckons with for fundamental matrices."""
    num_magsac_estimates: Annotated[int, within(1, 1_000_000_000)] = 5
    """Of so many orders of the matches the one of median error counts."""

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score matches of a pair whose truth is (N, 4) correspondences x1, y1, x2, y2.

        ``error`` is the median of their symmetric epipolar distances in px. Details:
        ``wxbs_score``, and ``recall_Kpx``, the share of them within K px.
        """
        ransac = self.ransac(cv2.USAC_MAGSAC, self.epipolar_threshold_px, random_seed)
        found = []
        for number, reseeded in enumerate(ransac.reseeded(self.num_magsac_estimates)):
            matrix, num_inliers = reseeded.fundamental_matrix(points1, points2)
            distances = symmetric_epipolar_distances(matrix, *np.hsplit(pair.truth, 2))
            found.append((float(np.median(distances)), num_inliers, number, distances))
        error, num_inliers, _, distances = median_low(found)
        return PairScore(error, num_inliers, None, recalls(distances))

    def success(self, score: PairScore) -> float:
        """Return the score of WxBS."""
        return score.details["wxbs_score"]

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        return {
            "correspondences": "OpenCV USAC_MAGSAC fundamental matrix; error: median symmetric "
            "epipolar distance sqrt(d1^2 + d2^2), px; WxBS score: mean over thresholds 0, 1, ... "
            "19 px of the share of correspondences within",
            **super().settings(),
        }


def recalls(distances_px: Array) -> dict[str, float]:
    """Return the score of WxBS, and shares of (N,) distances up to single thresholds."""

    def share(limit_px: float) -> float:
        return float((distances_px <= limit_px).mean())

    return {
        "wxbs_score": float(np.mean([share(limit) for limit in WXBS_THRESHOLDS_PX])),
        **{f"recall_{limit}px": share(limit) for limit in SHOWN_THRESHOLDS_PX},
    }


def mean_recalls(results: Sequence[PairResult]) -> dict[str, float]:
    """Return the means of :func:`recalls` over results, at least one, under names for people."""
    keys = {"WxBS score": "wxbs_score"}
    keys |= {f"within {limit} px": f"recall_{limit}px" for limit in SHOWN_THRESHOLDS_PX}
    return {name: fmean(result.details[key] for result in results) for name, key in keys.items()}


class Pairs(HomographyProtocol, CorrespondenceProtocol, RelativePoseProtocol):
    """Homographies, epipolar geometries and relative poses of any pairs."""

    name: ClassVar[str] = "pairs"
    error_title: ClassVar[str] = "error (px; poses: degrees)"
    category_title: ClassVar[str] = "category"

    def load(self, dataset_path: Path) -> Dataset:
        """See :class:`EvaluationProtocol`."""
        listed, offset_px = _read_list(dataset_path / LIST)
        entries = [_Entry(each, dataset_path, offset_px) for each in listed]
        return Dataset.united(map_ordered(_Entry.load, entries, available_cores()))

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """See :class:`EvaluationProtocol`."""
        given = (pair, points1, points2, random_seed)
        if isinstance(pair.truth, TrueHomography):
            return HomographyProtocol.score(self, *given)
        if isinstance(pair.truth, tuple):
            return RelativePoseProtocol.score(self, *given)
        return CorrespondenceProtocol.score(self, *given)

    def success(self, score: PairScore) -> float:
        """1 if the error is below the limit of its kind; for correspondences the score of WxBS."""
        if "wxbs_score" in score.details:
            return CorrespondenceProtocol.success(self, score)
        is_pose = "direction_error_deg" in score.details
        return (RelativePoseProtocol if is_pose else HomographyProtocol).success(self, score)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """See :class:`EvaluationProtocol`; a table for each kind of truth that there is.

        Pairs whose truth cannot be read are in none of them; they count in the mean success.
        """

        def having(detail: str) -> list[PairResult]:
            return [result for result in results if detail in result.details]

        columns: dict[str, float] = {}
        if homographies := having("magsac_error"):
            counts = super().summarize(homographies)
            columns |= {f"homographies: {name}": count for name, count in counts.items()}
        if marked := having("wxbs_score"):
            recalls = mean_recalls(marked)
            columns |= {f"correspondences: {name}": share for name, share in recalls.items()}
        if poses := having("direction_error_deg"):
            columns |= {
                f"poses, {name}" if GROUP in name else f"poses{GROUP}{name}": share
                for name, share in self.columns(poses, ()).items()
            }
        return columns


def _read_list(path: Path) -> tuple[list[dict[str, Any]], float]:
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
    listed = [{**entry, "name": name} for name, entry in zip(names, entries, strict=True)]
    return listed, corner_px if origin == "corner" else 0.0


def _named(entry: Any, path: Path, number: int) -> str:
    where = f"{path}: pairs[{number}]"
    if not isinstance(entry, dict):
        raise EvaluationError(f"{where}: is not an object")
    unknown = sorted(entry.keys() - set(KEYS))
    if unknown:
        raise EvaluationError(f"{where}: unknown key '{unknown[0]}'; known are {', '.join(KEYS)}")
    for key in ("image1", "image2"):
        if not isinstance(entry.get(key), str) or is_unsafe(entry[key]):
            raise EvaluationError(f"{where}: {key} must be the path of an image in the folder")
    kinds = [kind for kind in KINDS if kind in entry]
    if len(kinds) != 1:
        raise EvaluationError(
            f"{where}: needs one of {', '.join(KINDS)}, and has {' and '.join(kinds) or 'none'}"
        )
    return str(entry.get("name") or f"{stem(entry['image1'])} {stem(entry['image2'])}")


@dataclass(frozen=True)
class _Entry:
    """An entry of the list; to its coordinates ``offset_px`` must be added for pixel centres."""

    values: Mapping[str, Any]
    folder: Path
    offset_px: float

    def load(self) -> Dataset:
        """Return the pair, and notes where there is something to say about it."""
        values = self.values
        first, second = (
            EvaluationImage(values[key], self.folder / values[key]) for key in ("image1", "image2")
        )
        pair = EvaluationPair(values["name"], (first, second), str(values.get("category", "")))
        readers = self._homography, self._correspondences, self._pose
        (read,) = (read for kind, read in zip(KINDS, readers, strict=True) if kind in values)
        return with_truth(pair, [first.path, second.path], read)

    def _numbers(self, key: str) -> Any:
        """Return numbers, out of a text file where its name is given."""
        given = self.values[key]
        if not isinstance(given, str):
            return given
        if is_unsafe(given):
            raise EvaluationError(f"{given}: must be a file in the folder of the pairs")
        return read_numbers(self.folder / given)

    def _homography(self, pair: EvaluationPair) -> EvaluationPair:
        matrix = checked_homography(self._numbers("homography"), f"{pair.name}: homography")
        offset_px = self.offset_px
        center = np.array([[1.0, 0.0, offset_px], [0.0, 1.0, offset_px], [0.0, 0.0, 1.0]])
        matrix = center @ matrix @ np.linalg.inv(center)
        paths = [image.path for image in pair.images]
        return replace(pair, truth=true_homography(matrix, paths))

    def _correspondences(self, pair: EvaluationPair) -> EvaluationPair:
        values = finite_numbers(
            self._numbers("correspondences"), (-1, 4), f"{pair.name}: the array of correspondences"
        )
        return replace(pair, truth=values + self.offset_px)

    def _pose(self, pair: EvaluationPair) -> EvaluationPair:
        """Return a pair with a relative pose: the first camera stands at the origin."""
        values = _pose_values(self.values["relative_pose"], pair.name)
        poses = (np.eye(3), np.zeros(3)), (values["rotation"], values["translation"])
        posed = []
        for number, (image, pose) in enumerate(zip(pair.images, poses, strict=True), 1):
            matrix = values[f"intrinsics{number}"]
            principal = matrix[:2, 2] + self.offset_px
            height, width = read_gray(image.path).shape
            params = [matrix[0, 0], matrix[1, 1], *colmap_from_pixel(principal)]
            camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
            posed.append(posed_image(image.name, image.path, camera, pose))
        images = posed[0].image, posed[1].image
        return replace(pair, images=images, truth=(posed[0], posed[1]))


def _pose_values(given: Any, where: str) -> dict[str, Array]:
    if not isinstance(given, dict) or given.keys() != POSE_SHAPES.keys():
        raise EvaluationError(f"{where}: relative_pose needs {', '.join(POSE_SHAPES)}")
    arrays = {
        key: finite_numbers(given[key], shape, f"{where}: {key}")
        for key, shape in POSE_SHAPES.items()
    }
    if fault := rotation_fault(arrays["rotation"]):
        raise EvaluationError(f"{where}: {fault}")
    return arrays
