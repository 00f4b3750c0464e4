"""The features of one recipe on the images of a dataset: computed once, measured, and kept."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from colmap_affrect.errors import AffrectError
from colmap_affrect.evaluation.costs import ImageCost, extract_measured
from colmap_affrect.evaluation.protocol import EvaluationImage
from colmap_affrect.evaluation.records import RecordFile
from colmap_affrect.features.weights import digests_by_name
from colmap_affrect.options import digest_of
from colmap_affrect.progress import Progress
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.one_image import prepare

logger = logging.getLogger(__name__)


class RecipeFeatures:
    """Features by image, level by level of escalation.

    ``NAME.h5`` holds the features and ``NAME.jsonl`` what they cost. The cost of an image is
    written first, so that its features never lack it.

    Attributes:
        store: the features; other options than those on record are refused.
        settings: what the features depend on.
        failures: images that could not be used in this run, with the reason.
    """

    def __init__(
        self,
        path: Path,
        options: ExtractionOptions,
        images: Mapping[str, EvaluationImage],
        inputs: Mapping[str, Any],
        resources: Resources,
        *,
        overwrite: bool,
    ) -> None:
        """Find everything that the recipe needs.

        ``path`` is that of the files, without suffix; ``inputs`` is what the images depend on, for
        the record; ``overwrite`` discards what is there, which is refused if it is of other
        options.
        """
        self._images, self.resources = images, resources
        self._extractor = prepare(options, resources, list(images))
        weights = digests_by_name(self._extractor.weights)
        self.settings = {**inputs, **options.to_mapping(), "weights": weights}
        features_path, costs_path = (
            path.with_name(f"{path.name}{suffix}") for suffix in (".h5", ".jsonl")
        )
        if overwrite:
            features_path.unlink(missing_ok=True)
            costs_path.unlink(missing_ok=True)
        self._costs = RecordFile(costs_path, self.settings)
        self.store = FeatureStore(features_path, digest_of(self.settings))
        self.failures: dict[str, str] = {}

    @property
    def warnings(self) -> dict[str, str]:
        """Images that were not rectified though they were to be, with the reason."""
        records = self._costs.records
        return {record["image"]: record["warning"] for record in records if record["warning"]}

    def costs(self, num_levels: Mapping[str, int]) -> list[ImageCost]:
        """Return what images cost, by name, each with so many of its levels together."""
        levels: dict[str, dict[int, ImageCost]] = {}
        for record in self._costs.records:
            if record["level"] < num_levels.get(record["image"], 0):
                cost = ImageCost(**record["cost"])
                levels.setdefault(record["image"], {})[record["level"]] = cost
        return [ImageCost.total(list(costs.values())) for costs in levels.values()]

    def extract(self, names: Sequence[str], level: int, title: str, progress: Progress) -> None:
        """Extract the features that images lack up to a level; what fails goes to ``failures``."""
        complete = self.store.complete(names)
        known = {name: len(self.store.level_ends(name)) for name in complete}
        missing = [name for name in names if known.get(name, 0) <= level]
        with progress.stage(title, len(missing), "images") as advance:
            for name in missing:
                try:
                    for missing_level in range(known.get(name, 0), level + 1):
                        self._extract(name, missing_level)
                except AffrectError as error:
                    logger.warning("%s", error)
                    self.failures[name] = str(error)
                advance(1)

    def _extract(self, name: str, level: int) -> None:
        image = self._images[name]
        found, cost = extract_measured(
            self._extractor, image.path, image.name, image.intrinsics, level
        )
        logger.debug("%s: %d features", name, len(found.features))
        if found.warning:
            logger.warning("%s: %s", name, found.warning)
        self._costs.append(
            {"image": name, "level": level, "cost": vars(cost), "warning": found.warning}
        )
        if level:
            self.store.extend(name, found.features)
        else:
            self.store.write(name, found.features, found.image_size)
