"""The features of one recipe on the images of a dataset: computed once, measured, and kept."""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from colmap_affrect.data import LocalFeatures, Photograph, RectificationPlan
from colmap_affrect.errors import AffrectError, StaleStoreError
from colmap_affrect.evaluation.protocol import EvaluationImage
from colmap_affrect.features.weights import digests
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import digest_of
from colmap_affrect.progress import Progress
from colmap_affrect.project.atomic_files import cannot_write, replace_bytes
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.stopwatch import Stopwatch
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import WEIGHTS, first_difference
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.report.levels import PIXELS_PER_MEGAPIXEL, TimedFeatures
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.one_image import ExtractedImage, ImageExtractor, prepare


class RecordFile:
    """Records that were all made with the same settings, which are the first line.

    A last line that is not complete, of a run that was killed, does not count.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        """Read the file, or begin it; StaleStoreError when it has records of other settings."""
        self._path = path
        header = json.loads(json.dumps(settings))
        content = path.read_bytes() if path.exists() else b""
        complete = content[: content.rfind(b"\n") + 1]
        lines = [json.loads(line) for line in complete.decode("utf-8").split("\n")[:-1]]
        if lines and (difference := first_difference(lines[0], header)):
            raise StaleStoreError(
                f"{path}: was made with {difference}; use --overwrite to discard it, another name "
                "(NAME=RECIPE), or another --output-path"
            )
        if not lines:
            complete = _line(header)
            path.parent.mkdir(parents=True, exist_ok=True)
        if complete != content:
            replace_bytes(path, complete)
        self.records: list[dict[str, Any]] = lines[1:]

    @staticmethod
    def settings_in(path: Path) -> dict[str, Any]:
        """Return the settings on record in a file; empty if there is none."""
        first, complete, _ = (path.read_bytes() if path.exists() else b"").partition(b"\n")
        return dict(json.loads(first)) if complete else {}

    def append(self, record: Mapping[str, Any]) -> None:
        """Add a record; WorkspaceError when it cannot be written."""
        try:
            with self._path.open("ab") as file:
                file.write(_line(record))
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self.records.append(dict(record))


def _line(values: Mapping[str, Any]) -> bytes:
    return json.dumps(values, ensure_ascii=False).encode("utf-8") + b"\n"


IMAGE_STEPS = ("plan", "warp", "detect", "describe")
PAIR_STEPS = ("match", "estimate")
STEPS = (*IMAGE_STEPS, *PAIR_STEPS)
"""Steps that are timed. ``warp`` has what belongs to it: masks, carrying features back, choosing
among them; ``detect`` has the descriptors too of extractors that compute both at once (RootSIFT).
Reading images is not counted."""


@dataclass(frozen=True)
class ImageCost:
    """What the features of one image cost, or the mean of several."""

    area_mpx: float = 0.0  # area of all warps in megapixels, the image itself not counted
    num_keypoints: float = 0.0  # features of the image and of its warps
    num_regions: float = 0.0  # different parts of the image that are warped
    num_warps: float = 0.0
    plan_s: float = 0.0
    warp_s: float = 0.0
    detect_s: float = 0.0
    describe_s: float = 0.0

    @property
    def total_s(self) -> float:
        """Seconds of all steps."""
        return sum(self.seconds().values())

    def seconds(self) -> dict[str, float]:
        """Return the seconds by step."""
        return {step: getattr(self, f"{step}_s") for step in IMAGE_STEPS}

    def complexity(self) -> dict[str, float]:
        """Return what the paper's table of complexity has."""
        known = {key: value for key, value in vars(self).items() if not key.endswith("_s")}
        per_region = self.num_warps / self.num_regions if self.num_regions else 0.0
        return {**known, "warps_per_region": per_region}

    @classmethod
    def total(cls, costs: Sequence[Self]) -> Self:
        """Add up, as over the levels of an image."""
        return cls(**{key: sum(vars(cost)[key] for cost in costs) for key in vars(cls())})

    @classmethod
    def mean(cls, costs: Sequence[Self]) -> Self:
        """Average over images; all 0 without any."""
        total = vars(cls.total(costs))
        return cls(**{key: value / max(1, len(costs)) for key, value in total.items()})


@dataclass(eq=False)
class _TimedExtractor(ImageExtractor):
    """An extractor that takes the time of its steps and keeps its plans."""

    watch: Stopwatch = field(default_factory=Stopwatch)
    plans: list[RectificationPlan] = field(default_factory=list)

    def plan(self, photograph: Photograph, level: int = 0) -> RectificationPlan:
        with self.watch.step("plan"):
            self.plans.append(super().plan(photograph, level))
        return self.plans[-1]

    def execute(
        self, photograph: Photograph, plan: RectificationPlan, level: int = 0
    ) -> LocalFeatures:
        with self.watch.step("warp"):
            return super().execute(photograph, plan, level)


def extract_measured(
    extractor: ImageExtractor,
    path: Path,
    name: str = "",
    intrinsics: Array | None = None,
    level: int = 0,
) -> tuple[ExtractedImage, ImageCost]:
    """Extract the features of an image, as :meth:`ImageExtractor.extract_file`, and their cost."""
    watch = Stopwatch(*IMAGE_STEPS)
    timed = _TimedExtractor(
        extractor.options,
        tuple(TimedFeatures(item, watch) for item in extractor.extractors),
        extractor.rectifiers,
        extractor.weights,
        extractor.resources,
        watch=watch,
    )
    found = timed.extract_file(path, name, intrinsics, level)
    plan = timed.plans[-1] if timed.plans else RectificationPlan(found.image_size)
    return found, ImageCost(
        plan.rectified_area_px / PIXELS_PER_MEGAPIXEL,
        len(found.features),
        plan.num_regions,
        len(plan.items),
        **{f"{step}_s": seconds for step, seconds in watch.seconds.items()},
    )


logger = logging.getLogger(__name__)


class RecipeFeatures:
    """Features by image, level by level of escalation: ``NAME.h5``, and their cost ``NAME.jsonl``.

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
        the record. Files of other options are refused unless ``overwrite`` discards them.
        """
        self._images, self.resources = images, resources
        self._extractor = prepare(options, resources, list(images))
        features_path, costs_path = (path.with_name(path.name + s) for s in (".h5", ".jsonl"))
        if overwrite:
            remove_own([features_path, costs_path])
        recorded = RecordFile.settings_in(costs_path).get(WEIGHTS)
        weights = digests(self._extractor.weights, recorded)
        self.settings = {**inputs, **options.to_mapping(), WEIGHTS: weights}
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
        image, extractor = self._images[name], self._extractor
        found, cost = extract_measured(extractor, image.path, image.name, image.intrinsics, level)
        logger.debug("%s: %d features", name, len(found.features))
        if found.warning:
            logger.warning("%s: %s", name, found.warning)
        # First, so that features never lack their cost.
        record = {"image": name, "level": level, "cost": vars(cost), "warning": found.warning}
        self._costs.append(record)
        if level:
            self.store.extend(name, found.features)
        else:
            self.store.write(name, found.features, found.image_size)
