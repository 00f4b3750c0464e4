"""The table of methods and what it means in words, and ``comparison.json``."""

import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from itertools import zip_longest

from colmap_affrect.comparison.methods import SIFT, SIFT_COLMAP, SIFT_SUMMARIES
from colmap_affrect.comparison.results import (
    MEASURES,
    Comparison,
    MethodResult,
    Span,
    measured,
)
from colmap_affrect.errors import such_as, with_flags
from colmap_affrect.project.image_failures import failures_to_mapping, texts_of_failures
from colmap_affrect.project.report import by_story

BYTES_PER_MB = 1_000_000  # theory
NOTHING = "-"  # where there is no number
MIN_IMAGES = 3  # of a reconstruction; two images are a pair; theory
MAX_NAMES = 6  # of photographs in a sentence; display
# Photographs by which two means over seeds differ at least where one method places more; display
MIN_DIFFERENCE = 0.5
SAME_TIME = 1.1  # ratio of seconds up to which two methods take as long; display
WIDTH = 88  # columns of text in the terminal; display


def table(comparison: Comparison) -> dict[str, list[str]]:
    """Return a cell for each method that finished, the best first, by the titles of columns.

    Numbers are means over the seeds, with the range where seeds differ.
    """
    methods = comparison.finished
    columns = dict[str, list[str]]()
    for key, measure in MEASURES.items():
        spans = [method.span(key) for method in methods]
        if any(spans):
            columns[measure.title] = [span_text(span, measure.digits) for span in spans]
    columns["seconds"] = []
    columns["MB"] = []
    for method in methods:
        megabytes = method.peak_memory_bytes / BYTES_PER_MB
        columns["seconds"].append(f"{method.total_s:,.1f}")
        columns["MB"].append(f"{megabytes:,.0f}")
    return columns


def span_text(span: Span | None, digits: int = 1) -> str:
    """Write a mean, and the range where its ends differ; whole numbers without decimals.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8])), span_text(Span.of([0.5, 0.501]), 2)
    ('7.5 (7-8)', '8', '0.50')
    """
    if span is None:
        return NOTHING
    mean = number_text(span.mean, digits)
    low = number_text(span.min, digits)
    high = number_text(span.max, digits)
    return mean if low == high else f"{mean} ({low}-{high})"


def number_text(number: float, digits: int) -> str:
    """Write a number with some decimals, but for whole numbers.

    >>> number_text(1234.5, 2), number_text(7.0, 2)
    ('1,234.50', '7')
    """
    return f"{number:,.0f}" if number == round(number) else f"{number:,.{digits}f}"


def verdict(comparison: Comparison) -> list[str]:
    """Return what the numbers mean, the most important paragraph first."""
    paragraphs = [*headline(comparison), *notes(comparison)]
    ending = conclusion(comparison)
    return [*paragraphs, ending] if ending else paragraphs


def conclusion(comparison: Comparison) -> str:
    """Answer in a sentence whether our features are worth it; empty where nothing compares."""
    colmap = _best_of_colmap(comparison)
    best = _best_of_ours(comparison)
    if not colmap or not best:
        return ""
    how = "correctly" if comparison.has_ground_truth else "surely"
    whose = "COLMAP" if colmap.name == SIFT_COLMAP else "COLMAP's SIFT with our mapper"
    difference = best.trusted.mean - colmap.trusted.mean
    times = _times(best.total_s, colmap.total_s)
    more = number_text(abs(difference), 1)
    photographs = "photograph" if more == "1" else "photographs"
    if difference >= MIN_DIFFERENCE:
        text = f"{best.name} {how} places {more} more {photographs} than {whose}"
        return f"{text}, in {times}."
    if difference <= -MIN_DIFFERENCE:
        text = f"{whose} does better here: it {how} places {more} more {photographs}"
        return f"{text}; {best.name} takes {times}."
    num_trusted = number_text(colmap.trusted.mean, 1)
    return (
        f"{whose} does as well here: {num_trusted} placed {how} by it and by {best.name}, "
        f"which takes {times}."
    )


def _best_of_colmap(comparison: Comparison) -> MethodResult | None:
    """Return what our features are compared with: COLMAP as it is, else its SIFT."""
    finished = {method.name: method for method in comparison.finished}
    return finished.get(SIFT_COLMAP) or finished.get(SIFT)


def _best_of_ours(comparison: Comparison) -> MethodResult | None:
    """Return the best method with our features, None if none finished."""
    for method in comparison.finished:  # the best one first
        if method.name not in SIFT_SUMMARIES:
            return method
    return None


def _times(seconds: float, others_s: float) -> str:
    """Say how long something takes, compared with another one.

    >>> _times(21.0, 10.0), _times(10.0, 10.4), _times(1.0, 0.0)
    ('2.1 times the time', 'about the same time', 'about the same time')
    """
    if not others_s or 1.0 / SAME_TIME <= seconds / others_s <= SAME_TIME:
        return "about the same time"
    return f"{seconds / others_s:.1f} times the time"


