"""Records in JSON that later commands go on with: each has a digest of what it holds.

Numbers that an editor or a failing disk has changed would be taken for what was found. The digest
is of the values, so that a file that is only laid out anew, or saved with a mark of UTF-8, is
as it was. Files of versions before have none.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.regular_files import read_regular_text

DIGEST = "sha256"
"""Key of the digest of all other values."""


def write_sealed(path: Path, content: str | bytes) -> None:
    """Replace a file by a JSON object and its digest.

    Args:
        path: of the file.
        content: the object, as JSON, without the digest.
    """
    values = json.loads(content)
    values[DIGEST] = _digest(values)
    text = json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
    replace_text(path, f"{text}\n")


def read_sealed(path: Path) -> dict[str, Any]:
    """Return the values of such a file, without the digest.

    ValueError where it does not hold what was written, OSError where it cannot be read.
    """
    values = json.loads(read_regular_text(path, "utf-8-sig"), parse_constant=_refuse)
    if not isinstance(values, dict):
        raise ValueError("it holds no names with values")
    known = values.pop(DIGEST, None)
    if known is not None and known != _digest(values):
        raise ValueError("it is not as it was written")
    return values


def _digest(values: dict[str, Any]) -> str:
    ordered = json.dumps(values, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(ordered.encode()).hexdigest()


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no number")
