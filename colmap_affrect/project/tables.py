"""Tables that the user gives: CSV files with a header."""

import csv
from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.errors import OptionError
from colmap_affrect.options import suggestion


def read_lines(path: Path, where: str) -> list[str]:
    """Return the lines of a text file; OptionError, which begins with ``where``, if it has none."""
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OptionError(f"{where}: cannot be read ({reason})") from error


def read_table(
    path: Path, where: str, columns: Sequence[str], key: str = "name"
) -> list[tuple[str, dict[str, str]]]:
    """Return the rows of a CSV file, without empty cells, and for each the place to name.

    It may have the columns in any order, and must have ``key``: else OptionError, which begins
    with ``where``, such as ``--cameras-path FILE``.
    """
    reader = csv.reader(read_lines(path, where), skipinitialspace=True)
    try:
        rows = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise OptionError(f"{where}, line {reader.line_num}: {error}") from error
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(f"{where}: separate cells by commas, and write numbers with a point")
    for column in header:
        if column not in columns:
            raise OptionError(f"{where}: unknown column '{column}'{suggestion(column, columns)}")
    if key not in header or len(set(header)) < len(header):
        raise OptionError(f"{where}: its first line must have the column '{key}', and each once")
    found = []
    for number, cells in rows[1:]:
        place = f"{where}, line {number}"
        if len(cells) > len(header):
            raise OptionError(
                f"{place}: has {len(cells)} cells and the first line {len(header)}; values with "
                'commas need quotes, "1437,1440,792,524"'
            )
        row = {k: cell.strip() for k, cell in zip(header, cells, strict=False) if cell.strip()}
        if row:
            found.append((place, row))
    return found