def headline(comparison: Comparison) -> list[str]:
    """Say what COLMAP, our mapper with its SIFT, and our features get from the photographs."""
    finished = comparison.finished
    total = len(comparison.image_names)
    if not finished:
        return ["No method finished."]
    most = max(method.registered.max for method in finished)
    if most < MIN_IMAGES <= total:
        few = f"no method registers more than {most:g} of the {total} photographs"
        return [f"Nothing was reconstructed: {few}."]
    trusted = "correct" if comparison.has_ground_truth else "sure"
    texts = ["Photographs that are registered:"]
    for kind, method in _by_kind(finished).items():
        registered = f"{span_text(method.registered)} of {total}"
        of_them = f"{span_text(method.trusted)} of them {trusted}"
        texts.append(f"{kind} ({method.name}): {registered}, {of_them}")
    return texts


def _by_kind(methods: Sequence[MethodResult]) -> dict[str, MethodResult]:
    """Return the methods that the headline tells: of ours the best one."""
    named = {method.name: method for method in methods}
    ours = [method for method in methods if method.name not in SIFT_SUMMARIES]
    found = dict[str, MethodResult]()
    if SIFT_COLMAP in named:
        found["COLMAP as it is"] = named[SIFT_COLMAP]
    if SIFT in named:
        found["our mapper with SIFT"] = named[SIFT]
    if ours:
        found["our features"] = max(ours, key=lambda method: method.trusted.mean)
    return found


def notes(comparison: Comparison) -> list[str]:
    """Return what follows on the counts: what is missing or doubtful, and which methods failed."""
    finished = comparison.finished
    texts = []
    if len(finished) > 1:
        texts += _registered_alone(comparison)
    missing = comparison.registered_by_none
    if finished and missing:
        texts.append(f"Registered by no method: {such_as(missing, MAX_NAMES)}.")
    texts += _incomplete(comparison)
    if not comparison.has_ground_truth:
        for method in finished:
            for line in by_story(method.usually_doubted):
                texts.append(f"Doubtful in {method.name}: {line}.")
    return texts


def _incomplete(comparison: Comparison) -> list[str]:
    """Say which methods lack weights, and which ones failed."""
    texts = []
    for method in comparison.finished:
        if method.lacks:
            texts.append(
                f"{method.name} ran without some of its weights; get them, and compare again with "
                f"--overwrite: {method.lacks}"
            )
    for method in comparison.methods:
        if method.failed:
            texts.append(f"{method.name} failed: {method.failed}")
    return texts


def _registered_alone(comparison: Comparison) -> list[str]:
    """Say which photographs one method alone registers."""
    texts = []
    only_registered_by = comparison.only_registered_by.items()
    for method in comparison.finished:
        names = [name for name, only in only_registered_by if only == method.name]
        if names:
            texts.append(f"Only {method.name} registers {such_as(names, MAX_NAMES)}.")
    return texts


def summary(comparison: Comparison) -> str:
    """Return the table of methods, and the verdict under it."""
    columns = table(comparison)
    names = [method.name for method in comparison.finished]
    rows = [["method", *columns], *zip(names, *columns.values(), strict=True)]
    for method in comparison.methods:
        if method.failed:
            rows.append([method.name, "failed"])
    lines = [aligned(rows), "", *headline(comparison)]
    for paragraph in (*notes(comparison), conclusion(comparison)):
        if paragraph:
            lines += ["", *textwrap.wrap(paragraph, WIDTH, break_on_hyphens=False)]
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Align columns, the first to the left; rows may end early.

    >>> print(aligned([["recipe", "< 1 px", "s"], ["default", "3"]]))
    recipe   < 1 px  s
    default       3
    """
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    lines = []
    for first, *others in rows:
        cells = [first.ljust(widths[0])]
        for cell, width in zip(others, widths[1:], strict=False):
            cells.append(cell.rjust(width))
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def to_json(comparison: Comparison) -> str:
    """Return ``comparison.json``: all results, and the verdict first."""
    methods = {}
    for method in comparison.methods:
        values = asdict(method)
        for key in MEASURES:
            span = method.span(key)
            values[key] = asdict(span) if span else None
        values["registered_names"] = {
            str(s.seed): s.registered_names for s in method.seeds
        }
        values["failures"] = texts_of_failures(method.failed_images, with_flags)
        values["failed_images"] = failures_to_mapping(method.failed_images)
        values["total_s"] = method.total_s
        values["wall_s"] = method.stage_seconds
        for seed, numbers in zip(method.seeds, values["seeds"], strict=True):
            numbers.update(measured(seed))
        methods[values.pop("name")] = values
    content = {
        "verdict": verdict(comparison),
        "conclusion": conclusion(comparison),
        "images_total": len(comparison.image_names),
        "only_registered_by": comparison.only_registered_by,
        "registered_by_none": comparison.registered_by_none,
        **asdict(comparison),
        "methods": methods,
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"
