"""pycolmap's own options, by dotted keys (``mapper.init_min_tri_angle``) and plain values.

Lists, sets and arrays are left out.
"""

from collections.abc import Mapping
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any

from pydantic import FiniteFloat, TypeAdapter, ValidationError

from colmap_affrect.errors import OptionError
from colmap_affrect.options import flat, suggestion

Plain = bool | int | float | str

OWNED = {"image_path": "it is the one that extract was given", "random_seed": "use --random-seed"}
"""Options, in any section, that are set by other means."""


def flat_values(options: Any) -> dict[str, Any]:
    """Return the values of a pycolmap options object by dotted key, as pycolmap has them."""
    return flat(options.todict())


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
    """Set values, which may be text, in ``options``; return them by full dotted key.

    Of keys sections may be left out where a name exists once. OptionError, which begins with
    ``flag``, names a key that is unknown or ambiguous, or whose value is of a wrong type.
    """
    known = flat_values(options)
    resolved: dict[str, Plain] = {}
    for text, value in given.items():
        key = _full_key(text, known, flag)
        if reason := OWNED.get(_name(key)):
            raise OptionError(f"{flag} {text}: cannot be changed here; {reason}")
        resolved[key] = _converted(value, known[key], f"{flag} {text}")
        try:
            set_values(options, {key: resolved[key]})
        except (TypeError, ValueError, OverflowError) as error:
            expected = type(known[key]).__name__
            raise OptionError(f"{flag} {text}={value}: outside the range of {expected}") from error
    return resolved


def _plain_values(options: Any) -> dict[str, Plain]:
    plain: dict[str, Plain] = {}
    for key, value in flat_values(options).items():
        if isinstance(value, bool | int | float | str):
            plain[key] = value
        elif isinstance(value, Path):
            plain[key] = str(value)
        elif hasattr(type(value), "__members__"):  # an enumeration
            plain[key] = value.name
    return plain


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
    hint = suggestion(text, [*known, *map(_name, known)])
    raise OptionError(f"{flag} {text}: pycolmap has no such option{hint}")


EXPECTED: dict[type, tuple[str, Any]] = {
    bool: ("true or false", TypeAdapter(bool)),
    int: ("a whole number", TypeAdapter(int)),
    float: ("a finite number", TypeAdapter(FiniteFloat)),
    Path: ("a path", TypeAdapter(Path)),
    str: ("text", TypeAdapter(str)),
}
"""What may be given for options of each type; the order matters, as bool is an int."""


def _converted(value: Any, example: Any, where: str) -> Plain:
    """Turn a value, which may be text, into the type of an example."""
    if names := getattr(type(example), "__members__", None):
        name = getattr(value, "name", value)
        if isinstance(name, str) and name.upper() in names:
            return name.upper()
        raise OptionError(f"{where}={value}: expected one of {', '.join(names)}")
    kind = next((kind for kind in EXPECTED if isinstance(example, kind)), None)
    if kind is None:
        raise OptionError(f"{where}: cannot be given, it is of type {type(example).__name__}")
    expected, adapter = EXPECTED[kind]
    if isinstance(value, bool) == (kind is bool) or isinstance(value, str):
        with suppress(ValidationError):
            converted: Plain | Path = adapter.validate_python(value)
            return str(converted) if isinstance(converted, Path) else converted
    raise OptionError(f"{where}={value}: expected {kind.__name__.lower()} ({expected})")
