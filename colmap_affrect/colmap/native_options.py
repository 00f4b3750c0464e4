"""pycolmap's own options, by dotted keys (``mapper.init_min_tri_angle``) and plain values.

Lists, sets and arrays are left out.
"""

import json
import math
from collections.abc import Collection, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

from colmap_affrect.errors import Option, OptionError, Words
from colmap_affrect.options import flat, suggestion

# COLMAP starts them all, and waits for ever for those that it cannot have
MAX_NUM_THREADS = 1024

Plain = bool | int | float | str

OWNED: Mapping[str, Words] = {
    "image_path": "it is the one that extract was given",
    "random_seed": ("use ", Option("random-seed")),
}
"""Options, in any section, that are set by other means."""


def flat_values(options: Any) -> dict[str, Any]:
    """Return the values of a pycolmap options object by dotted key, as pycolmap has them."""
    return flat(options.todict())


def differences(
    options: Any, default: Any, named: Collection[str] = ()
) -> dict[str, Plain]:
    """Return the plain values of pycolmap's options that are not the usual ones.

    Args:
        options: of pycolmap.
        default: options of the same class.
        named: dotted keys that are returned in any case.

    Returns:
        Values by dotted key.
    """
    usual = _plain_values(default)
    values = _plain_values(options)
    return {
        key: value
        for key, value in values.items()
        if key in named or value != usual[key]
    }


def set_values(options: Any, values: Mapping[str, Any]) -> None:
    """Set single options by dotted key."""
    for key, value in values.items():
        *sections, name = key.split(".")
        setattr(reduce(getattr, sections, options), name, value)


def resolve(
    options: Any,
    given: Mapping[str, Any],
    option: Words,
    owned: Mapping[str, Words] = OWNED,
) -> dict[str, Plain]:
    """Set single values of pycolmap's options.

    Args:
        options: of pycolmap, which are changed.
        given: values, which may be text, by key; sections may be left out of a key where its name
            exists once.
        option: that they came by, for errors.
        owned: what to do instead, by the names of options that cannot be changed so.

    Returns:
        The values that were set, by full dotted key.

    Raises:
        OptionError: names a key that is unknown, ambiguous or ``owned``, or has a wrong value.
    """
    known = flat_values(options)
    keys = {_full_key(text, known, option): text for text in given}
    plain = _plain_values(options)
    for key, text in keys.items():
        where = (option, f" {text}")
        kind = type(known[key])
        name = _name(key)
        if name in owned:
            raise OptionError("cannot be changed here", where=where, advice=owned[name])
        if key not in plain:
            raise OptionError(
                f"cannot be given, it is of type {kind.__name__}", where=where
            )
        try:
            parsed = _parsed(given[text], known[key])
            _check_num_threads(name, parsed, (option, f" {text}={parsed}"))
            set_values(options, {key: parsed})
        except OptionError:
            raise
        except (TypeError, ValueError, RuntimeError) as error:
            expected = _expected(kind)
            raise OptionError(
                f"expected {expected}", where=(option, f" {text}={given[text]}")
            ) from error
    taken = _plain_values(options)
    return {key: taken[key] for key in keys}


def _check_num_threads(name: str, value: Any, where: Words) -> None:
    if name == "num_threads" and value > MAX_NUM_THREADS:
        raise OptionError(
            f"at most {MAX_NUM_THREADS}, or -1 for all cores", where=where
        )


def _expected(kind: type) -> str:
    """Say which values an option of a type takes."""
    names = getattr(kind, "__members__", ("true", "false") if kind is bool else ())
    return f"one of {', '.join(names)}" if names else kind.__name__


def _parsed(value: Any, example: Any) -> Any:
    """Return the number, truth value or name of an enumeration that a text stands for."""
    if isinstance(example, bool | int | float) and isinstance(value, str):
        value = json.loads(value.lower())
        # COLMAP's command line takes 0 and 1
        if isinstance(example, bool) and value in (0, 1):
            value = bool(value)
    elif hasattr(type(example), "__members__") and isinstance(value, str):
        value = getattr(type(example), value.upper(), value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(value)
    if isinstance(value, bool) != isinstance(example, bool):
        raise TypeError(value)
    return value


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


def _full_key(text: str, known: Mapping[str, Any], option: Words) -> str:
    if text in known:
        return text
    found = [key for key in known if _name(key) == text]
    if len(found) > 1:
        raise OptionError(
            "exists in several sections",
            where=(option, f" {text}"),
            advice=f"give {' or '.join(found)}",
        )
    if not found:
        hint = suggestion(text, [*known, *map(_name, known)])
        raise OptionError(
            f"pycolmap has no such option{hint}", where=(option, f" {text}")
        )
    return found[0]
