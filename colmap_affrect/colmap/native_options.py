"""pycolmap's own options, by dotted keys (``mapper.init_min_tri_angle``) and plain values.

Lists, sets and arrays are left out.
"""

import json
import math
from collections.abc import Collection, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

from colmap_affrect.errors import OptionError
from colmap_affrect.options import flat, suggestion

MAX_NUM_THREADS = 1024  # COLMAP starts them all, and waits for ever for those that it cannot have

Plain = bool | int | float | str

OWNED = {"image_path": "it is the one that extract was given", "random_seed": "use --random-seed"}
"""Options, in any section, that are set by other means."""


def flat_values(options: Any) -> dict[str, Any]:
    """Return the values of a pycolmap options object by dotted key, as pycolmap has them."""
    return flat(options.todict())


def differences(options: Any, default: Any, named: Collection[str] = ()) -> dict[str, Plain]:
    """Return what is ``named``, or differs from options of the same class, by dotted key."""
    others = _plain_values(default)
    values = _plain_values(options)
    return {key: value for key, value in values.items() if key in named or value != others[key]}


def set_values(options: Any, values: Mapping[str, Any]) -> None:
    """Set single options by dotted key."""
    for key, value in values.items():
        *sections, name = key.split(".")
        setattr(reduce(getattr, sections, options), name, value)


def resolve(
    options: Any, given: Mapping[str, Any], flag: str, owned: Mapping[str, str] = OWNED
) -> dict[str, Plain]:
    """Set values, which may be text, in ``options``; return them by full dotted key.

    Of keys sections may be left out where a name exists once. OptionError, which begins with
    ``flag``, names a key that is unknown, ambiguous, or ``owned``, or has a wrong value.
    """
    known = flat_values(options)
    plain = _plain_values(options)
    keys = {_full_key(text, known, flag): text for text in given}
    for key, text in keys.items():
        where = f"{flag} {text}"
        value = given[text]
        if reason := owned.get(_name(key)):
            raise OptionError(f"{where}: cannot be changed here; {reason}")
        kind = type(known[key])
        if key not in plain:
            raise OptionError(f"{where}: cannot be given, it is of type {kind.__name__}")
        try:
            parsed = _parsed(value, known[key])
            if _name(key) == "num_threads" and parsed > MAX_NUM_THREADS:
                raise OptionError(
                    f"{where}={value}: at most {MAX_NUM_THREADS}, or -1 for all cores"
                )
            set_values(options, {key: parsed})
        except OptionError:
            raise
        except (TypeError, ValueError, RuntimeError) as error:
            names = getattr(kind, "__members__", ("true", "false") if kind is bool else ())
            expected = f"one of {', '.join(names)}" if names else kind.__name__
            raise OptionError(f"{where}={value}: expected {expected}") from error
    taken = _plain_values(options)
    return {key: taken[key] for key in keys}


def _parsed(value: Any, example: Any) -> Any:
    """Return the number, truth value or name of an enumeration that a text stands for."""
    if isinstance(example, bool | int | float) and isinstance(value, str):
        value = json.loads(value.lower())
        if isinstance(example, bool) and value in (0, 1):  # as COLMAP's command line has it
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


def _full_key(text: str, known: Mapping[str, Any], flag: str) -> str:
    found = [text] if text in known else [key for key in known if _name(key) == text]
    if len(found) > 1:
        raise OptionError(f"{flag} {text}: exists in several sections; give {' or '.join(found)}")
    if not found:
        hint = suggestion(text, [*known, *map(_name, known)])
        raise OptionError(f"{flag} {text}: pycolmap has no such option{hint}")
    return found[0]
