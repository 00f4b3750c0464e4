"""The table of methods that finished, on the page and in the terminal; and JSON."""

import itertools
import json
import string
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from pydantic import TypeAdapter

from colmap_affrect.comparison.results import MEASURES, Comparison, Measure, MethodResult, Span
from colmap_affrect.comparison.verdict import ranked, verdict
from colmap_affrect.project.record import STAGES

METHOD_COLORS = (
    "#0b62a8", "#a34700", "#00714f", "#9b2d79", "#5d4bb0", "#7a5c00", "#a3213b", "#46606e",
)  # fmt: skip
"""Of the marks of methods; white text on them is readable."""

MAIN_ROWS = {
    "registered", "correct", "num_models", "verified_pairs", "points3D", "mean_track_length",
    "total_s",
}  # fmt: skip
"""Rows that decide; the others are folded away."""

BYTES_PER_MB = 1_000_000
NOTHING = "-"  # where there is no number
WIDTH = 88  # of the verdict in the terminal


@dataclass(frozen=True)
class Column:
    """A method that finished, as it is marked everywhere on the page."""

    letter: str
    color: str
    method: MethodResult

    @property
    def name(self) -> str:
        """Of the method."""
        return self.method.name


def columns_of(comparison: Comparison) -> list[Column]:
    """Give each method that finished a letter and a colour, the best first."""
    letters = [*string.ascii_uppercase, *map(str, range(27, len(comparison.finished) + 1))]
    marks = zip(letters, itertools.cycle(METHOD_COLORS), ranked(comparison.finished), strict=False)
    return [Column(*mark) for mark in marks]


@dataclass(frozen=True)
class Row:
    """A line of the table of methods, and which cells have the best value, where methods differ."""

    key: str
    title: str
    cells: list[str]
    best: tuple[bool, ...]
    column: str  # its title in the terminal; empty: not shown there

    @property
    def is_main(self) -> bool:
        """Whether it is one of those that decide."""
        return self.key in MAIN_ROWS


def summary_rows(columns: Sequence[Column], comparison: Comparison) -> list[Row]:
    """Return the table of methods, without the lines that say nothing of any of them."""
    methods = [column.method for column in columns]
    counts = {"images": len(comparison.image_names), "pairs": f"{comparison.num_pairs:,}"}
    stages = {stage for method in methods for stage in method.stage_seconds}
    rows = [
        _row(key, measure, [method.span(key) for method in methods], counts)
        for key, measure in MEASURES.items()
        if key != "num_models"
    ]
    splits = [_splits(method) for method in methods]
    no_best = (False,) * len(splits)
    rows.insert(2, Row("num_models", "Images in each model", splits, no_best, ""))
    costs = {
        f"{stage}_s": (f"Seconds to {stage}", 1, [m.stage_seconds.get(stage) for m in methods], "")
        for stage in sorted(stages, key=STAGES.index)
    }
    costs["total_s"] = ("Seconds in all", 1, [method.total_s for method in methods], "seconds")
    memory = [method.peak_memory_bytes / BYTES_PER_MB for method in methods]
    costs["peak_memory_bytes"] = ("Peak memory, MB", 0, list(memory), "MB")
    for key, (title, digits, values, column) in costs.items():
        spans = [None if value is None else Span.of([value]) for value in values]
        rows.append(_row(key, Measure(lambda _: None, title, digits, min, column), spans, counts))
    return [row for row in rows if any(cell != NOTHING for cell in row.cells)]


def _row(
    key: str, measure: Measure, spans: Sequence[Span | None], counts: dict[str, object]
) -> Row:
    """Write means and, in brackets, ranges with as many decimals in all cells as any needs."""
    digits, known = measure.digits, [span for span in spans if span]
    means = {round(span.mean, digits) for span in known}
    best = measure.better(means) if measure.better and len(means) > 1 else None
    digits_of_mean = digits_of((span.mean for span in known), digits)
    digits_of_ends = digits_of((end for span in known for end in (span.min, span.max)), digits)
    cells = [span_text(span, digits_of_mean, digits_of_ends) for span in spans]
    is_best = tuple(span is not None and round(span.mean, digits) == best for span in spans)
    return Row(key, measure.title.format(**counts), cells, is_best, measure.column)


def digits_of(values: Iterable[float], digits: int) -> int:
    """Return so many digits after the point, none where all values are whole."""
    return 0 if all(value == round(value) for value in values) else digits


def span_text(span: Span | None, digits: int = 1, digits_of_ends: int = 0) -> str:
    """Write a mean, and the range where its ends differ as they are written.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8, 8])), span_text(None)
    ('7.5 (7-8)', '8.0', '-')
    """
    if span is None:
        return NOTHING
    mean = f"{span.mean:,.{digits}f}"
    low, high = (f"{end:,.{digits_of_ends}f}" for end in (span.min, span.max))
    return mean if low == high else f"{mean} ({low}-{high})"


def _splits(method: MethodResult) -> str:
    """Write the sizes of the models, once where all seeds agree."""
    splits = [" + ".join(str(len(m)) for m in s.model_names) or "none" for s in method.seeds]
    if len(set(splits)) == 1:
        return splits[0]
    pairs = zip(method.seeds, splits, strict=True)
    return "; ".join(f"seed {seed.seed}: {split}" for seed, split in pairs)


def summary(comparison: Comparison) -> str:
    """Return the verdict under a table of methods."""
    columns = columns_of(comparison)
    rows = [row for row in summary_rows(columns, comparison) if row.column]
    cells = {
        column.name: [
            f"{row.cells[index]}{f' of {len(comparison.image_names)}' * (row.key == 'registered')}"
            for row in rows
        ]
        for index, column in enumerate(columns)
    }
    table = [[method.name, *cells.get(method.name, ["failed"])] for method in comparison.methods]
    lines = [aligned([["method", *(row.column for row in rows)], *table])]
    only = comparison.only_registered_by if len(comparison.finished) > 1 else {}
    lines += [""] * bool(only)
    lines += [f"only {method} registers {name}" for name, method in only.items()]
    for paragraph in verdict(comparison):
        lines += ["", *textwrap.wrap(paragraph, WIDTH, break_on_hyphens=False)]
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Align columns, the first to the left; rows may end early.

    >>> print(aligned([["recipe", "< 1 px", "s"], ["default", "3"]]))
    recipe   < 1 px  s
    default       3
    """
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=False))
        ).rstrip()
        for row in rows
    )


def to_json(comparison: Comparison) -> str:
    """Return ``comparison.json``: all results, and the verdict first."""
    content = TypeAdapter(Comparison).dump_python(comparison, mode="json", by_alias=True)
    values = {"verdict": verdict(comparison), **content}
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"
