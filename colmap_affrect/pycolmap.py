"""pycolmap with rectified features: ``from colmap_affrect import pycolmap``.

A script that imports this in the place of pycolmap runs on: functions of ours replace pycolmap's of
the same name, and every other name is pycolmap's own.
"""

from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.interop.pycolmap_api import (
    extract_features,
    incremental_mapping,
    match_exhaustive,
    match_image_pairs,
    match_sequential,
    match_spatial,
    verify_matches,
)

__all__ = [
    "extract_features",
    "incremental_mapping",
    "match_exhaustive",
    "match_image_pairs",
    "match_sequential",
    "match_spatial",
    "verify_matches",
]


def __getattr__(name: str) -> Any:
    if name == "match_vocabtree":
        raise AttributeError(
            f"{name}: a vocabulary tree is of SIFT; use match_sequential with loop_detection, or "
            "colmap_affrect.run with PairOptions(methods=('retrieval',))"
        )
    return getattr(pycolmap, name)
