"""Geometric verification of raw matches by pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    num_unverified_pairs,
    open_database,
    require_database_space,
)
from colmap_affrect.colmap.native_options import Plain, differences
from colmap_affrect.colmap.running import run_cancellable
from colmap_affrect.conventions import colmap_from_pixel
from colmap_affrect.options import VerificationOptions

REJECTED = (
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
)


def two_view_options(
    options: VerificationOptions, random_seed: int
) -> pycolmap.TwoViewGeometryOptions:
    """Translate our options into pycolmap's."""
    return pycolmap.TwoViewGeometryOptions(
        min_num_inliers=options.min_num_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
        ransac=dict(
            max_error=options.max_error_px,
            min_inlier_ratio=options.ransac_min_inlier_ratio,
            max_num_trials=options.max_num_trials,
            random_seed=random_seed,
        ),
    )


def verification_differences(options: VerificationOptions, random_seed: int) -> dict[str, Plain]:
    """Return where verification differs from COLMAP's defaults, by pycolmap's dotted keys."""
    return differences(two_view_options(options, random_seed), pycolmap.TwoViewGeometryOptions())


def verify(path: Path, options: VerificationOptions, random_seed: int) -> None:
    """Estimate the two-view geometry of every matched pair that has none yet.

    By ``pycolmap.geometric_verification``, which keeps the raw matches;
    ``pycolmap.verify_matches`` would match again and delete.
    """
    require_database_space(path, num_unverified_pairs(path))
    run_cancellable(
        lambda token: pycolmap.geometric_verification(
            path,
            two_view_geometry_options=two_view_options(options, random_seed),
            cancellation_token=token,
        )
    )


class PairVerifier:
    """Tries matches of single pairs as :func:`verify` would, without writing anything.

    With the same seed the result is that of :func:`verify` on a database with these matches
    (pinned by a test).
    """

    def __init__(self, path: Path, options: VerificationOptions, random_seed: int) -> None:
        """Read cameras and image ids of a database."""
        self.options = two_view_options(options, random_seed)
        with open_database(path) as database:
            cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
            images = database.read_all_images()
        self._images = {image.name: (image.image_id, cameras[image.camera_id]) for image in images}

    def num_inliers(
        self,
        names: tuple[str, str],
        keypoints: tuple[NDArray[np.floating], NDArray[np.floating]],
        indices: NDArray[np.integer],
    ) -> int:
        """Return the number of inliers of a two-view geometry, 0 if there is none.

        Args:
            names: of the two images.
            keypoints: (N1, 2) and (N2, 2) in pixel-centre px.
            indices: (M, 2) matches.
        """
        sides = [
            (*self._images[name], points) for name, points in zip(names, keypoints, strict=True)
        ]
        if sides[0][0] > sides[1][0]:
            sides, indices = sides[::-1], indices[:, ::-1]
        (_, camera1, points1), (_, camera2, points2) = sides
        geometry = pycolmap.estimate_two_view_geometry(
            camera1,
            stored_keypoints(points1),
            camera2,
            stored_keypoints(points2),
            indices.astype(np.uint32),
            self.options,
        )
        # Of a geometry that it rejects the estimator returns the inliers all the same.
        return 0 if geometry.config in REJECTED else len(geometry.inlier_matches)


def stored_keypoints(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return (N, 2) pixel-centre points as COLMAP reads them from a database: through float32."""
    return colmap_from_pixel(points.astype(np.float32)).astype(np.float64)


def verified_pairs(path: Path, min_num_inliers: int) -> dict[tuple[int, int], int]:
    """Return the number of inliers of each verified pair of image ids."""
    with open_database(path) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    return {
        pycolmap.pair_id_to_image_pair(pair_id): int(count)
        for pair_id, count in zip(pair_ids, counts, strict=True)
        if count >= min_num_inliers
    }


def inlier_matches(path: Path, min_num_inliers: int) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return the (M, 2) features of each verified pair of image ids that are inliers."""
    with open_database(path) as database:
        pair_ids, geometries = database.read_two_view_geometries()
    return {
        pycolmap.pair_id_to_image_pair(pair_id): np.asarray(geometry.inlier_matches, np.int64)
        for pair_id, geometry in zip(pair_ids, geometries, strict=True)
        if len(geometry.inlier_matches) >= min_num_inliers
    }
