"""What all options and all exchangeable parts have in common.

Options are frozen pydantic models that refuse unknown names, values of another type and values out
of range, in one line. A part is a class with its options class as attribute ``Options``; a
:class:`Registry` finds it by the name in its options.
"""

import difflib
import hashlib
import json
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from os import PathLike
from typing import (
    Any,
    ClassVar,
    Generic,
    Literal,
    Self,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from colmap_affrect.errors import (
    AffrectError,
    OptionError,
    PartError,
    clipped,
    lacks_memory,
    reason,
    such_as,
)

EffortName = Literal["low", "normal", "high"]  # how much is tried for photographs in need
EFFORT_NAMES: tuple[EffortName, ...] = get_args(EffortName)
PRESETS = ("sparse", "colmap")  # ours for few photographs, and COLMAP's defaults
MAX_SEED = 2_000_000_000  # COLMAP keeps 32 bits; repeated mapping counts up from it
MAX_KNOWN = 40  # names in a message
MAX_VALUE = 200  # characters of a value in a message
MAX_COMMENT = 96  # width of comments in printed options
CUSTOM = "custom"  # name of options that are no preset


def within(low: float, high: float) -> Any:
    """Annotate an option with the range it must lie in, both ends included."""
    return Field(ge=low, le=high)


class Options(BaseModel):
    """Base of all options."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

    def __init__(self, /, **values: Any) -> None:
        """Check the values, paths as text too; OptionError names the option."""
        paths = {key: str(value) for key, value in values.items() if isinstance(value, PathLike)}
        try:
            super().__init__(**(values | paths))
        except ValidationError as error:
            raise OptionError(self._problem(error.errors()[0])) from None

    @classmethod
    def from_mapping(cls, values: Any, where: str) -> Self:
        """Build from a mapping that comes from ``where``; OptionError names that and the option."""
        if not isinstance(values, Mapping):
            raise OptionError(f"{where}: expected options, got {values!r}")
        try:
            return cls(**{str(key): value for key, value in values.items()})
        except OptionError as error:
            raise OptionError(f"{where}: {error}") from error

    def to_mapping(self) -> dict[str, Any]:
        """Return the options as nested dictionaries of plain values, as JSON and TOML hold them."""
        return self.model_dump(mode="json", exclude_none=True)

    def changed(self, **values: Any) -> Self:
        """Return the options with some other values, checked."""
        return type(self)(**{**dict(self), **values})

    @classmethod
    def _problem(cls, error: ErrorDetails) -> str:
        """Say in one line what pydantic found."""
        *outer, last = error["loc"] or ("",)
        place = ".".join(map(str, outer if isinstance(last, int) else [*outer, last]))
        match error["type"]:
            case "extra_forbidden":
                return f"unknown option '{place}'{suggestion(place, cls.model_fields)}"
            case "missing":
                return f"{place} is missing"
            case "value_error":
                said = error["ctx"]["error"]
                return f"{place}: {said}" if place else str(said)
        return f"{place}={_given(error['input'])}: {error['msg'].removeprefix('Input ')}"


def _given(value: Any) -> str:
    """Return a value as it is shown in a message: not all of a long one."""
    try:
        return clipped(repr(value), MAX_VALUE)
    except ValueError:  # Python writes no number of so many digits
        return f"a number of more than {sys.get_int_max_str_digits()} digits"


class PresetOptions(Options):
    """Options whose defaults are the preset ``sparse``."""

    COLMAP: ClassVar[Mapping[str, Any]] = {}
    """The preset ``colmap``: COLMAP's own defaults."""
    OF_NO_PRESET: ClassVar[tuple[str, ...]] = ("random_seed", "mapper_options")

    @classmethod
    def preset(cls, preset: str, **values: Any) -> Self:
        """Return the options of a preset, ``sparse`` or ``colmap``, and others given."""
        if preset not in PRESETS:
            raise OptionError(f"preset {preset!r} is not one of {', '.join(PRESETS)}")
        return cls(**{**(cls.COLMAP if preset == "colmap" else {}), **values})

    @property
    def preset_name(self) -> str:
        """Name of the preset that these options are, ``mapper_options`` apart, else ``custom``."""
        own = {k: value for k, value in self if k in self.OF_NO_PRESET}
        return next((name for name in PRESETS if self == self.preset(name, **own)), CUSTOM)


class PartOptions(Options):
    """Base of the options of exchangeable parts; ``name`` says which part they are for."""

    name: str


Part = TypeVar("Part")


class PartOfOthers:
    """A part of another package: what is wrong with it is told in one line that names it.

    To all who use it, it is the part that it wraps.
    """

    def __init__(self, part: Any, name: str, protocol: type) -> None:
        """Take a part, how it is called in messages, and what it has to do.

        Raises:
            PartError: a method or an attribute of the protocol is missing.
        """
        self._part = part
        self._name = name
        self._protocol = protocol
        for method in _methods(protocol):
            if not callable(getattr(part, method, None)):
                raise PartError(f"{name} has no method '{method}'")
        for value in vars(protocol).get("__annotations__", {}):
            if not hasattr(part, value):
                raise PartError(f"{name} has no attribute '{value}'")

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._part, name)
        if name in _methods(self._protocol):
            return partial(self._called, name, value)
        return value

    def _called(self, method: str, function: Callable[..., Any], *given: Any) -> Any:
        with _told_of(f"{self._name}: {method}"):
            found: Any = function(*given)
        expected, inner = _result(self._protocol, method)
        items: list[Any] = found if isinstance(found, list) else []
        if not isinstance(found, expected):
            wanted = expected.__name__
            raise PartError(f"{self._name}: {method} returned {type(found).__name__}, not {wanted}")
        if inner and not all(isinstance(item, inner) for item in items):
            raise PartError(f"{self._name}: {method} returned no list of {inner.__name__} alone")
        return found


