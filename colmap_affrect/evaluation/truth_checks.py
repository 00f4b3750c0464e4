"""Sanity checks of what a dataset gives as truth: converted wrongly it makes every method look bad.

What the numbers alone show is looked for in every image; what only the images show (homographies
inverted, coordinates exchanged, rotations transposed), in the matches of plain features: of every
homography and of marked correspondences, and of a few easy pairs where the truth is of poses.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.colmap.poses import Pose, relative_pose
from colmap_affrect.conventions import is_inside
from colmap_affrect.data import GrayImage, Rectification
from colmap_affrect.errors import ImageError
from colmap_affrect.evaluation.homographies import (
    Homography,
    Size,
    TrueHomography,
    oriented,
    visible_points,
)
from colmap_affrect.evaluation.protocol import EvaluationPair
from colmap_affrect.evaluation.relative_pose import CORRECT_PX, PosedImage, mean_focal_px, rays
from colmap_affrect.evaluation.two_views import (
    Points,
    Ransac,
    sampson_distances,
    symmetric_epipolar_distances,
)
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.reading import read_gray, readable_size
from colmap_affrect.images.warping import warp
from colmap_affrect.matchers.nearest import (
    MatchableImage,
    NearestOptions,
    match_features,
    matchable,
)
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.recipes import load_recipe
from colmap_affrect.shown import such_as
from colmap_affrect.stages.one_image import extract_image, prepare

CHECK_RECIPE = "unrectified-rootsift"

MAX_NOT_ORTHONORMAL = 1e-3  # largest element of R Rᵀ - I of what passes for a rotation
MIN_SUPPORT = 8
MIN_SUPPORT_FRAC = 0.25
"""Matches of the rectified pair that confirm a homography."""
SUPPORT_PX = 5.0
RESIZED = (0.5, 2.0)  # sizes of an image that a truth might be of, in the place of its own
EPIPOLAR_NOISE_PX = 1.0
MIN_EPIPOLAR_CONSENSUS = 40
MIN_EPIPOLAR_CONSENSUS_FRAC = 0.5
"""Inliers of a fundamental matrix that prove that the matches of a pair are right."""
MAX_MEDIAN_PX = 10.0  # correspondences off by more are doubted: they are a few px accurate
MAX_CHECKED_PAIRS = 8  # per scene
CHECK_IMAGE_SIZE_PX = 800  # longer side of the images in which poses are checked
MIN_POSE_CONSENSUS = 30
MIN_POSE_CONSENSUS_FRAC = 0.3
"""Inliers of an essential matrix that prove that the matches of a pair are right."""
MIN_AGREEING_FRAC = 0.5  # of such inliers, with the truth; where fewer do, it is wrong
MIN_EXPLAINED_FRAC = 0.9  # must agree with poses mistaken in a known way, for this to be named

POSE_MISTAKES: dict[str, Callable[[Pose], Pose]] = {
    "": lambda pose: pose,
    "rotation transposed": lambda pose: (pose[0].T, pose[1]),
    "pose inverted (world_from_camera)": lambda pose: (pose[0].T, -pose[0].T @ pose[1]),
    "translation is the position of the camera": lambda pose: (pose[0], -pose[0] @ pose[1]),
}
"""What turns a pose that was stored in a wrong way into the right one."""


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


def image_sizes(paths: Iterable[Path]) -> Iterator[Size | None]:
    """Yield (width, height) of images, None for those that cannot be read: they fail when used."""
    return map_ordered(readable_size, paths, available_cores())


def size_of(image: GrayImage) -> Size:
    """Return (width, height) of an (H, W) image."""
    return image.shape[1], image.shape[0]


def plain_features(image: GrayImage) -> MatchableImage:
    """Return features of an (H, W) uint8 image that are not rectified, ready for matching."""
    found = extract_image(image, load_recipe(CHECK_RECIPE).extraction)
    return matchable(found.descriptors, found.keypoints, NearestOptions())


def matched_points(image1: MatchableImage, image2: MatchableImage) -> tuple[Points, Points]:
    """Match plain features; return (M, 2) points of each image."""
    rows1, rows2 = match_features(image1, image2, NearestOptions()).indices.T
    return image1.keypoints[rows1], image2.keypoints[rows2]


def true_homography(
    matrix: Homography, paths: Sequence[Path], *, check: bool
) -> tuple[TrueHomography, str]:
    """Return the truth of two images, and what speaks against it (:func:`homography_doubts`).

    ``matrix`` is (3, 3) image2_from_image1 of any scale and sign; ``check`` says whether to look
    for doubts. Raises ImageError when an image cannot be read.
    """
    image1, image2 = (read_gray(path) for path in paths)
    size1, size2 = size_of(image1), size_of(image2)
    truth = TrueHomography(oriented(matrix, size1, size2), size1, size2)
    return truth, homography_doubts(matrix, image1, image2) if check else ""


def homography_doubts(matrix: Homography, image1: GrayImage, image2: GrayImage) -> str:
    """Say what speaks against a true homography of two (H, W) images; empty if they confirm it.

    Image 1 is warped by it, so that even extreme views become easy to match: if it is right,
    features of the warp and of image 2 agree in their places. If they do not, the same is tried
    with what people confuse it with.
    """
    size1, size2 = size_of(image1), size_of(image2)
    features2 = plain_features(image2)

    def support(matrix: Homography) -> int:
        """Count features of the warp that image 2 has at their place; 0 if too few to confirm."""
        matrix = oriented(matrix, size1, size2)
        if not len(visible_points(matrix, size1, size2)):
            return 0
        warped = plain_features(warp(image1, Rectification(matrix, size2, None, 1.0, 0.0)))
        points1, points2 = matched_points(warped, features2)
        count = int((np.linalg.norm(points1 - points2, axis=1) < SUPPORT_PX).sum())
        return count if count >= max(MIN_SUPPORT, MIN_SUPPORT_FRAC * len(points1)) else 0

    doubt = "is not confirmed by features of the images"
    if not len(visible_points(oriented(matrix, size1, size2), size1, size2)):
        doubt = "shows no part of image 1 in image 2"
    elif support(matrix):
        return ""
    supports = {mistake: support(suspect) for mistake, suspect in _homography_mistakes(matrix)}
    best = max(supports, key=supports.__getitem__)
    return f"{doubt}; it is {best}" if supports[best] else doubt


def _homography_mistakes(matrix: Homography) -> Iterator[tuple[str, Homography]]:
    """Yield what a wrong homography may be, with the right one."""
    if abs(np.linalg.det(matrix)) > 0.0:
        yield "inverted: from image 2 to image 1", np.asarray(np.linalg.inv(matrix))
    yield "transposed", matrix.T
    for scale in RESIZED:
        resize: Homography = np.diag([scale, scale, 1.0])
        shrink = np.diag([1 / scale, 1 / scale, 1.0])
        of_size = f"of images {1 / scale:g} times as large"
        yield of_size, resize @ matrix @ shrink
        yield f"{of_size}, in image 1", matrix @ shrink
        yield f"{of_size}, in image 2", resize @ matrix


def correspondence_doubts(correspondences: Points, paths: Sequence[Path]) -> str:
    """Say what speaks against (N, 4) correspondences of two images; empty if nothing does.

    They must lie in the images. Where plain features match beyond doubt, they must agree with the
    epipolar geometry of these; pairs that are too hard for them cannot be checked. Raises
    ImageError when an image cannot be read.
    """
    images = [read_gray(path) for path in paths]
    sides = np.hsplit(correspondences, 2)
    for number, (image, points) in enumerate(zip(images, sides, strict=True), 1):
        outside = int((~is_inside(points, size_of(image))).sum())
        if outside:
            return f"{outside} of {len(points)} lie outside of image {number}"
    points1, points2 = matched_points(*map(plain_features, images))
    ransac = Ransac(cv2.USAC_MAGSAC, EPIPOLAR_NOISE_PX, 0.999, 10_000)
    matrix, count = ransac.fundamental_matrix(points1, points2)
    if count < max(MIN_EPIPOLAR_CONSENSUS, MIN_EPIPOLAR_CONSENSUS_FRAC * len(points1)):
        return ""
    mistakes = {
        "": correspondences,
        "; x and y are exchanged": correspondences[:, [1, 0, 3, 2]],
        "; the images are exchanged": correspondences[:, [2, 3, 0, 1]],
        **{f"; they are of images {1 / s:g} times as large": s * correspondences for s in RESIZED},
    }
    medians = {
        what: float(np.median(symmetric_epipolar_distances(matrix, *np.hsplit(points, 2))))
        for what, points in mistakes.items()
    }
    if medians[""] <= MAX_MEDIAN_PX:
        return ""
    best = min(medians, key=medians.__getitem__)
    doubt = f"contradict the matches of plain features, by {medians['']:.0f} px in the median"
    return doubt + (best if medians[best] <= MAX_MEDIAN_PX else "")


def pose_contradictions(pairs: Sequence[EvaluationPair]) -> list[str]:
    """Match a few pairs, easy ones first, and name those whose matches contradict the true pose.

    The truth of each is two :class:`PosedImage`. There is a note for every way in which it seems
    wrong.
    """
    chosen: list[EvaluationPair] = []
    seen: dict[str, Path] = {}
    for pair in pairs:
        images = {image.name: image.path for image in pair.images}
        if len(chosen) < MAX_CHECKED_PAIRS and not images.keys() <= seen.keys():
            chosen.append(pair)
            seen |= images
    features = dict(zip(seen, _small_features(seen.values()), strict=True))
    found: dict[str, list[str]] = {}
    for pair in chosen:
        if (mistake := _pose_mistake(pair.truth, features)) is not None:
            found.setdefault(mistake, []).append(pair.name)
    return [
        f"the matches of {len(names)} of {len(chosen)} checked pairs contradict their true poses"
        f"{f'; they fit with {mistake}' if mistake else ''}: {such_as(names)}"
        for mistake, names in found.items()
    ]


def _small_features(paths: Iterable[Path]) -> Iterator[MatchableImage | None]:
    recipe = load_recipe(CHECK_RECIPE, [f"max_image_size_px={CHECK_IMAGE_SIZE_PX}"])
    extractor = prepare(recipe.extraction)

    def extract(path: Path) -> MatchableImage | None:
        try:
            found = extractor.extract_file(path).features
        except ImageError:
            return None
        return matchable(found.descriptors, found.keypoints, NearestOptions())

    return map_ordered(extract, paths, available_cores())


def _pose_mistake(
    truth: tuple[PosedImage, PosedImage], features: Mapping[str, MatchableImage | None]
) -> str | None:
    """Return what is wrong with the truth of a pair: None for nothing, empty for unknown."""
    first, second = (features[posed.image.name] for posed in truth)
    if first is None or second is None:
        return None
    points1, points2 = matched_points(first, second)
    rays1, rays2 = rays(truth[0].camera, points1), rays(truth[1].camera, points2)
    tolerance = CORRECT_PX / mean_focal_px([posed.camera for posed in truth])
    _, inliers = Ransac(cv2.RANSAC, tolerance, 0.999, 1000).relative_pose(rays1, rays2)
    if inliers.sum() < max(MIN_POSE_CONSENSUS, MIN_POSE_CONSENSUS_FRAC * len(points1)):
        return None
    rays1, rays2 = rays1[inliers], rays2[inliers]

    def agreeing(*mistakes: str) -> float:
        pose1, pose2 = (
            POSE_MISTAKES[mistake](posed.pose)
            for mistake, posed in zip(mistakes, truth, strict=True)
        )
        distances = sampson_distances(relative_pose(pose1, pose2), rays1, rays2)
        return float((distances < tolerance).mean())

    if agreeing("", "") >= MIN_AGREEING_FRAC:
        return None
    shares = {pair: agreeing(*pair) for pair in itertools.product(POSE_MISTAKES, repeat=2)}
    best = max(shares, key=shares.__getitem__)
    if shares[best] < MIN_EXPLAINED_FRAC:
        return ""
    if best[0] == best[1]:
        return f"{best[0]}, of both images"
    return " and ".join(
        f"{mistake} of {image.image.name}"
        for mistake, image in zip(best, truth, strict=True)
        if mistake
    )
