"""Geometric verification of raw matches by pycolmap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_cancellable
from colmap_affrect.colmap.database import (
    num_unverified_pairs,
    open_database,
    require_database_space,
)
from colmap_affrect.colmap.native_options import Plain, differences
from colmap_affrect.conventions import colmap_from_pixel
from colmap_affrect.options import CUSTOM, MAX_SEED, PRESETS, Options, preset_values, within


class VerificationOptions(Options):
    """Two-view geometry, by default the sparse preset (names as in pycolmap)."""

    max_error_px: Annotated[float, within(0.01, 1000.0)] = 3.0
    min_num_inliers: Annotated[int, within(5, 1_000_000)] = 20
    """COLMAP's 15 is what 100 random matches reach."""
    min_inlier_ratio: Annotated[float, within(0.0, 1.0)] = 0.20
    """COLMAP's 0 accepts random matches once there are many of them."""
    max_num_trials: Annotated[int, within(1, 100_000_000)] = 10000
    ransac_min_inlier_ratio: Annotated[float, within(0.0, 1.0)] = 0.10
    random_seed: Annotated[int, within(-1, MAX_SEED)] = 0

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "max_error_px": 4.0,
        "min_num_inliers": 15,
        "min_inlier_ratio": 0.0,
        "max_num_trials": 10000,
        "ransac_min_inlier_ratio": 0.25,
    }
    """The preset ``colmap``: COLMAP's own defaults."""

    @classmethod
    def preset(cls, preset: str, **values: Any) -> Self:
        """Return the options of a preset, ``sparse`` or ``colmap``, and others given."""
        return cls(**{**preset_values(preset, cls.COLMAP), **values})

    @property
    def preset_name(self) -> str:
        """Name of the preset that these options are, else ``custom``."""
        seed = {"random_seed": self.random_seed}
        return next((name for name in PRESETS if self == self.preset(name, **seed)), CUSTOM)


REJECTED = (
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
)


def two_view_options(options: VerificationOptions) -> pycolmap.TwoViewGeometryOptions:
    """Translate our options into pycolmap's."""
    return pycolmap.TwoViewGeometryOptions(
        min_num_inliers=options.min_num_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
        ransac=dict(
            max_error=options.max_error_px,
            min_inlier_ratio=options.ransac_min_inlier_ratio,
            max_num_trials=options.max_num_trials,
            random_seed=options.random_seed,
        ),
    )


def verification_differences(options: VerificationOptions) -> dict[str, Plain]:
    """Return where verification differs from COLMAP's defaults, by pycolmap's dotted keys."""
    return differences(two_view_options(options), pycolmap.TwoViewGeometryOptions())


def verify(path: Path, options: VerificationOptions) -> None:
    """Estimate the two-view geometry of every matched pair that has none yet.

    By ``pycolmap.geometric_verification``, which keeps the raw matches;
    ``pycolmap.verify_matches`` would match again and delete.
    """
    require_database_space(path, num_unverified_pairs(path))
    run_cancellable(
        lambda token: pycolmap.geometric_verification(
            path,
            two_view_geometry_options=two_view_options(options),
            cancellation_token=token,
        )
    )


class PairVerifier:
    """Tries matches of single pairs as :func:`verify` would, without writing anything.

    With the same seed the result is that of :func:`verify` on a database with these matches
    (pinned by a test).
    """

    def __init__(self, path: Path, options: VerificationOptions) -> None:
        """Read cameras and image ids of a database."""
        self.options = two_view_options(options)
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
        geometry = self.geometry(names, keypoints, indices)
        return len(geometry.inlier_matches) if geometry else 0

    def geometry(
        self,
        names: tuple[str, str],
        keypoints: tuple[NDArray[np.floating], NDArray[np.floating]],
        indices: NDArray[np.integer],
    ) -> pycolmap.TwoViewGeometry | None:
        """Return the two-view geometry, from the image with the lower id to the other one.

        Arguments are those of :meth:`num_inliers`; None if there is none.
        """
        sides = [
            (*self._images[name], points) for name, points in zip(names, keypoints, strict=True)
        ]
        if sides[0][0] > sides[1][0]:
            sides, indices = sides[::-1], indices[:, ::-1]
        _, cameras, points = zip(*sides, strict=True)
        return two_view_geometry(cameras, points, indices, self.options)


def num_two_view_inliers(
    cameras: Sequence[pycolmap.Camera],
    keypoints: Sequence[NDArray[np.floating]],
    indices: NDArray[np.integer],
    options: pycolmap.TwoViewGeometryOptions,
) -> int:
    """Return the number of inliers of :func:`two_view_geometry`, 0 without one."""
    geometry = two_view_geometry(cameras, keypoints, indices, options)
    return len(geometry.inlier_matches) if geometry else 0


def two_view_geometry(
    cameras: Sequence[pycolmap.Camera],
    keypoints: Sequence[NDArray[np.floating]],
    indices: NDArray[np.integer],
    options: pycolmap.TwoViewGeometryOptions,
) -> pycolmap.TwoViewGeometry | None:
    """Estimate the geometry of (M, 2) matches of two images; None where there is none.

    Keypoints are (N1, 2) and (N2, 2) in pixel-centre px.
    """
    stored1, stored2 = map(stored_keypoints, keypoints)
    geometry = pycolmap.estimate_two_view_geometry(
        cameras[0], stored1, cameras[1], stored2, indices.astype(np.uint32), options
    )
    # Of a geometry that it rejects the estimator returns the inliers all the same.
    return None if geometry.config in REJECTED else geometry


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
