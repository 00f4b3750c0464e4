"""Files of records, one JSON object a line, that grow line by line and survive being cut off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from colmap_affrect.errors import StaleStoreError
from colmap_affrect.project.atomic_files import cannot_write, replace_bytes
from colmap_affrect.project.workspace import first_difference


class RecordFile:
    """Records that were all made with the same settings, which are the first line.

    A last line that is not complete, of a run that was killed, does not count.

    Attributes:
        records: all that are there, in order.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        """Read the file, or begin it; StaleStoreError when it has records of other settings."""
        self._path = path
        header = json.loads(json.dumps(settings))
        content = path.read_bytes() if path.exists() else b""
        complete = content[: content.rfind(b"\n") + 1]
        lines = [json.loads(line) for line in complete.decode("utf-8").split("\n")[:-1]]
        if lines and (difference := first_difference(lines[0], header)):
            raise StaleStoreError(
                f"{path}: was made with {difference}; use --overwrite to discard it, another name "
                "(NAME=RECIPE), or another --output-path"
            )
        if not lines:
            complete = _line(header)
            path.parent.mkdir(parents=True, exist_ok=True)
        if complete != content:
            replace_bytes(path, complete)
        self.records: list[dict[str, Any]] = lines[1:]

    def append(self, record: Mapping[str, Any]) -> None:
        """Add a record; WorkspaceError when it cannot be written."""
        try:
            with self._path.open("ab") as file:
                file.write(_line(record))
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self.records.append(dict(record))


def _line(values: Mapping[str, Any]) -> bytes:
    return json.dumps(values, ensure_ascii=False).encode("utf-8") + b"\n"
