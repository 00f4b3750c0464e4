"""Rectified wide-baseline features for COLMAP.

Photographs in, COLMAP model out: ``colmap_affrect.run(image_path, output_path)``. The public names
are those of ``__init__.pyi``; they are loaded when first used, so that importing the package stays
light: these are the first lines of a command, too, which Ctrl-C may already meet.
"""

import sys
import zlib

__version__ = "0.1.0"

# The wheels of pycolmap 4.2 export zlib's symbols: if libz is first loaded by
# "import pycolmap", the process dies or hangs when it compresses. Loading it before, as numpy does
# too, keeps both working; after, it must not be touched.
_first = next(n for n in sys.modules if n.partition(".")[0] in {"numpy", "pycolmap", "zlib"})
PYCOLMAP_CAME_FIRST = _first.startswith("pycolmap")
if not PYCOLMAP_CAME_FIRST:
    zlib.decompress(zlib.compress(b"warm"))


def _public_names() -> dict[str, str]:
    """Return the module of each public name, by the stub."""
    found = {}
    with open(f"{__file__}i", encoding="utf-8") as stub:  # noqa: PTH123 (pathlib takes time)
        for line in stub:
            if line.startswith("from "):
                _, module, _, name, *_ = line.split()
                found[name] = module
    return found


_PUBLIC = _public_names()

__all__ = ["__version__"]
__all__ += list(_PUBLIC)


def __dir__() -> list[str]:
    return [*globals(), *_PUBLIC]


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_PUBLIC[name]), name)
