"""Parts of other packages: whatever is wrong with what they do is one line that names them."""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, get_args, get_origin, get_type_hints

from colmap_affrect.errors import AffrectError, PartError, lacks_memory, reason


class PartOfOthers:
    """A part of another package: what is wrong with it is told in one line that names it.

    To all who use it, it is the part that it wraps.
    """

    def __init__(self, part: Any, name: str, protocol: type) -> None:
        """Take a part, how it is called in messages, and what it has to do.

        Raises:
            PartError: an attribute of the protocol is missing; methods are asked for when it is
                loaded.
        """
        self._part = part
        self._name = name
        self._protocol = protocol
        for value in vars(protocol).get("__annotations__", {}):
            if not hasattr(part, value):
                raise PartError(f"{name} has no attribute '{value}'")

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._part, name)
        if name in methods_of(self._protocol):
            return partial(self._called, name, value)
        return value

    def _called(self, method: str, function: Callable[..., Any], *given: Any) -> Any:
        with told_of(f"{self._name}: {method}"):
            found: Any = function(*given)
        expected, inner = _result(self._protocol, method)
        items: list[Any] = found if isinstance(found, list) else []
        if not isinstance(found, expected):
            wanted = expected.__name__
            raise PartError(
                f"{self._name}: {method} returned {type(found).__name__}, not {wanted}"
            )
        if inner and not all(isinstance(item, inner) for item in items):
            raise PartError(
                f"{self._name}: {method} returned no list of {inner.__name__} alone"
            )
        return found


@contextmanager
def told_of(name: str) -> Iterator[None]:
    """Make one line of anything that the code of another package raises."""
    try:
        yield
    except AffrectError:
        raise
    except (Exception, SystemExit) as error:
        if lacks_memory(error):
            raise
        said = f"{type(error).__name__}: {reason(error)}"
        raise PartError(f"{name} failed ({said})") from error


@cache
def methods_of(protocol: type) -> tuple[str, ...]:
    """Return the names of the methods of a protocol."""
    named = vars(protocol).items()
    return tuple(
        key for key, value in named if inspect.isfunction(value) and key[0] != "_"
    )


@cache
def _result(protocol: type, method: str) -> tuple[type, type | None]:
    """Return the type of what a method has to return, and that of what is in it if it is a list."""
    hint = get_type_hints(getattr(protocol, method)).get("return")
    if hint is Any or hint is None:
        return object, None
    kind = get_origin(hint) or hint
    inner = get_args(hint)
    return kind, inner[0] if kind is list else None
