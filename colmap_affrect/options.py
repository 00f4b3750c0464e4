"""What all options and all exchangeable parts have in common.

Options are frozen pydantic models that refuse unknown names, values of another type and values out
of range, in one line. A part is a class with its options class as attribute ``Options``; a
:class:`Registry` finds it by the name in its options.
"""

import difflib
import hashlib
import inspect
import json
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from html import escape
from importlib import metadata
from os import PathLike
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Literal,
    Self,
    TypeVar,
    get_args,
)

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from colmap_affrect.docstrings import (
    DocstringWithFields,
    below_fields,
    field_meaning,
    field_text,
)
from colmap_affrect.errors import (
    OptionError,
    Words,
    clipped,
    lacks_memory,
    reason,
    shown,
    such_as,
)
from colmap_affrect.parts_of_others import PartOfOthers, methods_of, told_of

# How much is tried for photographs in need
EffortName = Literal["low", "normal", "high"]
EFFORT_NAMES: tuple[EffortName, ...] = get_args(EffortName)
PRESETS = ("sparse", "colmap")  # ours for few photographs, and COLMAP's defaults
MAX_SEED = 2_000_000_000  # COLMAP keeps 32 bits; repeated mapping counts up from it
MAX_KNOWN = 40  # names in a message; display
MAX_VALUE = 200  # characters of a value in a message; display
MAX_COMMENT = 96  # width of comments in printed options; display
CUSTOM = "custom"  # name of options that are no preset


def within(low: float, high: float) -> Any:
    """Annotate an option with the range it must lie in, both ends included."""
    return Field(ge=low, le=high)


Documented = TypeVar("Documented", bound=type)


def documented(cls: Documented) -> Documented:
    """Add what stands below each field of a dataclass to its docstring, for ``help()``."""

    def texts() -> dict[str, str]:
        found: dict[str, str] = {}
        for base in reversed(cls.__mro__):
            found |= below_fields(base)
        return {field.name: found.get(field.name, "") for field in fields(cls)}

    DocstringWithFields(cls.__doc__, texts).set_of(cls)
    return cls


