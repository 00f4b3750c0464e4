"""What input files hold: SHA-256 digests, kept with size and times so that an idle run reads none.

The digest of what an image was extracted from is stored with its features; here is only what saves
reading files again, and the digests of what a database and a list of pairs were made from.
"""

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from colmap_affrect.errors import DAMAGE
from colmap_affrect.project.atomic_files import replace_text


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Contents:
    """Digests of files; those whose size and times are on record are not read again."""

    def __init__(self, path: Path) -> None:
        """Read a record; one that is missing or damaged only means that files are read again."""
        self._path, self._known, self.is_damaged = path, dict[str, Any](), path.exists()
        with suppress(*DAMAGE):
            self._known = dict(json.loads(path.read_text(encoding="utf-8")))
            self.is_damaged = False
        self._is_saved = True

    def sha256(self, path: Path) -> str:
        """Return the digest of a file, empty if it cannot be read."""
        try:
            there = path.stat()
            stamp = [there.st_size, there.st_mtime_ns, there.st_ctime_ns]
            known = self._known.get(str(path))
            if not isinstance(known, list) or known[:-1] != stamp:
                known = [*stamp, sha256_of(path)]
                self._set(str(path), known)
            return str(known[-1])
        except OSError:
            return ""

    def digest(self, paths: Iterable[Path]) -> str:
        """Return a digest of several files in their order: that of the file if it is only one."""
        digests = [self.sha256(path) for path in paths]
        if len(digests) == 1:
            return digests[0]
        return hashlib.sha256("\n".join(digests).encode()).hexdigest() if digests else ""

    def recorded(self, purpose: str) -> str:
        """Return the digest of what something was made from, empty if it is not known."""
        return str(self._known.get(f":{purpose}", ""))

    def record(self, purpose: str, digest: str) -> None:
        """Put on record what something is made from now."""
        self._set(f":{purpose}", digest)
        self.save()

    def _set(self, key: str, value: object) -> None:
        if self._known.get(key) != value:
            self._known[key], self._is_saved = value, False

    def save(self) -> None:
        """Write the record if anything in it is new."""
        if not self._is_saved:
            replace_text(self._path, json.dumps(self._known, indent=0, sort_keys=True))
            self._is_saved = True
