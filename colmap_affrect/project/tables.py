"""Tables that the user gives: CSV files with a header."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from colmap_affrect.errors import Option, OptionError, Row, not_utf_8
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


class CellsOfRow(NamedTuple):
    """What a table says in one row."""

    place: Row  # for errors
    cells: dict[str, str]  # by column, without empty ones


def read_table(
    path: Path,
    option: str,
    columns: Sequence[str],
    key: str = "name",
    usual: Sequence[str] = (),
) -> list[CellsOfRow]:
    """Read a CSV file whose first line names its columns, in any order.

    Args:
        path: the file.
        option: that the file came by, for errors; such as ``cameras-path``.
        columns: that the table may have.
        key: column that it must have; empty for none.
        usual: columns of a table without a header, whose first line names no column; empty where
            a table must have one.

    Returns:
        The rows that have a cell which is not empty.

    Raises:
        OptionError: the file cannot be read, or is no such table.
    """
    where = Option(option, path)
    lines = _read_lines(path, where)
    header = [cell.lower() for cell in lines[0][1]] if lines else []
    if usual and header and not set(header).intersection(columns):
        header = list(usual)
    else:
        lines = lines[1:]
    _check_header(header, where, columns, key)
    rows = []
    for number, cells in lines:
        if len(cells) > len(header):
            raise OptionError(
                f"has {len(cells)} cells and the first line {len(header)}",
                where=Row(where, f"line {number}"),
                advice='values with commas need quotes, "1437,1440,792,524"',
            )
        values = {}
        for column, cell in zip(header, cells, strict=False):
            if cell:
                values[column] = cell
        rows.append(CellsOfRow(Row(where, f"line {number}"), values))
    return rows


def _read_lines(path: Path, where: Option) -> list[tuple[int, list[str]]]:
    """Return the number and the cells of each line that is not empty."""
    lines = []
    try:
        text = read_regular_text(path, "utf-8-sig")
        reader = csv.reader(text.splitlines(), skipinitialspace=True)
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                lines.append((reader.line_num, cells))
    except UnicodeDecodeError as error:
        raise not_utf_8(where) from error
    except (OSError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise OptionError(f"cannot be read ({reason})", where=where) from error
    return lines


def _check_header(
    header: Sequence[str], where: Option, columns: Sequence[str], key: str
) -> None:
    """Refuse a header with other columns, twice the same one, or without the key; OptionError."""
    if len(header) == 1 and ";" in header[0]:
        raise OptionError(
            "separate cells by commas, and write numbers with a point", where=where
        )
    for column in header:
        if column not in columns:
            raise OptionError(
                f"unknown column '{column}'{suggestion(column, sorted(columns))}",
                where=where,
            )
    if (key and key not in header) or len(set(header)) < len(header):
        must = key or columns[0]
        raise OptionError(
            f"its first line must have the column '{must}', and each once", where=where
        )
