"""What is asked of all images of a file of features, kept so that thousands need not be opened."""

import json
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from colmap_affrect.errors import DAMAGE, WorkspaceError
from colmap_affrect.project.atomic_files import replace_text

Size = tuple[int, int]
Entries = dict[str, tuple[str, int, Size]]
"""By image: the digest of the files that it was extracted from, the number of features, and
(width, height) in px."""

MIN_NUM_KEPT = 500  # fewer are read as fast
MIN_AGE_NS = 1_000_000_000  # a file may change again within it without another time
_known: dict[Path, tuple[list[int], Entries]] = {}


def forget(path: Path) -> None:
    """Forget what a file holds that is going to change."""
    _known.pop(path, None)


def entries(path: Path, read: Callable[[], Entries]) -> Entries:
    """Return what a file holds; it is read only when it has changed since it was read before."""
    there = path.stat()
    stamp = [there.st_ino, there.st_size, there.st_mtime_ns, there.st_ctime_ns]
    kept = path.with_name(f".{path.name}.index")
    if path not in _known:
        with suppress(*DAMAGE):
            checksum, _, text = kept.read_text(encoding="utf-8").partition(" ")
            found = json.loads(text if checksum == _checksum(text) else "")
            _known[path] = found[0], {n: (c, k, (w, h)) for n, (c, k, (w, h)) in found[1].items()}
    if path not in _known or _known[path][0] != stamp:
        _known[path] = stamp, dict(sorted(read().items()))
        if len(_known[path][1]) >= MIN_NUM_KEPT and time.time_ns() > stamp[3] + MIN_AGE_NS:
            with suppress(WorkspaceError):
                text = json.dumps(_known[path])
                replace_text(kept, f"{_checksum(text)} {text}")
    return _known[path][1]


def _checksum(text: str) -> str:
    return str(zlib.crc32(text.encode()))