@contextmanager
def _told_of(name: str) -> Iterator[None]:
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
def _methods(protocol: type) -> tuple[str, ...]:
    """Return the names of the methods of a protocol."""
    return tuple(k for k, value in vars(protocol).items() if callable(value) and k[0] != "_")


@cache
def _result(protocol: type, method: str) -> tuple[type, type | None]:
    """Return the type of what a method has to return, and that of what is in it if it is a list."""
    hint = get_type_hints(getattr(protocol, method)).get("return")
    if hint is Any or hint is None:
        return object, None
    kind, inner = get_origin(hint) or hint, get_args(hint)
    return kind, inner[0] if kind is list else None


@dataclass(frozen=True)
class Registry(Generic[Part]):
    """The exchangeable parts of one kind, by name."""

    kind: str  # what they are called in messages
    group: str  # of the entry points by which other packages add theirs
    built_in: Mapping[str, str]  # ``module:Class`` of ours; imported when needed
    default: str  # name of the part where none is given
    protocol: type  # what a part has to do

    def names(self) -> list[str]:
        """Return the names of all parts, those of this package first."""
        return list(self._entry_points())

    def _entry_points(self) -> dict[str, metadata.EntryPoint]:
        found = {point.name: point for point in metadata.entry_points(group=self.group)}
        ours = {n: metadata.EntryPoint(n, value, self.group) for n, value in self.built_in.items()}
        return ours | found | ours  # which come first, and win

    def part(self, name: str) -> Any:
        """Return the class of a part; OptionError for an unknown name."""
        if name in self.built_in:  # do not ask for the entry points of all installed packages
            return metadata.EntryPoint(name, self.built_in[name], self.group).load()
        known = self._entry_points()
        if name not in known:
            raise OptionError(f"unknown {self.kind} '{name}'{suggestion(name, known)}")
        return self._loaded(known[name])

    def _loaded(self, point: metadata.EntryPoint) -> Any:
        """Return the class of a part of another package; PartError if there is none."""
        where = self._named(point.name)
        with _told_of(f"{where}: loading {point.value}"):
            part = point.load()
        known = getattr(part, "Options", None)
        if not (
            isinstance(part, type) and isinstance(known, type) and issubclass(known, PartOptions)
        ):
            raise PartError(f"{where}: {point.value} is no class with Options that are PartOptions")
        return part

    def _named(self, name: str) -> str:
        return f"{self.kind} '{name}' of another package"

    def options(self, given: Any, where: str = "") -> Any:
        """Return the options of a part: as they are, by its name, or from a mapping with ``name``.

        Raises OptionError for an unknown part or option, naming ``where`` it is given.
        """
        if isinstance(given, PartOptions):
            return given
        values = {"name": given} if isinstance(given, str) else given
        try:
            if not isinstance(values, Mapping):
                raise OptionError(f"expected options, got {given!r}")
            return self.part(str(values.get("name", self.default))).Options(**values)
        except OptionError as error:
            raise OptionError(f"{where}: {error}" if where else str(error)) from error

    def make(self, options: PartOptions, *given: Any) -> Part:
        """Build the part that options belong to; ``given`` is what else parts of this kind take."""
        part = self.part(options.name)
        made: Part
        if options.name in self.built_in:
            made = part(options, *given)
            return made
        where = self._named(options.name)
        with _told_of(where):
            made = part(options, *given)
        watched: Any = PartOfOthers(made, where, self.protocol)
        return watched  # type: ignore[no-any-return]


def described_toml(options: Options, path: str = "") -> str:
    """Return options as TOML, under each what the text below it in its class says, as a comment."""
    lines, sections = [], []
    for name, value in options.to_mapping().items():
        inner = getattr(options, name)
        at = f"{path}.{name}".lstrip(".")
        if isinstance(inner, Options):
            sections.append(f"\n[{at}]\n{described_toml(inner, at)}")
        elif isinstance(inner, tuple) and inner and isinstance(inner[0], Options):
            sections += [f"\n[[{at}]]\n{described_toml(item, at)}" for item in inner]
        elif isinstance(value, dict):
            sections.append(tomli_w.dumps({name: value}) if value else "")
        else:
            text = type(options).model_fields[name].description or ""
            comment = textwrap.wrap(text.replace("``", "'"), MAX_COMMENT)
            lines += [*(f"# {line}\n" for line in comment), tomli_w.dumps({name: value})]
    return "".join([*lines, *sections])


def digest_of(values: Any) -> str:
    """Return a sha256 of plain values, the same for equal ones."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Join the keys of nested mappings by dots; tuples become lists."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = list(value) if isinstance(value, tuple) else value
    return found


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return what a message adds to an unknown name: the one that was meant, or those there are."""
    known = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {such_as(known, MAX_KNOWN)})"
