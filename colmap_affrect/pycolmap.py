"""pycolmap with rectified features: ``from colmap_affrect import pycolmap``.

A script that imports this in the place of pycolmap runs on: functions of ours replace pycolmap's of
the same name, and every other name is pycolmap's own.
"""

from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.interop.pycolmap_api import (
    extract_features,
    match_exhaustive,
    match_image_pairs,
    match_sequential,
    match_spatial,
    verify_matches,
)
from colmap_affrect.interop.pycolmap_mapping import incremental_mapping

__all__ = [
    "extract_features",
    "incremental_mapping",
    "match_exhaustive",
    "match_image_pairs",
    "match_sequential",
    "match_spatial",
    "verify_matches",
]

REPLACED = {
    "match_vocabtree": "run(..., RunOptions(pairs=PairOptions(methods=('retrieval',)))), or "
    "match_sequential with loop_detection: no vocabulary tree is needed",
    "geometric_verification": "verify",
    "guided_geometric_verification": "match_exhaustive with guided_matching=True",
    "Sift": "extract_image",
}
"""What of colmap_affrect does the work of names of pycolmap that are for SIFT."""


def __getattr__(name: str) -> Any:
    if name == "match_vocabtree":
        raise AttributeError(f"{name}: use colmap_affrect.{REPLACED[name]}")
    return getattr(pycolmap, name)


def hint(name: str) -> str:
    """Return what to use for a name of pycolmap that is not in colmap_affrect; may be empty."""
    if name in REPLACED:
        return f"; use colmap_affrect.{REPLACED[name]}"
    if hasattr(pycolmap, name):
        return f"; pycolmap.{name} works with it, as does 'from colmap_affrect import pycolmap'"
    return ""