class Summarized:
    """Base of results that show their summary when they are printed, or end a notebook's cell."""

    def summary(self) -> str:
        """Return text for people."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return f"<pre>{escape(shown(self.summary()))}</pre>"


class Options(BaseModel):
    """Base of all options."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    if not TYPE_CHECKING:  # editors and type checkers see the fields as arguments

        def __init__(self, /, **values: Any) -> None:
            """Check the values, paths as text too; OptionError names the option."""
            for name, value in values.items():
                if isinstance(value, PathLike):
                    values[name] = str(value)
            try:
                super().__init__(**values)
            except ValidationError as error:
                raise OptionError(self._problem(error.errors()[0])) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Add the fields to the docstring, so that ``help()`` shows what each of them means."""

        def texts() -> dict[str, str]:
            return {name: field_text(cls, name) for name in cls.model_fields}

        DocstringWithFields(cls.__doc__, texts).set_of(cls)

    @classmethod
    def given(cls, options: Any, argument: str) -> Self:
        """Return the options that an argument gives.

        Args:
            options: of this class, a mapping of their fields, or None for the usual ones.
            argument: that they came by, for errors.

        Raises:
            OptionError: for anything else, and for wrong options.
        """
        if isinstance(options, cls):
            return options
        if options is None:
            return cls()
        if not isinstance(options, Mapping):
            wanted = f"give {cls.__name__} or a dictionary of its fields"
            raise OptionError(wanted, where=f"{argument}={options!r}")
        return cls.from_mapping(options, argument)

    @classmethod
    def with_keywords(
        cls,
        options: Any,
        keywords: Mapping[str, Any],
        argument: str = "options",
        hint: str = "",
    ) -> Self:
        """Return what a function is given as options, changed by its keywords.

        Args:
            options: of this class; None for the usual ones.
            keywords: fields by their names.
            argument: of the function, that takes the options.
            hint: what a message adds where something else is given as options.

        Returns:
            Checked options.

        Raises:
            OptionError: for options of another class, and wrong keywords, which it names.
        """
        if options is None:
            return cls(**keywords)
        if not isinstance(options, cls):
            raise OptionError(
                f"give {cls.__name__}{hint}", where=f"{argument}={options!r}"
            )
        return options.changed(**keywords)

    @classmethod
    def from_mapping(cls, values: Any, where: Words) -> Self:
        """Build options from a mapping.

        Args:
            values: fields by name.
            where: they come from, for errors.

        Raises:
            OptionError: names what is wrong, and where.
        """
        if not isinstance(values, Mapping):
            raise OptionError(f"expected options, got {values!r}", where=where)
        try:
            return cls(**{str(key): value for key, value in values.items()})
        except OptionError as error:
            raise OptionError(error, where=where) from error

    def to_mapping(self) -> dict[str, Any]:
        """Return the options as nested dictionaries of plain values, as JSON and TOML hold them."""
        return self.model_dump(mode="json", exclude_none=True)

    def changed(self, **values: Any) -> Self:
        """Return the options with some other values, checked."""
        return type(self)(**{**dict(self), **values})

    @classmethod
    def _problem(cls, error: ErrorDetails) -> str:
        """Say in one line what pydantic found."""
        location = list(error["loc"] or ("",))
        if isinstance(location[-1], int):  # the number of an item
            location.pop()
        place = ".".join(map(str, location))
        match error["type"]:
            case "extra_forbidden":
                return f"unknown option '{place}'{suggestion(place, cls.model_fields)}"
            case "missing":
                return f"{place} is missing"
            case "tuple_type":
                return f"{place}={error['input']!r}: should be a list or tuple"
            case "value_error":
                said = error["ctx"]["error"]
                return f"{place}: {said}" if place else str(said)
        return (
            f"{place}={_given(error['input'])}: {error['msg'].removeprefix('Input ')}"
        )


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
        of_preset = cls.COLMAP if preset == "colmap" else {}
        return cls(**{**of_preset, **values})

    @property
    def preset_name(self) -> str:
        """Name of the preset that these options are, ``mapper_options`` apart, else ``custom``."""
        own = {name: value for name, value in self if name in self.OF_NO_PRESET}
        for preset in PRESETS:
            if self == self.preset(preset, **own):
                return preset
        return CUSTOM


class PartOptions(Options):
    """Base of the options of exchangeable parts; ``name`` says which part they are for."""

    name: str
    """Name of the part."""


Part = TypeVar("Part")


@dataclass(frozen=True)
class Registry(Generic[Part]):
    """The exchangeable parts of one kind, by name."""

    kind: str  # what they are called in messages
    group: str  # of the entry points by which other packages add theirs
    built_in: Mapping[str, str]  # ``module:Class`` of ours; imported when needed
    default: str  # name of the part where none is given
    protocol: type = object  # what a part has to do
    options_base: type[PartOptions] = PartOptions  # of the options of every part

    def names(self) -> list[str]:
        """Return the names of all parts, those of this package first."""
        others = {point.name for point in self._entry_points()} - self.built_in.keys()
        return [*self.built_in, *sorted(others)]

    def _entry_points(self) -> list[metadata.EntryPoint]:
        return list(metadata.entry_points(group=self.group))

    def part(self, name: str) -> Any:
        """Return the class of a part.

        Raises OptionError for an unknown name, and for a part that another package provides and
        that does not load, or lacks what parts of this kind must have. It names that package.
        """
        # Looking for entry points of all installed packages takes long
        if name in self.built_in:
            return metadata.EntryPoint(name, self.built_in[name], self.group).load()
        points = self._points(name)
        where = self._named(points)
        if len(points) > 1:
            raise OptionError(
                "several packages have that name",
                where=where,
                advice="uninstall all but one",
            )
        try:
            part = points[0].load()
        except (Exception, SystemExit) as error:
            # Code of others may raise anything
            if lacks_memory(error):
                raise
            why = f"cannot be loaded ({type(error).__name__}: {reason(error)})"
            raise OptionError(
                why, where=where, advice="mend or uninstall that package"
            ) from error
        problem = self.problem(part, name)
        if problem:
            raise OptionError(
                problem, where=where, advice="mend or uninstall that package"
            )
        return part

    def _points(self, name: str) -> list[metadata.EntryPoint]:
        """Return the entry points of a part of other packages; OptionError if there is none."""
        points = [point for point in self._entry_points() if point.name == name]
        if not points:
            raise OptionError(
                f"unknown {self.kind} '{name}'{suggestion(name, self.names())}"
            )
        return points

    def _named(self, points: list[metadata.EntryPoint]) -> str:
        return (
            f"{self.kind} '{points[0].name}' of {', '.join(map(_package_of, points))}"
        )

    def problem(self, part: Any, name: str) -> str:
        """Say what a class lacks to be a part of this kind; empty if it lacks nothing.

        Args:
            part: the class.
            name: by which it is registered.
        """
        options = getattr(part, "Options", None)
        if not (isinstance(options, type) and issubclass(options, self.options_base)):
            return f"has no class 'Options' with the base {self.options_base.__name__}"
        if options.model_fields["name"].default != name:
            return (
                f"the name in its options is {options.model_fields['name'].default!r}"
            )
        for declared in sorted(options.__class_vars__):
            if not hasattr(options, declared):
                return f"{options.__name__} must say what its '{declared}' are"
        for method in methods_of(self.protocol):
            if not callable(getattr(part, method, None)):
                return f"has no method '{method}'"
        return ""

    def options(self, given: Any, where: Words = "") -> Any:
        """Return the options of a part.

        Args:
            given: options as they are, the name of a part, or a mapping with ``name``.
            where: they come from, for errors.

        Raises:
            OptionError: for an unknown part or option.
        """
        if isinstance(given, PartOptions):
            return given
        values = {"name": given} if isinstance(given, str) else given
        try:
            if not isinstance(values, Mapping):
                raise OptionError(f"expected options, got {given!r}")
            return self.part(str(values.get("name", self.default))).Options(**values)
        except OptionError as error:
            raise OptionError(error, where=where) from error

    def make(self, options: PartOptions, *given: Any) -> Part:
        """Build the part that options belong to; ``given`` is what else parts of this kind take."""
        part = self.part(options.name)
        made: Part
        if options.name in self.built_in:
            made = part(options, *given)
            return made
        where = self._named(self._points(options.name))
        with told_of(where):
            made = part(options, *given)
        watched: Any = PartOfOthers(made, where, self.protocol)
        return watched  # type: ignore[no-any-return]


def _package_of(point: metadata.EntryPoint) -> str:
    """Name the package of an entry point, and where the part is in it."""
    package = "a package without a name"
    if point.dist:
        package = f"{point.dist.name} {point.dist.version}"
    return f"{package} ({point.value})"


Function = TypeVar("Function", bound=Callable[..., Any])


def takes_fields_of(options: type[Options]) -> Callable[[Function], Function]:
    """Show the fields of options as keywords of a function that takes them as ``**keywords``.

    ``help()`` and the completion of notebooks read signatures; a type checker reads the
    annotation of ``keywords``.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        fields = inspect.signature(options).parameters.values()
        keywords = [
            p.replace(default=_Shown("..."), annotation=p.empty) for p in fields
        ]
        shown = signature.replace(parameters=[*own, *keywords])
        function.__signature__ = shown  # type: ignore[attr-defined]
        return function

    return decorate


