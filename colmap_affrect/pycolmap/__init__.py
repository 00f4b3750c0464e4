"""pycolmap with rectified features: ``from colmap_affrect import pycolmap``.

A script that imports this in the place of pycolmap runs on: functions of ours replace pycolmap's of
the same name, and every other name is pycolmap's own.
"""

from typing import TYPE_CHECKING, Any

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
    "extract_features", "incremental_mapping", "match_exhaustive", "match_image_pairs",
    "match_sequential", "match_spatial", "verify_matches",
]  # fmt: skip

if TYPE_CHECKING:
    from pycolmap import __version__, _core
    from pycolmap._core import *  # type: ignore[assignment] # noqa: F403

    __all__ += ["__version__"]
    __all__ += _core.__all__
else:
    __all__ += [
        name for name in pycolmap.__all__ if name not in (*__all__, "match_vocabtree")
    ]
    globals().update(
        {name: getattr(pycolmap, name) for name in __all__ if name not in globals()}
    )

    def __getattr__(name: str) -> Any:
        if name == "match_vocabtree":
            raise AttributeError(
                f"{name}: a vocabulary tree is of SIFT; use match_sequential with loop_detection, "
                "or colmap_affrect.run with PairOptions(methods=('retrieval',))"
            )
        if name.startswith("__"):  # of the module itself, such as __path__
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(pycolmap, name)
