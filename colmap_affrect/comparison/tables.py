"""The table of methods and what it means in words, and ``comparison.json``."""

import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from itertools import zip_longest

from colmap_affrect.comparison.methods import SIFT, SIFT_COLMAP, SIFT_SUMMARIES
from colmap_affrect.comparison.results import MEASURES, Comparison, Span
from colmap_affrect.errors import such_as
from colmap_affrect.project.report import by_story

BYTES_PER_MB = 1_000_000
NOTHING = "-"  # where there is no number
MIN_IMAGES = 3  # fewer are a pair, not a reconstruction
MAX_NAMES = 6  # of photographs in a sentence
WIDTH = 88  # of the verdict in the terminal


def table(comparison: Comparison) -> dict[str, list[str]]:
    """Return a cell for each method that finished, the best first, by the titles of columns.

    Numbers are means over the seeds, with the range where seeds differ.
    """
    methods, columns = comparison.finished, dict[str, list[str]]()
    for key, measure in MEASURES.items():
        spans = [method.span(key) for method in methods]
        if any(spans):
            columns[measure.title] = [span_text(span, measure.digits) for span in spans]
    columns["seconds"] = [f"{method.total_s:,.1f}" for method in methods]
    columns["MB"] = [f"{method.peak_memory_bytes / BYTES_PER_MB:,.0f}" for method in methods]
    return columns


def span_text(span: Span | None, digits: int = 1) -> str:
    """Write a mean, and the range where its ends differ; whole numbers without decimals.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8])), span_text(Span.of([0.5, 0.501]), 2)
    ('7.5 (7-8)', '8', '0.50')
    """
    if span is None:
        return NOTHING
    mean, low, high = (
        f"{number:,.{0 if number == round(number) else digits}f}"
        for number in (span.mean, span.min, span.max)
    )
    return mean if low == high else f"{mean} ({low}-{high})"


def verdict(comparison: Comparison) -> list[str]:
    """Return what the numbers mean, the most important paragraph first."""
    return [*headline(comparison), *notes(comparison)]


def headline(comparison: Comparison) -> list[str]:
    """Say what COLMAP, our mapper with its SIFT, and our features get from the photographs."""
    finished, total = comparison.finished, len(comparison.image_names)
    if not finished:
        return ["No method finished."]
    most = max(method.registered.max for method in finished)
    if most < MIN_IMAGES <= total:
        few = f"no method registers more than {most:g} of the {total} photographs"
        return [f"Nothing was reconstructed: {few}."]
    named = {method.name: method for method in finished}
    others = [name for name in named if name not in SIFT_SUMMARIES]
    ours = max(others, key=lambda name: named[name].right.mean, default="")
    kinds = {SIFT_COLMAP: "COLMAP as it is", SIFT: "our mapper with SIFT", ours: "our features"}
    what, texts = "correct" if comparison.has_ground_truth else "sure", list[str]()
    for name in filter(named.get, kinds):
        counts = span_text(named[name].registered), span_text(named[name].right)
        texts.append(f"{kinds[name]} ({name}): {counts[0]} of {total}, {counts[1]} of them {what}")
    return ["Photographs that are registered:", *texts]


def notes(comparison: Comparison) -> list[str]:
    """Return what follows on the counts: what is missing or doubtful, and which methods failed."""
    finished, texts = comparison.finished, list[str]()
    for method in finished if len(finished) > 1 else ():
        only = comparison.only_registered_by.items()
        if names := [name for name, by in only if by == method.name]:
            texts.append(f"Only {method.name} registers {such_as(names, MAX_NAMES)}.")
    if finished and (missing := comparison.registered_by_none):
        texts.append(f"Registered by no method: {such_as(missing, MAX_NAMES)}.")
    lacking = "{} ran without some of its weights; get them, and compare again with --overwrite: {}"
    texts += [lacking.format(method.name, method.lacks) for method in finished if method.lacks]
    texts += [f"{m.name} failed: {m.failed}" for m in comparison.methods if m.failed]
    if not comparison.has_ground_truth:
        for method in finished:
            doubts = by_story(method.usually_doubted)
            texts += [f"Doubtful in {method.name}: {line}." for line in doubts]
    return texts


def summary(comparison: Comparison) -> str:
    """Return the table of methods, and the verdict under it."""
    columns = table(comparison)
    names = [method.name for method in comparison.finished]
    rows = [[name, *(cells[k] for cells in columns.values())] for k, name in enumerate(names)]
    rows += [[method.name, "failed"] for method in comparison.methods if method.failed]
    lines = [aligned([["method", *columns], *rows])]
    lines += ["", *headline(comparison)]
    for paragraph in notes(comparison):
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
    content = asdict(comparison)
    for method, values in zip(comparison.methods, content["methods"], strict=True):
        values |= {key: span and asdict(span) for key in MEASURES for span in [method.span(key)]}
        values["registered_names"] = {str(s.seed): s.registered_names for s in method.seeds}
        values |= {"total_s": method.total_s, "wall_s": method.stage_seconds}
        for seed, numbers in zip(method.seeds, values["seeds"], strict=True):
            numbers |= {key: measure.of(seed) for key, measure in MEASURES.items()}
    content["methods"] = {values.pop("name"): values for values in content["methods"]}
    totals = {
        "verdict": verdict(comparison),
        "images_total": len(comparison.image_names),
        "only_registered_by": comparison.only_registered_by,
        "registered_by_none": comparison.registered_by_none,
    }
    return json.dumps({**totals, **content}, indent=2, ensure_ascii=False) + "\n"
