"""COLMAP through pycolmap, imported here and nowhere else.

The wheels of pycolmap 4.1 and 4.2 export zlib's symbols: if Python's zlib is first used
after ``import pycolmap`` the process dies. Using it once before keeps both working.
"""

import zlib

from colmap_affrect.files import uninterrupted

zlib.decompress(zlib.compress(b"warm"))

with uninterrupted():  # pycolmap takes Ctrl-C in its import for a broken installation
    import pycolmap

__all__ = ["pycolmap"]
