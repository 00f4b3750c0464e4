"""Sanity checks of poses and intrinsics that a dataset gives as truth.

A dataset that was converted wrongly makes every method look bad. What can be seen from the numbers
alone (rotations that are none, intrinsics of another image size) is looked for in every image; what
only the images show (rotations transposed, poses inverted), in a few easy pairs of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.comparison.metrics import Pose, relative_pose
from colmap_affrect.errors import ImageError
from colmap_affrect.evaluation.protocol import EvaluationPair
from colmap_affrect.evaluation.relative_pose import (
    CORRECT_PX,
    PosedImage,
    Ransac,
    estimate_relative_pose,
    mean_focal_px,
    rays,
    sampson_distances,
)
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.extraction import prepare
from colmap_affrect.imaging import read_gray
from colmap_affrect.matching.nearest import MatchableImage, match_features, matchable
from colmap_affrect.options import MatchingOptions
from colmap_affrect.recipes import Recipe, load_recipe

MAX_NOT_ORTHONORMAL = 1e-3
"""Largest element of R Rᵀ - I of what passes for a rotation."""

MAX_CHECKED_PAIRS = 8
"""Per scene."""

CHECK_IMAGE_SIZE_PX = 800
"""Longer side of the images that the check looks at."""

MIN_CONSENSUS = 30
MIN_CONSENSUS_FRAC = 0.3
"""Inliers of an essential matrix that prove that the matches of a pair are right."""

MIN_AGREEING_FRAC = 0.5
"""Share of such inliers that agree with the truth; where fewer do, the truth is wrong."""

MIN_EXPLAINED_FRAC = 0.9
"""Share that must agree with poses mistaken in a known way, for this to be named."""

MAX_NAMES = 3
"""Examples in a note."""

MISTAKES: dict[str, Callable[[Pose], Pose]] = {
    "": lambda pose: pose,
    "rotation transposed": lambda pose: (pose[0].T, pose[1]),
    "pose inverted (world_from_camera)": lambda pose: (pose[0].T, -pose[0].T @ pose[1]),
    "translation is the position of the camera": lambda pose: (pose[0], -pose[0] @ pose[1]),
}
"""What turns a pose that was stored in a wrong way into the right one."""


def such_as(names: Iterable[str]) -> str:
    """Return the first few names, for people.

    >>> such_as(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    listed = list(names)
    more = f" and {len(listed) - MAX_NAMES} more" if len(listed) > MAX_NAMES else ""
    return ", ".join(listed[:MAX_NAMES]) + more


def counted(items: Sequence[object], what: str, examples: Iterable[str]) -> list[str]:
    """Return a note of how many there are of something, with examples; nothing of nothing."""
    return [f"{len(items)} {what}: {such_as(examples)}"] if items else []


def rotation_fault(rotation: NDArray[np.float64]) -> str:
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


def size_notes(images: Sequence[PosedImage]) -> list[str]:
    """Count images that have another size in px than their intrinsics are for.

    Images that cannot be read are passed over: they fail in the evaluation.
    """

    def mismatch(posed: PosedImage) -> str:
        try:
            height, width = read_gray(posed.image.path).shape
        except ImageError:
            return ""
        camera = posed.camera
        if (camera.width, camera.height) == (width, height):
            return ""
        return (
            f"{posed.image.name} ({width} x {height} px, intrinsics for "
            f"{camera.width} x {camera.height} px)"
        )

    found = [text for text in map_ordered(mismatch, images, available_cores()) if text]
    return counted(found, "images are of another size than their intrinsics", found)


def contradictions(pairs: Sequence[EvaluationPair]) -> list[str]:
    """Match a few pairs and name those whose matches are plainly right and not of the true pose.

    Args:
        pairs: of one scene, the easy ones first; their truth is two :class:`PosedImage`.

    Returns:
        One note for every way in which the truth seems wrong.
    """
    chosen = _spread(pairs)
    recipe = load_recipe("unrectified-rootsift", [f"max_image_size_px={CHECK_IMAGE_SIZE_PX}"])
    paths = {image.image.path: None for pair in chosen for image in pair.truth}
    features = _features(list(paths), recipe)
    found: dict[str, list[str]] = {}
    for pair in chosen:
        mistake = _mistake(pair.truth, features, recipe.matching)
        if mistake is not None:
            found.setdefault(mistake, []).append(pair.name)
    return [
        f"the matches of {len(names)} of {len(chosen)} checked pairs contradict their true poses"
        f"{f'; they fit with {mistake}' if mistake else ''}: {such_as(names)}"
        for mistake, names in found.items()
    ]


def _spread(pairs: Sequence[EvaluationPair]) -> list[EvaluationPair]:
    """Choose the first pairs that each have an image that the chosen ones do not have."""
    chosen: list[EvaluationPair] = []
    seen: set[str] = set()
    for pair in pairs:
        names = {image.name for image in pair.images}
        if not names <= seen and len(chosen) < MAX_CHECKED_PAIRS:
            chosen.append(pair)
            seen |= names
    return chosen


def _features(paths: Sequence[Path], recipe: Recipe) -> Mapping[Path, MatchableImage]:
    """Extract the features of all images that can be read."""
    extractor = prepare(recipe.extraction)

    def extract(path: Path) -> MatchableImage | None:
        try:
            found = extractor.extract_file(path).features
        except ImageError:
            return None
        return matchable(found.descriptors, found.keypoints, recipe.matching)

    images = zip(paths, map_ordered(extract, paths, available_cores()), strict=True)
    return {path: image for path, image in images if image is not None}


def _mistake(
    truth: tuple[PosedImage, PosedImage],
    features: Mapping[Path, MatchableImage],
    options: MatchingOptions,
) -> str | None:
    """Return what is wrong with the truth of a pair: None for nothing, empty for unknown."""
    first, second = (features.get(image.image.path) for image in truth)
    if first is None or second is None:
        return None
    matches = match_features(first, second, options).indices
    cameras = (truth[0].camera, truth[1].camera)
    rays1 = rays(cameras[0], first.keypoints[matches[:, 0]])
    rays2 = rays(cameras[1], second.keypoints[matches[:, 1]])
    tolerance = CORRECT_PX / mean_focal_px(cameras)
    _, inliers = estimate_relative_pose(rays1, rays2, Ransac(tolerance, 0.999, 1000))
    if inliers.sum() < max(MIN_CONSENSUS, MIN_CONSENSUS_FRAC * len(matches)):
        return None
    rays1, rays2 = rays1[inliers], rays2[inliers]

    def agreeing(mistake1: str, mistake2: str) -> float:
        pose = relative_pose(MISTAKES[mistake1](truth[0].pose), MISTAKES[mistake2](truth[1].pose))
        return float((sampson_distances(pose, rays1, rays2) < tolerance).mean())

    if agreeing("", "") >= MIN_AGREEING_FRAC:
        return None
    shares = {pair: agreeing(*pair) for pair in itertools.product(MISTAKES, repeat=2)}
    best = max(shares, key=lambda pair: shares[pair])
    if shares[best] < MIN_EXPLAINED_FRAC:
        return ""
    if best[0] == best[1]:
        return f"{best[0]}, of both images"
    return " and ".join(
        f"{mistake} of {image.image.name}"
        for mistake, image in zip(best, truth, strict=True)
        if mistake
    )
