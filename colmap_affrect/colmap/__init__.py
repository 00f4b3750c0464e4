"""COLMAP through pycolmap, imported here and nowhere else.

The wheels of pycolmap 4.1 and 4.2 export zlib's symbols: if Python's zlib is first used
after ``import pycolmap`` the process dies. Using it once before keeps both working.
"""

import zlib

zlib.decompress(zlib.compress(b"warm"))

import pycolmap  # noqa: E402  (must follow the use of zlib)

__all__ = ["pycolmap"]
