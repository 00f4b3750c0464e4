"""COLMAP's global mapper in a process of its own.

``pycolmap.global_mapping`` takes no cancellation token: only the end of its process stops it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

from colmap_affrect.children import child, end_with_parent
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.native_options import Plain, set_values
from colmap_affrect.errors import MappingError
from colmap_affrect.executor import return_freed_memory


def map_globally(
    database_path: Path, image_path: Path, output_path: Path, values: Mapping[str, Plain]
) -> None:
    """Map a verified database; models go into ``output_path``/0, /1, ...

    Args:
        database_path: database with two-view geometries.
        image_path: folder of the images, for the colours of the points.
        output_path: an empty folder.
        values: what differs from the default ``pycolmap.GlobalPipelineOptions``.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped.
    """
    return_freed_memory()
    paths = [str(path.resolve()) for path in (database_path, image_path, output_path)]
    with child(__name__, json.dumps([*paths, dict(values)])) as process:
        printed = process.stdout.read() if process.stdout else ""
    code = process.returncode
    if code:
        reason = (printed.splitlines() or ["run.log in the output folder may say more"])[-1]
        raise MappingError(f"COLMAP's global mapper failed (exit code {code}): {reason}")


def main() -> None:
    """Map as the argument says."""
    database_path, image_path, output_path, values = json.loads(sys.argv[1])
    end_with_parent()
    options = pycolmap.GlobalPipelineOptions()
    set_values(options, values)
    try:
        pycolmap.global_mapping(database_path, image_path, output_path, options=options)
    except (RuntimeError, ValueError) as error:
        sys.stdout.write("\n" + " ".join(str(error).split()))
        raise


if __name__ == "__main__":
    main()
