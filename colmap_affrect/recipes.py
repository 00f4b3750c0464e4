"""Recipes: named TOML files that set the options of a run.

A section is the options of a part, which ``name`` chooses; what is left out keeps its default.
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, SerializeAsAny, model_validator

from colmap_affrect.errors import Option, OptionError
from colmap_affrect.features.base import EXTRACTORS, FeatureOptions, NetworkOptions
from colmap_affrect.features.sift import SiftOptions
from colmap_affrect.images.depth import DepthOptions
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.options import Options, suggestion, within
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.paths import as_path
from colmap_affrect.project.regular_files import read_regular_text
from colmap_affrect.rectifiers.affine_warps import DenseShapesOptions, IdentityOptions
from colmap_affrect.rectifiers.base import RECTIFIERS, CoverOptions, RectifierOptions

AnyRectifier = Annotated[
    SerializeAsAny[RectifierOptions], BeforeValidator(RECTIFIERS.options)
]
AnyFeatures = Annotated[
    SerializeAsAny[FeatureOptions], BeforeValidator(EXTRACTORS.options)
]
AnyMatcher = Annotated[
    SerializeAsAny[MatcherOptions], BeforeValidator(MATCHERS.options)
]
AnyMapper = Annotated[SerializeAsAny[MapperOptions], BeforeValidator(MAPPERS.options)]
ImageSize = Annotated[int, within(16, 1_000_000)]


class LevelOptions(Options):
    """A level of escalation; what is not given is as it is for all images."""

    rectifier: AnyRectifier = IdentityOptions()
    """Warps of this level."""
    features: AnyFeatures | None = None
    """Features of the image and its warps; None: those of all images."""
    matching: AnyMatcher | None = None
    """How pairs are matched; None: as the recipe says."""
    max_image_size_px: ImageSize | None = None
    """Larger images are shrunk to this longer side; None: as the recipe says."""


@dataclass(frozen=True)
class Level:
    """Warps, features and matching of one level."""

    rectifier: RectifierOptions  # which warps
    features: FeatureOptions  # of the image and the warps
    max_image_size_px: int  # larger images are shrunk to this longer side
    matching: MatcherOptions | None  # how pairs are matched; None as the recipe says
    # the lowest level with such features: it has those of the image itself, which are matched
    # together with those of this level
    base: int

    @property
    def name(self) -> str:
        """Name in reports."""
        warps = self.rectifier.name
        own = self.features.name if self.base else ""
        adds_nothing = self.rectifier.warps == "none"
        return own if own and adds_nothing else f"{warps} {own}".rstrip()

    @property
    def network_parts(self) -> tuple[NetworkOptions, ...]:
        """Options of what may run on torch when features are extracted."""
        if isinstance(self.rectifier, CoverOptions):
            return (self.features, self.rectifier.shape_source)
        return (self.features,)

    @property
    def uses_networks(self) -> bool:
        """Whether anything runs on torch when features are extracted."""
        return any(part.uses_network for part in self.network_parts)

    @property
    def weights(self) -> set[str]:
        """Keys of the files of weights that it reads, with those of its own matcher."""
        keys = set[str]()
        for part in self.network_parts:
            keys.update(part.weights)
        if self.matching:
            keys.update(self.matching.weights)
        return keys


def _base_of(features: FeatureOptions, size_px: int, levels: Sequence[Level]) -> int:
    """Return the number of the first level with features of images of a size.

    That is the next level, where none of the ``levels`` so far has such features.
    """
    for number, level in enumerate(levels):
        if level.features == features and level.max_image_size_px == size_px:
            return number
    return len(levels)


class ExtractionOptions(Options):
    """Everything that decides the features of an image."""

    rectifier: AnyRectifier = DenseShapesOptions()
    """Warps that every image gets."""
    escalation: Annotated[tuple[LevelOptions, ...], Field(strict=False)] = ()
    """For pairs that fail verification, one after the other until it succeeds."""
    features: AnyFeatures = SiftOptions()
    """Features of the image and its warps."""
    depth: DepthOptions = DepthOptions()
    """Depth maps, for rectifiers that read them."""
    max_image_size_px: ImageSize = 2400  # resource
    """Larger images are shrunk to this longer side before extraction, which bounds memory. COLMAP's
    limit for SIFT is 3200."""
    stretch_contrast: bool = True
    """Whether tones that fill less than half of a file's range are stretched to all of it before
    extraction, as in faded prints and 12-bit scans."""

    @property
    def levels(self) -> tuple[Level, ...]:
        """All levels, that of every image first."""
        found = list[Level]()
        for item in (LevelOptions(rectifier=self.rectifier), *self.escalation):
            features = item.features or self.features
            size_px = item.max_image_size_px or self.max_image_size_px
            base = _base_of(features, size_px, found)
            found.append(
                Level(
                    rectifier=item.rectifier,
                    features=features,
                    max_image_size_px=size_px,
                    matching=item.matching,
                    base=base,
                )
            )
        return tuple(found)

    @property
    def uses_depth(self) -> bool:
        """Whether any rectifier reads depth maps."""
        return any(level.rectifier.uses_depth for level in self.levels)

    def check_depth(self) -> None:
        """Refuse rectifiers that read depth maps where none are given; OptionError says how."""
        if self.depth.path:
            return
        for level in self.levels:
            if level.rectifier.uses_depth:
                name = level.rectifier.name
                raise OptionError(
                    (
                        f"rectifier {name} needs depth maps: give ",
                        Option("depth-path"),
                        " FOLDER",
                    )
                )

    def matchers(self, matching: MatcherOptions) -> tuple[MatcherOptions, ...]:
        """Return the matcher of each level, ``matching`` where it has none of its own.

        OptionError for one that was not made for the features of its level.
        """
        found = tuple(level.matching or matching for level in self.levels)
        for level, matcher in zip(self.levels, found, strict=True):
            matcher.require_extractor(level.features.name)
        return found

    @property
    def required_weights(self) -> tuple[str, ...]:
        """Keys of the files of weights that every image needs; other levels wait for theirs."""
        return tuple(sorted(self.levels[0].weights))

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights of all levels, sorted."""
        return tuple(
            sorted(set[str]().union(*(level.weights for level in self.levels)))
        )


