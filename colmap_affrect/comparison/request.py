"""What one method of a comparison is to do, and where everything lies.

``shared/`` has what all methods begin with: a database of cameras and images, and the lists of
images and pairs. ``methods/NAME/`` is a workspace with the features and raw matches of a method,
and ``methods/NAME/seed-K/`` has the two-view geometries and models of one seed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from colmap_affrect.comparison.methods import Method
from colmap_affrect.extraction import Resources
from colmap_affrect.options import (
    ExtractionOptions,
    MappingOptions,
    MaskOptions,
    MatchingOptions,
    VerificationOptions,
)
from colmap_affrect.recipes import Recipe
from colmap_affrect.workspace import Workspace


@dataclass(frozen=True)
class Layout:
    """Paths below the folder of a comparison."""

    path: Path
    shared_name: str = "shared"

    @property
    def shared(self) -> Path:
        """Folder of what all methods begin with."""
        return self.path / self.shared_name

    @property
    def inputs(self) -> Path:
        """Record of what ``shared`` was made from, and of the options that all methods have."""
        return self.shared / "inputs.json"

    @property
    def database(self) -> Path:
        """Cameras and images, no features."""
        return self.shared / "database.db"

    @property
    def images(self) -> Path:
        """Names of the images that COLMAP can read, one a line."""
        return self.shared / "images.txt"

    @property
    def pairs(self) -> Path:
        """The pairs to match."""
        return self.shared / "pairs.txt"

    @property
    def methods(self) -> Path:
        """Folder of the methods."""
        return self.path / "methods"

    def method(self, method: Method) -> Path:
        """Folder of one method."""
        return self.methods / method.folder_name

    def image_names(self) -> list[str]:
        """Read the list of images."""
        return self.images.read_text(encoding="utf-8").splitlines()


@dataclass(frozen=True)
class Request:
    """What one process is to do.

    Attributes:
        method: the method.
        output_path: folder of the comparison.
        image_path: folder of the photographs.
        masks: where features may be.
        verification: options of two-view geometry.
        mapping: checked.
        intrinsics_given: the user gave the camera parameters.
        seeds: of verification and mapping; recipes that climb do it with the first.
        resources: weights and device of networks.
    """

    method: Method
    output_path: Path
    image_path: Path
    masks: MaskOptions
    verification: VerificationOptions
    mapping: MappingOptions
    intrinsics_given: bool
    seeds: tuple[int, ...]
    resources: Resources

    @property
    def layout(self) -> Layout:
        """Paths of the comparison."""
        return Layout(self.output_path)

    @property
    def folder(self) -> Path:
        """Folder of the results of the method."""
        return self.layout.method(self.method)

    def seed_folder(self, seed: int) -> Path:
        """Folder of the results of one seed."""
        return self.folder / f"seed-{seed}"

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
        options = {"recipe": recipe_options(recipe)}
        return {**options, "climbing_seed": self.seeds[0]} if self.method.climbs else options

    def to_json(self) -> str:
        """Return text for another process."""
        recipe, weights = self.method.recipe, self.resources.weights_path
        values = {
            "label": self.method.label,
            "recipe": recipe and {
                "name": recipe.name,
                "summary": recipe.summary,
                "options": recipe_options(recipe),
            },
            "output_path": str(self.output_path.resolve()),
            "image_path": str(self.image_path.resolve()),
            "masks": self.masks.to_mapping(),
            "verification": self.verification.to_mapping(),
            "mapping": self.mapping.to_mapping(),
            "intrinsics_given": self.intrinsics_given,
            "seeds": self.seeds,
            "weights_path": str(weights.resolve()) if weights else "",
            "device": self.resources.device,
        }  # fmt: skip
        return json.dumps(values, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read :meth:`to_json`."""
        values = json.loads(text)
        recipe, where = values["recipe"], "request"
        extraction = dict(recipe["options"]) if recipe else {}
        matching = extraction.pop("matching", {})
        return cls(
            method=Method(
                values["label"],
                recipe and Recipe(
                    recipe["name"],
                    recipe["summary"],
                    ExtractionOptions.from_mapping(extraction, where),
                    MatchingOptions.from_mapping(matching, where),
                ),
            ),
            output_path=Path(values["output_path"]),
            image_path=Path(values["image_path"]),
            masks=MaskOptions.from_mapping(values["masks"], where),
            verification=VerificationOptions.from_mapping(values["verification"], where),
            mapping=MappingOptions.from_mapping(values["mapping"], where),
            intrinsics_given=values["intrinsics_given"],
            seeds=tuple(values["seeds"]),
            resources=Resources(
                Path(values["weights_path"]) if values["weights_path"] else None, values["device"]
            ),
        )  # fmt: skip


def recipe_options(recipe: Recipe) -> dict[str, Any]:
    """Return all options of a recipe."""
    return {**recipe.extraction.to_mapping(), "matching": recipe.matching.to_mapping()}
