"""Which images to match: all pairs, or a list."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.errors import PairListError
from colmap_affrect.files import replace_text

Pair = tuple[str, str]
MAX_NAMES_IN_MESSAGE = 5


def exhaustive_pairs(names: Sequence[str]) -> list[Pair]:
    """Return every unordered pair of the names, sorted."""
    return list(itertools.combinations(sorted(names), 2))


def read_pairs(path: Path, names: Sequence[str]) -> list[Pair]:
    """Read a pair list as COLMAP and hloc write it: two names per line.

    Names may be separated by spaces, a tab or a comma, and may contain spaces. Empty
    lines and lines that begin with # are skipped; pairs given twice, in either order,
    count once; pairs of an image with itself are dropped.

    Raises:
        PairListError: when the file is unreadable or a name is not among ``names``.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PairListError(f"{path}: cannot be read ({error})") from error
    known = set(names)
    pairs: dict[Pair, None] = {}
    problems = []
    for number, line in enumerate(lines, start=1):
        pair = _split(line, known) or _split(line.strip(), known)
        if pair is None and (not line.strip() or line.lstrip().startswith("#")):
            continue
        if pair is None:
            problems.append((number, line))
        elif pair[0] != pair[1]:
            pairs[min(pair), max(pair)] = None
    if problems:
        more = len(problems) - MAX_NAMES_IN_MESSAGE
        shown = (
            f"line {number}: {line.strip()!r}{_suggestion(line, names)}"
            for number, line in problems[:MAX_NAMES_IN_MESSAGE]
        )
        listed = "; ".join(shown) + (f"; and {more} more" * (more > 0))
        raise PairListError(f"{path}: names that are not among the images: {listed}")
    if not pairs:
        raise PairListError(f"{path}: holds no pair of two different images")
    return sorted(pairs)


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    """Write 'name1 name2' lines; with a tab where a name contains white space."""
    blank = any(re.search(r"\s", name) for pair in pairs for name in pair)
    separator = "\t" if blank else " "
    replace_text(path, "".join(f"{a}{separator}{b}\n" for a, b in pairs))


def _split(line: str, known: set[str]) -> Pair | None:
    for separator in (r"\t", r"\s*[\t,]\s*|\s+", " "):
        for match in re.finditer(separator, line):
            first, second = line[: match.start()], line[match.end() :]
            if first in known and second in known:
                return first, second
    return None


def _suggestion(line: str, names: Sequence[str]) -> str:
    unknown = [word for word in line.replace(",", " ").split() if word not in set(names)]
    close = [match for word in unknown for match in difflib.get_close_matches(word, names, n=1)]
    return f" (did you mean {', '.join(close)}?)" if close else ""