class _Shown(str):
    """A default that a signature shows without quotation marks."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def described_toml(options: Options, path: str = "") -> str:
    """Return options as TOML, under each what the text below it in its class says, as a comment."""
    lines = []
    sections = []
    for name, value in options.to_mapping().items():
        inner = getattr(options, name)
        section = f"{path}.{name}".lstrip(".")
        if isinstance(inner, Options):
            sections.append(f"\n[{section}]\n{described_toml(inner, section)}")
        elif _are_options(inner):
            for item in inner:
                sections.append(f"\n[[{section}]]\n{described_toml(item, section)}")
        elif isinstance(value, dict):
            sections.append(tomli_w.dumps({name: value}) if value else "")
        else:
            text = field_meaning(type(options), name)
            for line in textwrap.wrap(text.replace("``", "'"), MAX_COMMENT):
                lines.append(f"# {line}\n")
            lines.append(tomli_w.dumps({name: value}))
    return "".join([*lines, *sections])


def _are_options(value: object) -> bool:
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], Options)


def digest_of(values: Any) -> str:
    """Return a sha256 of plain values, the same for equal ones."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Join the keys of nested mappings by dots; tuples become lists."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, tuple):
            found[f"{prefix}{key}"] = list(value)
        else:
            found[f"{prefix}{key}"] = value
    return found


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return what a message adds to an unknown name: the one that was meant, or those there are."""
    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f" (did you mean '{close[0]}'?)"
    return f" (known: {such_as(names, MAX_KNOWN)})"
