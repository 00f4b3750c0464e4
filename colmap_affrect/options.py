"""What all options and all exchangeable parts have in common.

Options are frozen pydantic models that refuse unknown names, values of another type and values out
of range, in one line. A part is a class with its options class as attribute ``Options``; a
:class:`Registry` finds it by the name in its options.
"""

import ast
import difflib
import hashlib
import inspect
import json
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from html import escape
from importlib import metadata
from itertools import pairwise
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

from colmap_affrect.errors import (
    OptionError,
    clipped,
    lacks_memory,
    reason,
    shown,
    such_as,
)
from colmap_affrect.parts_of_others import PartOfOthers, methods_of, told_of

EffortName = Literal["low", "normal", "high"]  # how much is tried for photographs in need
EFFORT_NAMES: tuple[EffortName, ...] = get_args(EffortName)
PRESETS = ("sparse", "colmap")  # ours for few photographs, and COLMAP's defaults
MAX_SEED = 2_000_000_000  # COLMAP keeps 32 bits; repeated mapping counts up from it
MAX_KNOWN = 40  # names in a message
MAX_VALUE = 200  # characters of a value in a message
MAX_COMMENT = 96  # width of comments in printed options
MAX_DOCSTRING = 88  # width of what docstrings say of fields
CUSTOM = "custom"  # name of options that are no preset


def within(low: float, high: float) -> Any:
    """Annotate an option with the range it must lie in, both ends included."""
    return Field(ge=low, le=high)


Documented = TypeVar("Documented", bound=type)


def documented(cls: Documented) -> Documented:
    """Add what stands below each field of a dataclass to its docstring, for ``help()``."""
    found: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        found |= _below_fields(each)
    texts = {field.name: found.get(field.name, "") for field in fields(cls)}
    cls.__doc__ = with_attributes(inspect.cleandoc(cls.__doc__ or "").split(ATTRIBUTES)[0], texts)
    return cls