class EscalateOptions(Options):
    """Which pairs are escalated: those of images that a model lost, or is not sure of."""

    # COLMAP's init_min_num_inliers: such a pair may begin a model
    strong_num_inliers: Annotated[int, within(0, 1_000_000)] = 100
    """Pairs with as many need nothing more, where their images have ``guided.min_num_tracks``."""


class Recipe(ExtractionOptions):
    """All sections of a recipe."""

    name: Annotated[str, Field(exclude=True)] = ""
    """Name of the recipe, or the path that it was read from."""
    summary: str = ""
    """One line for people."""
    matching: AnyMatcher = NearestOptions()
    """How pairs are matched."""
    escalate: EscalateOptions = EscalateOptions()
    """Which pairs are matched again by the levels of ``escalation``."""
    guided: GuidedOptions = GuidedOptions()
    """Matching once more along the epipolar lines of verified pairs."""
    mapping: dict[str, Any] = Field(default_factory=dict)
    """``name`` of the mapper and options that differ from the preset."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Refuse now what would fail when matching or mapping begins."""
        self.matchers(self.matching)
        if self.mapping:
            self.mapper_options("sparse")
        return self

    @property
    def extraction(self) -> ExtractionOptions:
        """The options that decide the features of an image."""
        values = dict(self)
        return ExtractionOptions(
            **{name: values[name] for name in ExtractionOptions.model_fields}
        )

    @property
    def required_weights(self) -> tuple[str, ...]:
        """The same, with those of the matcher."""
        return tuple(sorted({*super().required_weights, *self.matching.weights}))

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights of all parts, sorted."""
        return tuple(sorted({*super().weights, *self.matching.weights}))

    @property
    def later_stages(self) -> dict[str, Options]:
        """Options of the stages after extraction, by stage."""
        found: dict[str, Options] = {"match": self.matching, "guide": self.guided}
        if self.escalation:
            found["escalate"] = self.escalate
        if self.mapping:
            found["map"] = self.mapper_options("sparse")
        return found

    def mapper_options(
        self, preset: str, name: str = "", **values: Any
    ) -> MapperOptions:
        """Return the options of a mapper.

        Args:
            preset: that they begin with; the recipe changes it where it is of the same mapper.
            name: of the mapper, by default that of the recipe, or of the preset.
            values: options that win over both.
        """
        of_recipe = dict(self.mapping)
        of_preset = "incremental" if preset == "colmap" else MAPPERS.default
        usual = str(of_recipe.pop("name", of_preset))
        if name and name != usual:
            of_recipe = {}  # they are those of another mapper
        part = MAPPERS.part(name or usual)
        options: MapperOptions = part.Options.preset(preset, **{**of_recipe, **values})
        return options


def recipe_folder() -> Path:
    """Return the folder of the recipes that come with the package."""
    installed = Path(__file__).parent / "_recipes"
    return installed if installed.is_dir() else Path(__file__).parents[1] / "recipes"


def recipe_names() -> list[str]:
    """Return the names of the recipes that come with the package."""
    return sorted(path.stem for path in recipe_folder().glob("*.toml"))


def as_recipe(given: Any) -> Recipe:
    """Return a recipe: as it is, by its name or the path of a TOML file, or from its sections."""
    if isinstance(given, Recipe):
        return given
    if isinstance(given, str | PathLike):
        return load_recipe(str(given))
    if isinstance(given, Mapping):
        return Recipe(**given)
    raise OptionError(
        "give a Recipe, a name, a path or a dictionary", where=f"recipe={given!r}"
    )


GivenRecipe = Annotated[Recipe, BeforeValidator(as_recipe)]
"""Field of options that takes what :func:`as_recipe` takes."""


@checks_arguments
def load_recipe(
    name: str | PathLike[str], settings: str | Sequence[str] = ()
) -> Recipe:
    """Load a recipe by its name or the path of a TOML file, and change single options.

    ``settings`` are ``section.option=value`` with a TOML value; strings may go without quotes.
    ``section=name`` chooses another part, with its defaults.
    Raises OptionError for an unknown recipe or option, or a value out of range.
    """
    name = name if isinstance(name, str) else str(as_path(name, "name"))
    values = _read_recipe(name)
    changed = with_settings(
        values, [settings] if isinstance(settings, str) else settings
    )
    return Recipe.from_mapping({**changed, "name": name}, f"recipe {name}")


def _read_recipe(name: str) -> dict[str, Any]:
    """Return the sections of a recipe by its name, or of a TOML file by its path."""
    is_file = name.endswith(".toml")
    if not is_file and name not in recipe_names():
        raise OptionError(f"unknown recipe '{name}'{suggestion(name, recipe_names())}")
    path = Path(name) if is_file else recipe_folder() / f"{name}.toml"
    if path.exists() and not path.is_file():  # a pipe would be read only once
        raise OptionError(
            "is not a file",
            where=f"recipe {path}",
            advice="give the path of a TOML file",
        )
    try:
        return tomllib.loads(read_regular_text(path, "utf-8-sig"))
    except FileNotFoundError as error:
        raise OptionError("no such file", where=f"recipe {name}") from error
    except (OSError, ValueError, RecursionError) as error:
        # tomllib raises these on odd files
        raise OptionError(
            f"cannot be read ({error})", where=f"recipe {path}"
        ) from error


def with_settings(
    values: Mapping[str, Any], settings: Sequence[str], flag: str = "set"
) -> dict[str, Any]:
    """Return the sections of a recipe with single options changed.

    Args:
        values: the sections, which stay as they are.
        settings: changes, see :func:`load_recipe`.
        flag: that they came by, for errors.

    Raises:
        OptionError: a setting is none, or is of what is no section.
    """
    changed = dict(values)
    for setting in settings:
        key, separator, text = setting.partition("=")
        if not separator or not key.strip():
            raise OptionError("expected OPTION=VALUE", where=Option(flag, setting))
        *sections, option = key.strip().split(".")
        target = changed
        for section in sections:
            inner = target.get(section, {})
            if isinstance(inner, str):  # a part by its name alone
                inner = {"name": inner}
            if not isinstance(inner, Mapping):
                raise OptionError(
                    f"{section} is not a section", where=Option(flag, setting)
                )
            target[section] = dict(inner)
            target = target[section]
        target[option] = _value_of(text)
    return changed


def _value_of(text: str) -> Any:
    """Return a TOML value; a text may go without quotes."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()
