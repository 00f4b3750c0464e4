"""Reconstruct with SIFT as pycolmap does it, or with rectified features: one line differs.

python reconstruct.py photos out            # rectified features
python reconstruct.py photos out --sift     # COLMAP's SIFT
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pycolmap

import colmap_affrect


def main() -> None:
    """Make features, match all pairs, map, and say what was registered."""
    parser = argparse.ArgumentParser(
        description="A pycolmap script with the features replaced."
    )
    parser.add_argument("image_path", type=Path)
    parser.add_argument("output_path", type=Path)
    parser.add_argument(
        "--sift", action="store_true", help="COLMAP's SIFT, for comparison"
    )
    options = parser.parse_args()
    options.output_path.mkdir(parents=True, exist_ok=True)
    database_path = options.output_path / "database.db"

    features = pycolmap if options.sift else colmap_affrect
    features.extract_features(database_path, options.image_path)
    features.match_exhaustive(database_path)

    # Two-view tracks are all that a sparse set has at many places; COLMAP ignores them by default.
    mapping = pycolmap.IncrementalPipelineOptions(random_seed=0)
    mapping.triangulation.ignore_two_view_tracks = False
    models = pycolmap.incremental_mapping(
        database_path, options.image_path, options.output_path, mapping
    )
    for index, model in models.items():
        print(
            f"model {index}: {model.num_reg_images()} images, {model.num_points3D()} points"
        )


if __name__ == "__main__":
    main()
