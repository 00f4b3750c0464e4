"""Tables that the user gives: CSV files with a header."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.errors import OptionError
from colmap_affrect.options import suggestion
from colmap_affrect.project.regular_files import read_regular_text


def as_row(cells: Sequence[str]) -> str:
    """Return cells as a row of a table: joined by commas, in quotes where they hold one.

    >>> as_row(["a.png", "b,c.png"])
    'a.png,"b,c.png"'
    """
    row = io.StringIO()
    csv.writer(row, lineterminator="").writerow(cells)
    return row.getvalue()


def read_table(
    path: Path, where: str, columns: Sequence[str], key: str = "name", usual: Sequence[str] = ()
) -> list[tuple[str, dict[str, str]]]:
    """Return the rows of a CSV file, without empty cells, and for each the place to name.

    It may have the columns in any order, and must have ``key``: else OptionError, which begins
    with ``where``, such as ``--cameras-path FILE``. A table with a ``usual`` header may
    leave that out: then its first line names no column.
    """
    try:
        reader = csv.reader(
            read_regular_text(path, "utf-8-sig").splitlines(), skipinitialspace=True
        )
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise OptionError(f"{where}: cannot be read ({reason})") from error
    rows = [(number, cells) for number, cells in lines if any(cells)]
    header = [cell.lower() for cell in rows[0][1]] if rows else []
    if usual and header and not {*header} & {*columns}:
        header, rows = list(usual), [(0, []), *rows]
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(f"{where}: separate cells by commas, and write numbers with a point")
    if unknown := [column for column in header if column not in columns]:
        raise OptionError(
            f"{where}: unknown column '{unknown[0]}'{suggestion(unknown[0], columns)}"
        )
    if (key and key not in header) or len(set(header)) < len(header):
        must = key or columns[0]
        raise OptionError(f"{where}: its first line must have the column '{must}', and each once")
    for number, cells in rows[1:]:
        if len(cells) > len(header):
            raise OptionError(
                f"{where}, line {number}: has {len(cells)} cells and the first line {len(header)}; "
                'values with commas need quotes, "1437,1440,792,524"'
            )
    return [
        (f"{where}, line {number}", {k: v for k, v in zip(header, cells, strict=False) if v})
        for number, cells in rows[1:]
    ]
