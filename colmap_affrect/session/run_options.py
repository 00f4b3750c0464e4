"""What a run depends on, as one object and as keywords of functions."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

from pydantic import BeforeValidator, Field

from colmap_affrect.colmap.by_hand import NOTHING, ByHand
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.mappers.base import MapperOptions
from colmap_affrect.mappers.existing import Extension, as_extension
from colmap_affrect.options import EffortName, Options
from colmap_affrect.pairs.lists import PairOptions
from colmap_affrect.project.paths import GivenPath, PathLike
from colmap_affrect.recipes import AnyMapper, GivenRecipe, Recipe, load_recipe
from colmap_affrect.session.context import Inputs, Resources


class InputOptions(Options):
    """What runs and comparisons of methods both depend on, beside images and recipes."""

    cameras: CameraOptions = CameraOptions()
    """How images share cameras, and what is known of these."""
    masks: MaskOptions = MaskOptions()
    """Where features may be."""
    pairs: PairOptions = PairOptions()
    """Which pairs of images are matched."""
    verification: VerificationOptions = VerificationOptions()
    """Two-view geometry of the pairs."""
    image_list_path: GivenPath | None = None
    """List of the images to use; None: all below the folder."""
    from_database: GivenPath | None = None
    """COLMAP database whose images, cameras, rigs, frames and pose priors are used."""
    resources: Resources = Resources()
    """Weights and device of networks."""

    def inputs(self, image_path: Path) -> Inputs:
        """Return the photographs of a folder, with their cameras and masks."""
        return Inputs.of(
            image_path,
            image_list_path=self.image_list_path,
            from_database=self.from_database,
            cameras=self.cameras,
            masks=self.masks,
        )


class RunOptions(InputOptions):
    """Everything a run depends on beside its images and its output folder.

    Options of a part, as ``cameras``, may be a dictionary, and ``recipe`` and ``mapping`` a name.
    """

    recipe: GivenRecipe = Field(default_factory=lambda: load_recipe("default"))
    """Features, warps and matching: a recipe, its name, or the path of a TOML file; the recipe
    ``default`` if nothing is given."""
    mapping: AnyMapper | None = None
    """The mapper and its options; None: those of the recipe, else the sparse mapper."""
    database_descriptors: bool = False
    """Whether descriptors are written into the database, as COLMAP's own matchers need them."""
    extend: Annotated[Extension | None, BeforeValidator(as_extension)] = None
    """Finished model that the photographs are registered into, or its folder."""
    by_hand: ByHand = NOTHING
    """Tie points, wrong pairs, photographs to leave out."""
    effort: EffortName = "normal"
    """How much is tried for photographs that are missing in the model, or not sure."""
    max_minutes: Annotated[float, Field(ge=0.0)] = math.inf
    """Time after which nothing more is tried for these photographs."""
    command: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Words of the command line, with which advice begins."""

    def mapper_options(self) -> MapperOptions:
        """Return the mapper and its options."""
        return self.mapping or self.recipe.mapper_options("sparse")

    def later_stages(self) -> dict[str, Options]:
        """Return the options of the stages after extraction that the recipe does not say."""
        return {
            "pairs": self.pairs,
            "verify": self.verification,
            "map": self.mapper_options(),
        }


class InputKeywords(TypedDict, total=False):
    """The fields of :class:`InputOptions` as keywords of a function."""

    cameras: CameraOptions | Mapping[str, Any]
    masks: MaskOptions | Mapping[str, Any]
    pairs: PairOptions | Mapping[str, Any]
    verification: VerificationOptions | Mapping[str, Any]
    mapping: MapperOptions | Mapping[str, Any] | str | None
    image_list_path: PathLike | None
    from_database: PathLike | None
    resources: Resources | Mapping[str, Any]


class RunKeywords(InputKeywords, total=False):
    """The fields of :class:`RunOptions` as keywords of :func:`run`."""

    recipe: Recipe | Mapping[str, Any] | PathLike
    database_descriptors: bool
    extend: Extension | Mapping[str, Any] | PathLike | None
    by_hand: ByHand | Mapping[str, Any]
    effort: EffortName
    max_minutes: float
    command: Sequence[str]