@cache
def _below_fields(cls: type) -> dict[str, str]:
    """Return the strings that stand below the fields of a class, where its source is known."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, TypeError):
        return {}
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    found = {}
    for node, below in pairwise(body):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            found[node.target.id] = inspect.cleandoc(str(below.value.value))
    return found


ATTRIBUTES = "\n\nAttributes:\n"


def with_attributes(docstring: str | None, texts: Mapping[str, str]) -> str:
    """Return a docstring with a section that says what each attribute is."""
    lines = []
    for name, text in texts.items():
        paragraph = f"{name}: {' '.join(text.split())}"
        filled = textwrap.wrap(paragraph, MAX_DOCSTRING - 8, break_long_words=False)
        lines.append("    " + "\n        ".join(filled))
    head = inspect.cleandoc(docstring or "")
    return head + ATTRIBUTES + "\n".join(lines) if lines else head


def _field_text(options: type[BaseModel], name: str) -> str:
    """Say what a field of options means, which values it takes, and its default."""
    field = options.model_fields[name]
    bases = (base.model_fields for base in options.__mro__ if issubclass(base, Options))
    texts = (base[name].description for base in bases if name in base)
    text = next(filter(None, texts), "")
    ends = [limit for item in field.metadata for limit in _limits(item)]
    values = [repr(value) for value in get_args(field.annotation) if isinstance(value, str)]
    extent = f" From {ends[0]:g} to {ends[1]:g}." if len(ends) == 2 else ""
    choice = f" One of {', '.join(values)}." if len(values) > 1 else ""
    plain = isinstance(field.default, bool | int | float | str | tuple)
    usual = f" Default: {field.default!r}." if plain else ""
    return f"{text}{choice}{extent}{usual}"


def _limits(item: object) -> list[float]:
    return [getattr(item, end) for end in ("ge", "le") if hasattr(item, end)]


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

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

    if not TYPE_CHECKING:  # editors and type checkers see the fields as arguments

        def __init__(self, /, **values: Any) -> None:
            """Check the values, paths as text too; OptionError names the option."""
            paths = {k: str(value) for k, value in values.items() if isinstance(value, PathLike)}
            try:
                super().__init__(**(values | paths))
            except ValidationError as error:
                raise OptionError(self._problem(error.errors()[0])) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Add the fields to the docstring, so that ``help()`` shows what each of them means."""
        texts = {name: _field_text(cls, name) for name in cls.model_fields}
        cls.__doc__ = with_attributes(cls.__doc__, texts)

    @classmethod
    def given(cls, options: Any, argument: str) -> Self:
        """Return the options that an argument gives, as they are or as a mapping; None: usual ones.

        Raises OptionError, naming the argument, for anything else and for wrong options.
        """
        if isinstance(options, cls):
            return options
        if options is None:
            return cls()
        if not isinstance(options, Mapping):
            wanted = f"give {cls.__name__} or a dictionary of its fields"
            raise OptionError(f"{argument}={options!r}: {wanted}")
        return cls.from_mapping(options, argument)

    @classmethod
    def with_keywords(
        cls, options: Any, keywords: Mapping[str, Any], argument: str = "options", hint: str = ""
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
            raise OptionError(f"{argument}={options!r}: give {cls.__name__}{hint}")
        return options.changed(**keywords)

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
            case "tuple_type":
                return f"{place}={error['input']!r}: should be a list or tuple"
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
        if name in self.built_in:  # do not ask for the entry points of all installed packages
            return metadata.EntryPoint(name, self.built_in[name], self.group).load()
        points = self._points(name)
        where = self._named(points)
        if len(points) > 1:
            raise OptionError(f"{where}: several packages have that name; uninstall all but one")
        try:
            part = points[0].load()
        except (Exception, SystemExit) as error:  # of any kind: it is the code of others
            if lacks_memory(error):
                raise
            problem = f"cannot be loaded ({type(error).__name__}: {reason(error)})"
            raise OptionError(f"{where}: {problem}; mend or uninstall that package") from error
        if problem := self.problem(part, name):
            raise OptionError(f"{where}: {problem}; mend or uninstall that package")
        return part

    def _points(self, name: str) -> list[metadata.EntryPoint]:
        """Return the entry points of a part of other packages; OptionError if there is none."""
        points = [point for point in self._entry_points() if point.name == name]
        if not points:
            raise OptionError(f"unknown {self.kind} '{name}'{suggestion(name, self.names())}")
        return points

    def _named(self, points: list[metadata.EntryPoint]) -> str:
        return f"{self.kind} '{points[0].name}' of {', '.join(map(_package_of, points))}"

    def problem(self, part: Any, name: str) -> str:
        """Say what a class lacks to be a part of this kind; empty if it lacks nothing."""
        options = getattr(part, "Options", None)
        if not (isinstance(options, type) and issubclass(options, self.options_base)):
            return f"has no class 'Options' with the base {self.options_base.__name__}"
        if options.model_fields["name"].default != name:
            return f"the name in its options is {options.model_fields['name'].default!r}"
        undeclared = [each for each in options.__class_vars__ if not hasattr(options, each)]
        if undeclared:
            return f"{options.__name__} must say what its '{min(undeclared)}' are"
        for method in methods_of(self.protocol):
            if not callable(getattr(part, method, None)):
                return f"has no method '{method}'"
        return ""

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
        where = self._named(self._points(options.name))
        with told_of(where):
            made = part(options, *given)
        watched: Any = PartOfOthers(made, where, self.protocol)
        return watched  # type: ignore[no-any-return]


def _package_of(point: metadata.EntryPoint) -> str:
    """Name the package of an entry point, and where the part is in it."""
    package = (
        f"{point.dist.name} {point.dist.version}" if point.dist else "a package without a name"
    )
    return f"{package} ({point.value})"


def require_bools(**given: Any) -> None:
    """Refuse arguments, by their names, that are neither True nor False."""
    for argument, value in given.items():
        if not isinstance(value, bool):
            raise OptionError(f"{argument}={value!r}: give True or False")


Function = TypeVar("Function", bound=Callable[..., Any])


def takes_fields_of(options: type[Options]) -> Callable[[Function], Function]:
    """Show the fields of options as keywords of a function that takes them as ``**keywords``.

    ``help()`` and the completion of notebooks read signatures; a type checker reads the
    annotation of ``keywords``.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        texts = inspect.signature(options).parameters.values()
        keywords = [p.replace(default=_Shown("..."), annotation=p.empty) for p in texts]
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
            found[f"{prefix}{key}"] = list(value) if isinstance(value, tuple) else value
    return found


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return what a message adds to an unknown name: the one that was meant, or those there are."""
    known = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {such_as(known, MAX_KNOWN)})"
