"""Rectified wide-baseline features for COLMAP.

Photographs in, COLMAP model out: ``colmap_affrect.run(image_path, output_path)``. The public names
are those of ``__init__.pyi``; they are loaded when first used, so that importing the package stays
light.
"""

import importlib
import logging
import re
import sys
import zlib
from pathlib import Path
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

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_PUBLIC = {n: module for module, n in re.findall(r"^from (\S+) import (\w+)", _STUB, re.MULTILINE)}

__all__ = ["__version__"]
__all__ += list(_PUBLIC)


def __dir__() -> list[str]:
    return [*globals(), *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)
