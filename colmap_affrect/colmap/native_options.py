"""pycolmap's own options, by dotted keys and plain values.

``mapper.init_min_tri_angle`` is the option of that name in the section ``mapper``. So users pass
options through, a report says where a run differs from COLMAP's defaults, and another process
is told what to do. Lists, sets and arrays have no such value and are left out.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

from colmap_affrect.errors import OptionError

Plain = bool | int | float | str

TRUTH_VALUES = {"true": True, "1": True, "false": False, "0": False}

OWNED = {
    "image_path": "it is the one that extract was given",
    "random_seed": "use --random-seed",
}
"""Options, in any section, that are set by other means."""


def flat_values(options: Any) -> dict[str, Any]:
    """Return the values of a pycolmap options object by dotted key, as pycolmap has them."""
    return _flat(options.todict())


def differences(options: Any, default: Any) -> dict[str, Plain]:
    """Return what differs from other options of the same class, by dotted key."""
    others = _plain_values(default)
    return {key: value for key, value in _plain_values(options).items() if value != others[key]}


def set_values(options: Any, values: Mapping[str, Plain]) -> None:
    """Set single options by dotted key."""
    for key, value in values.items():
        *sections, name = key.split(".")
        setattr(reduce(getattr, sections, options), name, value)


def resolve(options: Any, given: Mapping[str, Any], flag: str) -> dict[str, Plain]:
    """Check values against the type of pycolmap's and return them by full dotted key.

    Args:
        options: of the class that the values are for; they are changed.
        given: value by key. Sections may be left out where a name exists once. Values may be
            text: ``true``, ``false``, ``1`` or ``0`` for truth values, a name for enumerations.
        flag: how a user gives them, for messages.

    Raises:
        OptionError: naming the key, for an unknown or ambiguous one, one that cannot be given
            so, or a value of a wrong type.
    """
    known = flat_values(options)
    resolved: dict[str, Plain] = {}
    for text, value in given.items():
        key = _full_key(text, known, flag)
        reason = OWNED.get(_name(key))
        if reason:
            raise OptionError(f"{flag} {text}: cannot be changed here; {reason}")
        resolved[key] = _converted(value, known[key], f"{flag} {text}")
        try:
            set_values(options, {key: resolved[key]})
        except (TypeError, ValueError, OverflowError) as error:
            expected = type(known[key]).__name__
            raise OptionError(f"{flag} {text}={value}: outside the range of {expected}") from error
    return resolved


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _plain_values(options: Any) -> dict[str, Plain]:
    plain: dict[str, Plain] = {}
    for key, value in flat_values(options).items():
        if isinstance(value, bool | int | float | str):
            plain[key] = value
        elif isinstance(value, Path):
            plain[key] = str(value)
        elif _is_enumeration(value):
            plain[key] = value.name
    return plain


def _is_enumeration(value: Any) -> bool:
    return hasattr(type(value), "__members__")


def _name(key: str) -> str:
    return key.rpartition(".")[2]


def _full_key(text: str, known: Mapping[str, Any], flag: str) -> str:
    if text in known:
        return text
    found = [key for key in known if _name(key) == text]
    if len(found) == 1:
        return found[0]
    if found:
        raise OptionError(f"{flag} {text}: exists in several sections; give {' or '.join(found)}")
    meant = {_name(key): key for key in known} | {key: key for key in known}
    close = difflib.get_close_matches(text, meant, n=1)
    hint = f" (did you mean '{meant[close[0]]}'?)" if close else ""
    raise OptionError(f"{flag} {text}: pycolmap has no such option{hint}")


def _converted(value: Any, example: Any, where: str) -> Plain:
    """Turn a value, which may be text, into the type of an example."""
    if _is_enumeration(example):
        return _member(value, type(example), where)
    kinds: list[tuple[type, str, Callable[[Any], Plain]]] = [
        (bool, "true or false", _truth_value),
        (int, "a whole number", _whole_number),
        (float, "a finite number", _finite_number),
        (Path, "a path", _path),
        (str, "text", _text),
    ]
    for kind, expected, convert in kinds:
        if isinstance(example, kind):
            try:
                return convert(value)
            except (TypeError, ValueError) as error:
                raise OptionError(
                    f"{where}={value}: expected {kind.__name__.lower()} ({expected})"
                ) from error
    raise OptionError(f"{where}: cannot be given, it is of type {type(example).__name__}")


def _member(value: Any, enumeration: Any, where: str) -> str:
    name = getattr(value, "name", value)
    if isinstance(name, str) and name.upper() in enumeration.__members__:
        return name.upper()
    raise OptionError(f"{where}={value}: expected one of {', '.join(enumeration.__members__)}")


def _truth_value(value: Any) -> bool:
    if isinstance(value, str) and value.lower() in TRUTH_VALUES:
        return TRUTH_VALUES[value.lower()]
    if isinstance(value, bool):
        return value
    raise TypeError


def _whole_number(value: Any) -> int:
    if isinstance(value, str | int) and not isinstance(value, bool):
        return int(value)
    raise TypeError


def _finite_number(value: Any) -> float:
    if not isinstance(value, str | int | float) or isinstance(value, bool):
        raise TypeError
    number = float(value)
    if not math.isfinite(number):
        raise ValueError
    return number


def _path(value: Any) -> str:
    return str(Path(value))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    raise TypeError
