"""What one method of a comparison is to do, and where everything lies.

``shared/`` has what all methods begin with: a database of cameras and images, and the lists of
images and pairs. ``methods/NAME/`` is a workspace with the features and raw matches of a method,
and ``methods/NAME/seed-K/`` has the two-view geometries and models of one seed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, PlainSerializer, TypeAdapter, ValidationError

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.comparison.methods import Method
from colmap_affrect.errors import StaleStoreError
from colmap_affrect.images.photographs import MaskOptions
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Resources


class Layout:
    """Paths below the folder of a comparison.

    ``inputs`` records what ``shared`` was made from, and the options that all methods have.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.shared = path / "shared"
        self.inputs = self.shared / "inputs.json"
        self.database = self.shared / "database.db"
        self.cameras = self.shared / "cameras.json"
        self.images = self.shared / "images.txt"
        self.pairs = self.shared / "pairs.txt"
        self.methods = path / "methods"

    def image_names(self) -> list[str]:
        """Read the list of images."""
        return self.images.read_text(encoding="utf-8").splitlines()


def _method(values: Method | dict[str, Any]) -> Method:
    if isinstance(values, Method):
        return values
    name, recipe = values["name"], values["recipe"]
    return Method(values["label"], recipe and Recipe.from_mapping(name, recipe))


def _plain(method: Method) -> dict[str, Any]:
    recipe = method.recipe
    values = recipe and {"summary": recipe.summary, **recipe.to_mapping()}
    return {"label": method.label, "name": recipe.name if recipe else "", "recipe": values}


@dataclass(frozen=True)
class Request:
    """What one process is to do."""

    method: Annotated[Method, BeforeValidator(_method), PlainSerializer(_plain)]
    output_path: Path
    image_path: Path
    masks: MaskOptions
    verification: VerificationOptions
    # whose values are checked
    mapping: Annotated[
        MapperOptions, BeforeValidator(MAPPERS.options), PlainSerializer(MapperOptions.to_mapping)
    ]
    focal_vote: bool  # whether verified pairs vote on cameras that nobody knows
    may_share: bool  # whether cameras of images of one size may then turn out to be the same
    seeds: tuple[int, ...]  # of verification and mapping; recipes that climb do it with the first
    resources: Resources

    @property
    def layout(self) -> Layout:
        """Paths of the comparison."""
        return Layout(self.output_path)

    @property
    def folder(self) -> Path:
        """Folder of the results of the method."""
        return self.layout.methods / self.method.folder_name

    @property
    def path(self) -> Path:
        """File that holds this request."""
        return self.folder / "request.json"

    @property
    def log(self) -> Path:
        """What the process of the method printed."""
        return Workspace(self.folder).log

    @property
    def result(self) -> Path:
        """The result of the method, there when it has finished."""
        return self.folder / "result.json"

    def decisive(self) -> dict[str, Any]:
        """Return what features and matches depend on, beside what all methods share."""
        recipe = self.method.recipe
        if recipe is None:
            return {"sift": self.method.label}
        decisive = {key: value for key, value in recipe.to_mapping().items() if key != "mapping"}
        options = {"recipe": decisive}
        return {**options, "climbing_seed": self.seeds[0]} if self.method.climbs else options

    def to_json(self) -> str:
        """Return text for another process."""
        return TypeAdapter(Request).dump_json(self, indent=1).decode()

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of :meth:`to_json`; StaleStoreError when it is of another version."""
        try:
            return TypeAdapter(cls).validate_json(path.read_text(encoding="utf-8"))
        except ValidationError as error:
            raise StaleStoreError(
                f"{path}: is of another version of colmap-affrect; use --overwrite, or another "
                "--output-path"
            ) from error
