"""Geometric verification of raw matches by pycolmap."""

from __future__ import annotations

from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.running import run_cancellable
from colmap_affrect.options import VerificationOptions


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


def verify(path: Path, options: VerificationOptions, random_seed: int) -> None:
    """Estimate the two-view geometry of every matched pair that has none yet.

    By ``pycolmap.geometric_verification``, which keeps the raw matches;
    ``pycolmap.verify_matches`` would match again and delete.
    """
    run_cancellable(
        lambda token: pycolmap.geometric_verification(
            path,
            two_view_geometry_options=two_view_options(options, random_seed),
            cancellation_token=token,
        )
    )


def verified_pairs(path: Path, min_num_inliers: int) -> dict[tuple[int, int], int]:
    """Return the number of inliers of each verified pair of image ids."""
    with open_database(path) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    return {
        pycolmap.pair_id_to_image_pair(pair_id): int(count)
        for pair_id, count in zip(pair_ids, counts, strict=True)
        if count >= min_num_inliers
    }
