"""One filter for everything that is shown: names come out of files, and may be made to mislead."""

import sys
from collections.abc import Iterable
from contextlib import suppress

MAX_NAMES = 3  # examples in a line
INTERRUPTED = "interrupted; run the same command again to go on"


def shown(text: str) -> str:
    r"""Write characters that do not print, or turn text round, as JSON does; lines stay lines.

    Control and format characters of a terminal are among them, and what is no Unicode.

    >>> shown("a\x1b[31m\u202eb\nc")
    'a\\u001b[31m\\u202eb\nc'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2))


def one_line(text: str) -> str:
    r"""Return the same in one line.

    >>> one_line("a\nb")
    'a\\u000ab'
    """
    return shown(text).replace("\n", _escaped("\n"))


def say(line: str) -> None:
    """Print a line on stderr, which nobody may read any more."""
    with suppress(OSError):
        if sys.stderr:  # it may have been closed
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()


def such_as(names: Iterable[str], most: int = MAX_NAMES) -> str:
    """Return the first few names, and how many there are more.

    >>> such_as(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    listed = list(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + more
