"""Examines a COLMAP database, in a copy."""

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from colmap_affrect.colmap.checks import CHECKS, check_database, check_image_files
from colmap_affrect.colmap.database_copy import (
    copy_as_it_is,
    is_stamped,
    newest_schema_version,
    schema_version,
)
from colmap_affrect.doctor.findings import Findings, without_path
from colmap_affrect.errors import DatabaseError
from colmap_affrect.images.reading import readable_size
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import Progress
from colmap_affrect.project.outputs import leads_outside


def examine_database(findings: Findings, path: Path, image_path: Path | None) -> None:
    """Examine a COLMAP database, and its photographs if their folder is given."""
    with examined_copy(findings, path, image_path, {}):
        pass


@contextmanager
def examined_copy(
    findings: Findings, path: Path, image_path: Path | None, own_advice: Mapping[str, str]
) -> Iterator[Path | None]:
    """Examine a copy of a database and yield it, None if it cannot be used.

    The sizes of photographs are compared if their folder is given; ``own_advice`` says what to do
    about a problem by its kind, where it is not what ``TEXTS`` says.
    """
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / "database.db"
        try:
            version, newest = schema_version(path), newest_schema_version()
            copy_as_it_is(path, copy)
        except DatabaseError as error:
            message = without_path(path, error).replace(str(copy), "a temporary file")
            findings.add("no-database", path, error=message)
            yield None
            return
        if version < newest:
            kind = "stamped" if is_stamped(path) else "old-schema"
            kept = path.with_suffix(".old.db")
            findings.add(kind, path, version=version, newest=newest, path=path, copy=kept)
        try:
            tables, problems = check_database(copy)
        except DatabaseError as error:
            findings.add("database-damaged", path, error=without_path(copy, error))
            yield None
            return
        findings.checked.append(f"{path}: {tables.summary()}")
        if image_path is not None:
            sizes = _file_sizes(image_path, tables.names.values(), findings.progress)
            problems |= check_image_files(tables, image_path, sizes)
            findings.checked.append(f"{image_path}: sizes of {len(sizes)} photographs")
        for kind in sorted(problems, key=list(CHECKS).index):
            advice = own_advice.get(kind, "")
            findings.add(kind, path, problems[kind], advice=advice, path=path, folder=path.parent)
        yield copy


def _file_sizes(
    image_path: Path, names: Iterable[str], progress: Progress
) -> dict[str, tuple[int, int] | None]:
    """Read photographs for their (width, height), None for those that cannot be read."""
    present = [n for n in names if not leads_outside(n) and (image_path / n).is_file()]
    sizes = {}
    with progress.stage("read", len(present), "images") as advance:
        paths = (image_path / name for name in present)
        found = map_ordered(readable_size, paths, available_cores())
        for name, size in zip(present, found, strict=True):
            sizes[name] = size
            advance(1)
    return sizes
