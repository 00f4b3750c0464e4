"""Arguments of public functions, and fields of options: values of a wrong type are one line."""

import collections.abc
import os
import types
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from typing import (
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from colmap_affrect.errors import OptionError

MAX_SHOWN = 60  # characters of a value that is refused; display
# Numpy's scalars are such, too
NUMBERS: Mapping[Any, type] = {float: Real, int: Integral}
# Sequences of characters, which nobody means by a sequence of names
WORDS = (str, bytes)
ABSTRACT = "collections.abc"
# Collections whose elements are checked; others may be slow, or gone after one look
LOOKED_INTO = (list, tuple, set, frozenset, dict)

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def checks_arguments(
    function: Callable[Arguments, Result],
) -> Callable[Arguments, Result]:
    """Have a function raise OptionError for arguments of other types than its annotations say."""
    names = signature(function)
    kinds: dict[str, Any] = {}

    @wraps(function)
    def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if not kinds:
            kinds.update(get_type_hints(function))
        for name, value in names.bind(*args, **kwargs).arguments.items():
            require_type(name, value, kind=kinds.get(name, Any))
        return function(*args, **kwargs)

    return checked


def require_type(name: str, value: Any, kind: Any) -> None:
    """Refuse a value of another type than annotated.

    Args:
        name: of the argument.
        value: that it was given.
        kind: its annotation.

    Raises:
        OptionError: says what to give.
    """
    if _fits(value, kind):
        return
    if kind is bool:
        raise OptionError("give True or False", where=f"{name}={_shown(value)}")
    if get_origin(kind) is Literal:
        known = ", ".join(map(str, get_args(kind)))
        raise OptionError(f"{name} {_shown(value)} is not one of {known}")
    raise OptionError(
        f"{_shown(value)} is {type(value).__name__}",
        where=name,
        advice=f"give {_name_of(kind)}",
    )


def require_bools(**given: Any) -> None:
    """Refuse arguments, by their names, that are neither True nor False."""
    for name, value in given.items():
        require_type(name, value, kind=bool)


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a value is of a type; True where that cannot be told."""
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in (Union, types.UnionType):
        return any(_fits(value, member) for member in inner)
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is None:
        return _is_instance(value, kind)
    if origin is tuple:
        return _is_tuple(value, inner)
    if origin is collections.abc.Callable:
        return callable(value)
    if origin.__module__ != ABSTRACT:  # arrays, which are looked at where they are used
        return True
    return _holds(value, origin, inner)


def _is_instance(value: Any, kind: Any) -> bool:
    if kind is None or kind is type(None):
        return value is None
    if not isinstance(kind, type):  # Any, a type variable
        return True
    if issubclass(kind, os.PathLike):  # as_path says what is no path
        return value is not None
    if getattr(kind, "_is_protocol", False):
        return _has_public_names_of(value, kind)
    if kind in NUMBERS:
        return isinstance(value, NUMBERS[kind]) and not isinstance(value, bool)
    return isinstance(value, kind)


def _has_public_names_of(value: Any, protocol: type) -> bool:
    names = [name for name in vars(protocol) if not name.startswith("_")]
    return all(hasattr(value, name) for name in names)


def _is_tuple(value: Any, inner: tuple[Any, ...]) -> bool:
    if not isinstance(value, tuple | list):
        return False
    if inner and inner[-1] is Ellipsis:
        return _all_fit(value, inner[0])
    return len(value) == len(inner) and all(map(_fits, value, inner))


def _all_fit(values: Iterable[Any], kind: Any) -> bool:
    return all(_fits(value, kind) for value in values)


def _holds(value: Any, origin: type, inner: tuple[Any, ...]) -> bool:
    """Return whether a collection, or the keys of a mapping, are what they should be."""
    if isinstance(value, WORDS) or not isinstance(value, origin):
        return False
    if not isinstance(value, LOOKED_INTO) or not inner:
        return True
    return _all_fit(value, inner[0])


def _name_of(kind: Any) -> str:
    """Return how a type is called in Python, without the modules."""
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(map(_name_of, inner))
    if kind is type(None):
        return "None"
    if kind is Ellipsis:
        return "..."
    name = str(getattr(origin or kind, "__name__", kind))
    is_array = origin is not None and origin.__module__ == "numpy"
    if is_array or not (origin and inner):
        return name
    return f"{name}[{', '.join(map(_name_of, inner))}]"
