"""Rectified wide-baseline features for COLMAP.

Photographs in, COLMAP model out: ``colmap_affrect.run(image_path, output_path)``. The
public names are loaded when first used, so that importing the package stays light.
"""

import importlib
import logging
import sys
import zlib
from typing import Any

__version__ = "0.1.0"

# The wheels of pycolmap 4.2 export zlib's symbols: if libz is first loaded by
# "import pycolmap", the process dies or hangs when it compresses. Loading it before, as numpy does
# too, keeps both working; after, it must not be touched.
_first = next(n for n in sys.modules if n.partition(".")[0] in {"numpy", "pycolmap", "zlib"})
PYCOLMAP_CAME_FIRST = _first.startswith("pycolmap")
if not PYCOLMAP_CAME_FIRST:
    zlib.decompress(zlib.compress(b"warm"))

logging.getLogger(__name__).addHandler(logging.NullHandler())

_PUBLIC = {
    "AffrectError": "colmap_affrect.errors",
    "CameraOptions": "colmap_affrect.images.photographs",
    "CompareOptions": "colmap_affrect.comparison.compare",
    "Comparison": "colmap_affrect.comparison.results",
    "EvaluateOptions": "colmap_affrect.evaluation.evaluate",
    "Evaluation": "colmap_affrect.evaluation.results",
    "Extension": "colmap_affrect.mappers.existing",
    "ExtractionOptions": "colmap_affrect.recipes",
    "LocalFeatures": "colmap_affrect.data",
    "IncrementalOptions": "colmap_affrect.mappers.incremental",
    "SparseOptions": "colmap_affrect.mappers.sparse",
    "NearestOptions": "colmap_affrect.matchers.nearest",
    "PairOptions": "colmap_affrect.pairs.lists",
    "ReconstructionReport": "colmap_affrect.project.report",
    "RunOptions": "colmap_affrect.pipeline",
    "VerificationOptions": "colmap_affrect.colmap.verification",
    "MaskOptions": "colmap_affrect.images.photographs",
    "compare": "colmap_affrect.comparison.compare",
    "evaluate": "colmap_affrect.evaluation.evaluate",
    "extract_features": "colmap_affrect.interop.pycolmap_api",
    "load_recipe": "colmap_affrect.recipes",
    "incremental_mapping": "colmap_affrect.interop.pycolmap_api",
    "map_from_database": "colmap_affrect.pipeline",
    "match_exhaustive": "colmap_affrect.interop.pycolmap_api",
    "match_image_pairs": "colmap_affrect.interop.pycolmap_api",
    "match_sequential": "colmap_affrect.interop.pycolmap_api",
    "match_spatial": "colmap_affrect.interop.pycolmap_api",
    "run": "colmap_affrect.pipeline",
    "verify": "colmap_affrect.interop.pycolmap_api",
    "verify_matches": "colmap_affrect.interop.pycolmap_api",
}

__all__ = ["__version__"]
__all__ += list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)
