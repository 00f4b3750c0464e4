"""What stages and runs report: frozen, printable, JSON out."""

import itertools
import math
import platform
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

from pydantic import TypeAdapter

from colmap_affrect.errors import Words, such_as, with_arguments
from colmap_affrect.options import Summarized, documented
from colmap_affrect.project.advised import Advice
from colmap_affrect.project.camera_notes import camera_notes
from colmap_affrect.project.line_report import LineReport
from colmap_affrect.project.reasons import (
    Doubt,
    Missing,
    mappings_of,
    texts_of,
    why_model_was_wrong,
)
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import texts_by_subject

# Makes plain values and JSON of dataclasses; for thousands of images ``asdict`` takes seconds
PLAIN = TypeAdapter(Any)

NUM_WORST = 3  # tie points that a summary names; display
MAX_LINES, MAX_ADVICE = 12, 4  # of each list in a summary; report.json has all; display

SOURCES = {  # how a summary calls where focal lengths are from; others by their own names
    "exif": "from EXIF", "exif-rescaled": "from EXIF, for another size",
    "guess": "not known beforehand", "model": "of the model that is extended",
}  # fmt: skip

OF_LARGEST = (  # what ``report.json`` has of the largest model under its own name
    "registered_names", "probabilities", "unsure", "doubtful", "mean_track_length",
    "mean_reprojection_error_px", "hypotheses", "one_view",
)  # fmt: skip

SURE, DOUBTFUL = 0.9, 0.5  # probabilities: at least one, below the other; theory
MOST_CERTAIN = 0.999  # nothing is more probable than that; theory


def kept_probability(probability: float) -> float:
    """Return a probability as it is kept: rounded down, so that it stays on its side of a limit.

    >>> kept_probability(0.89999), kept_probability(0.49999), kept_probability(1.0)
    (0.899, 0.499, 0.999)
    """
    return min(math.floor(1000.0 * probability + 1e-9) / 1000.0, MOST_CERTAIN)


def expected_right_poses(probabilities: Iterable[float]) -> float:
    """Return how many poses of a model, relative to a first image, are expected to be right.

    >>> expected_right_poses([1.0, 1.0, 0.5]), expected_right_poses([])
    (1.5, 0.0)
    """
    return max(0.0, sum(probabilities) - 1.0)


def probability_text(probability: float) -> str:
    """Return a probability in percent: rounded down, and never 0 or 100.

    >>> probability_text(0.499), probability_text(0.9), probability_text(0.998)
    ('49%', '90%', '>99%')
    """
    percent = math.floor(100.0 * probability + 1e-9)
    if percent < 1:
        return "<1%"
    return ">99%" if percent >= 99 and probability > 0.99 else f"{percent}%"


USUAL = "sparse, sparse mapper"  # preset and mapper that a summary does not name

REPORTED_PACKAGES = (
    "colmap-affrect", "pycolmap", "pyceres", "opencv-python-headless", "numpy", "h5py", "torch",
    "kornia",
)  # fmt: skip


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide results."""
    versions = {"python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions


def _some(lines: Iterable[str]) -> list[str]:
    """Return the first few lines of a list, and how many there are more."""
    listed = list(lines)
    num_more = len(listed) - MAX_LINES
    if num_more <= 1:
        return listed
    return [*listed[:MAX_LINES], f"            and {num_more} more, see report.json"]


def by_story(stories: Mapping[str, str]) -> list[str]:
    """Return a line for each story, with the images that it is true of."""
    names = defaultdict(list)
    for name, story in stories.items():
        names[story].append(name)
    return [f"{such_as(same, MAX_LINES)}: {story}" for story, same in names.items()]


LEVELS = {  # how pairs are matched again, by the kind of the level
    "measured, warps": "more warps", "measured, all tilts": "all tilts",
    "learned": "learned matching", "learned, warps": "learned matching of warps",
}  # fmt: skip


@documented
@dataclass(frozen=True)
class MatchedAgain:
    """Pairs that were, or might be, matched again in one way."""

    kind: str
    """Kind of the level that matched them, a key of ``LEVELS``."""
    num_pairs: int
    """How many pairs."""
    core_s: float
    """Seconds of one core that this takes, roughly."""

    def text(self) -> str:
        """Return a few words."""
        pairs = "pair" if self.num_pairs == 1 else "pairs"
        return f"{LEVELS.get(self.kind, self.kind)} {self.num_pairs} {pairs}"


@documented
@dataclass(frozen=True)
class Bridge:
    """How one verified pair registered an image, with its scale by the depths of neighbours."""

    by: str
    """The other image of the pair, which was registered before."""
    num_agreeing: int
    """Depths that agree on the scale."""
    num_ratios: int
    """Depths compared."""
    scale_error_frac: float
    """Standard error of the scale."""

    def text(self) -> str:
        """Return a few words."""
        agreeing = f"{self.num_agreeing} of {self.num_ratios} depths agree"
        return f"bridged by {self.by}, {agreeing}, scale +-{self.scale_error_frac:.1%}"


@documented
@dataclass(frozen=True)
class Residual:
    """How far a tie point is from where the model sees it, in px of the photograph."""

    point: str
    """Name of the tie point."""
    image: str
    """Name of the photograph."""
    error_px: float
    """Distance from the mark to where the model sees the point."""

    def text(self) -> str:
        """Return a few words."""
        return f"{self.point} in {self.image} {self.error_px:.1f}"


@documented
@dataclass(frozen=True)
class PrincipalPointContradiction:
    """A principal point of the user that the points of a model contradict, in COLMAP's px."""

    given_px: tuple[float, float]
    """What the user gives."""
    fitting_px: tuple[float, float]
    """What fits better, roughly."""
    turns_deg: dict[str, float]
    """By the name of each image: how far its rotation changes with that, in degrees."""


@documented
@dataclass(frozen=True)
class ModelSummary:
    """One COLMAP model; mappings are by image name."""

    registered_names: tuple[str, ...]
    """Names of the registered images."""
    num_points3D: int
    """Number of points."""
    mean_track_length: float
    """Images that see a point, on average."""
    mean_reprojection_error_px: float
    """Mean over all observations."""
    probabilities: dict[str, float] = field(default_factory=dict)
    """Probability of each image that its pose is right within 5 degrees."""
    gains: dict[str, float] = field(default_factory=dict)
    """What more matches may add to these probabilities."""
    doubtful: dict[str, tuple[Doubt, ...]] = field(default_factory=dict)
    """Why images are rather wrong than right."""
    unsure: dict[str, tuple[Doubt, ...]] = field(default_factory=dict)
    """Why images are neither sure nor doubtful."""
    bridges: dict[str, Bridge] = field(default_factory=dict)
    """How images came in that are in no track through three images."""
    taken_out: dict[str, tuple[Doubt, ...]] = field(default_factory=dict)
    """Why images that were surely wrong were taken out."""
    focals_px: dict[str, float] = field(default_factory=dict)
    """Focal length of the camera of each image."""
    hypotheses: tuple[str, ...] = ()
    """What made the model, by the sparse mapper."""
    tie_points: tuple[Residual, ...] = ()
    """Residuals of the tie points by hand, the worst first."""
    one_view: tuple[tuple[str, str], ...] = ()
    """Pairs of prints of one negative, or of photographs from one place."""
    principal_point_contradictions: tuple[PrincipalPointContradiction, ...] = ()
    """Principal points of the user that the points contradict."""

    @property
    def sure(self) -> tuple[str, ...]:
        """Names of the images that are right with a probability of ``SURE`` or more."""
        probabilities = self.probabilities.items()
        return tuple(name for name, probability in probabilities if probability >= SURE)

    @property
    def likely(self) -> set[str]:
        """Names of the images that are rather right than wrong."""
        return set(self.registered_names) - self.doubtful.keys()

    def class_counts(self) -> dict[str, int]:
        """Return how many photographs are sure, unsure and doubtful."""
        num_sure = len(self.sure)
        num_doubtful = len(self.doubtful)
        num_unsure = len(self.registered_names) - num_sure - num_doubtful
        return {"sure": num_sure, "unsure": num_unsure, "doubtful": num_doubtful}

    def classes_text(self) -> str:
        """Return these numbers, the sure ones first."""
        counts = self.class_counts()
        return f"{counts['sure']}, unsure {counts['unsure']}, doubtful {counts['doubtful']}"

    def summary_lines(self) -> list[str]:
        """Return what a summary says of the largest model."""
        bridges = self.bridges.items()
        unsure = by_story(texts_of(self.unsure))
        doubtful = by_story(texts_of(self.doubtful))
        alike = [f"{first} and {second}" for first, second in self.one_view]
        return [
            f"sure        {self.classes_text()}; sure: right with {SURE:.0%} or more",
            *_some(f"joined      {name} {bridge.text()}" for name, bridge in bridges),
            *_some(f"unsure      {line}" for line in unsure),
            *_some(f"doubtful    {line}" for line in doubtful),
            *_some(f"one view    {pair}: no depth between them" for pair in alike),
            *self._tie_point_lines(),
            f"points      {self.num_points3D}, each in {self.mean_track_length:.2f} images",
            f"error       {self.mean_reprojection_error_px:.2f} px on average",
        ]

    def _tie_point_lines(self) -> list[str]:
        if not self.tie_points:
            return []
        worst = ", ".join(residual.text() for residual in self.tie_points[:NUM_WORST])
        num_points = len({residual.point for residual in self.tie_points})
        num_marks = len(self.tie_points)
        return [
            f"tie points  {num_points}, {num_marks} marks; farthest off in px: {worst}"
        ]


NO_MODEL = ModelSummary(
    registered_names=(),
    num_points3D=0,
    mean_track_length=0.0,
    mean_reprojection_error_px=0.0,
)


def largest_of(models: Sequence[ModelSummary]) -> ModelSummary:
    """Return the first of models, which is the largest; an empty one where there are none."""
    return models[0] if models else NO_MODEL


@documented
@dataclass(frozen=True)
class ReconstructionReport(Summarized):
    """A whole run; numbers of points and tracks are those of the largest model."""

    images_total: int
    """Number of photographs."""
    unregistered: dict[str, Missing]
    """Why images are in no model or in a smaller one, by their names."""
    models: tuple[ModelSummary, ...]
    """The models, the largest first, as written to ``sparse/0``, ``sparse/1`` and so on."""
    num_verified_pairs: int
    """Pairs with a two-view geometry."""
    num_pairs: int
    """Pairs that were to be matched."""
    stages: tuple[StageReport, ...]
    """What each stage did, and how long that took."""
    recipe: str
    """Name of the recipe; empty for the database of another program."""
    versions: dict[str, str]
    """Versions of Python and of the packages that decide results."""
    preset: str
    """Preset of mapping: ``sparse``, ``colmap`` or ``custom``."""
    verification: dict[str, Any]
    """Options of two-view geometry."""
    mapping: dict[str, Any]
    """The mapper and its options."""
    extended: tuple[str, ...] = ()
    """Names of the images of the model that was extended, if any."""
    advice: tuple[Advice, ...] = ()
    """What to try for images that are missing or doubtful."""
    guided: dict[str, int] = field(default_factory=dict)
    """``pairs`` that guided matching gave more inliers, and these inliers
    ``matches_before`` and ``matches_after``; empty where no pair needed it."""
    cameras: tuple[dict[str, Any], ...] = ()
    """The cameras, and where their focal lengths are from."""
    lines: dict[str, LineReport] = field(default_factory=dict)
    """What the straight lines of photographs say of their cameras, by name."""
    by_hand: tuple[str, ...] = ()
    """What was done otherwise than matches alone say."""
    effort: str = ""
    """How much was tried for images in need; empty where nothing had to be."""
    matched_again: tuple[MatchedAgain, ...] = ()
    """How pairs of images in need were matched again."""
    untried: tuple[MatchedAgain, ...] = ()
    """What a greater effort would try for images that are in need."""

    @property
    def status(self) -> str:
        """``ok`` (all in one model), ``partial``, ``doubtful`` (no two to trust), ``no_model``."""
        if not self.models:
            return "no_model"
        if len(self.models[0].registered_names) - len(self.models[0].doubtful) < 2:
            return "doubtful"
        return "partial" if self.unregistered else "ok"

    @property
    def why_no_model(self) -> str:
        """Why there is none, in a few words; empty where there is one."""
        if self.models:
            return ""
        num_usable = self.images_total - len(self.failures)
        if num_usable == 1:
            unreadable = (
                f": {len(self.failures)} cannot be read" if self.failures else ""
            )
            return f"one image cannot make a model{unreadable}"
        if not self.num_verified_pairs:
            return "no model was found: no pair of images is verified"
        wrong = why_model_was_wrong(self.unregistered.values())
        if wrong:
            return f"no model is kept: {wrong}"
        return f"no model was found: {self.num_verified_pairs} verified pairs do not make one"

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Names of the images in the largest model."""
        return self.models[0].registered_names if self.models else ()

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the images that came into the model that was extended."""
        if not self.extended:
            return ()
        before = set(self.extended)
        return tuple(name for name in self.registered_names if name not in before)

    @property
    def failures(self) -> dict[str, str]:
        """Images that could not be read, with the reason."""
        return {
            name: why for stage in self.stages for name, why in stage.failures.items()
        }

    @property
    def warnings(self) -> dict[str, str]:
        """Images that were worked on in another way than asked for, with the reason."""
        return {
            name: why for stage in self.stages for name, why in stage.warnings.items()
        }

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of ``report.json``."""
        largest = largest_of(self.models)
        of_largest = PLAIN.dump_python(largest)
        found = PLAIN.dump_python(self)
        del found["verification"]["random_seed"]
        options = found["mapping"]
        missing = {name: why.to_mapping() for name, why in self.unregistered.items()}
        return {
            "status": self.status,
            "images_registered": len(largest.registered_names),
            **{key: of_largest[key] for key in OF_LARGEST},
            **found,
            "stages": [stage.to_mapping() for stage in self.stages],
            "unregistered": missing,
            "unsure": mappings_of(largest.unsure),
            "doubtful": mappings_of(largest.doubtful),
            "points3D": largest.num_points3D,
            "bridges": of_largest["bridges"],
            "tie_points": list(of_largest["tie_points"]),
            "num_models": len(self.models),
            "models": [list(model.registered_names) for model in self.models],
            "added": self.added,
            "mapper": options.pop("name"),
            "mapper_options": options.pop("mapper_options"),
            "random_seed": options.pop("random_seed"),
        }

    def to_json(self) -> str:
        """Return ``report.json`` as text."""
        return PLAIN.dump_json(self.to_mapping(), indent=2).decode() + "\n"

    def summary(
        self,
        *,
        with_warnings: bool = True,
        said: Callable[[Words], str] = with_arguments,
    ) -> str:
        """Return one screen of text.

        Args:
            with_warnings: whether it has what stages warned of, which they have logged.
            said: what options are called: :func:`with_arguments`, or :func:`with_flags`.
        """
        lines = [
            f"registered  {len(self.registered_names)} of {self.images_total} images",
            *self._extension_lines(),
            *self._missing_lines(),
            f"pairs       {self.num_verified_pairs} of {self.num_pairs} verified",
            *self._few_matches_lines(),
            *_some(f"by hand     {text}" for text in self.by_hand),
            *self._matching_lines(),
            *self._camera_lines(said),
            *self._model_lines(),
            *self._preset_lines(),
        ]
        if with_warnings:
            warnings = self.stage_warnings(said).items()
            lines += _some(f"warning     {name}: {why}" for name, why in warnings)
        seconds = "  ".join(f"{stage.name} {stage.wall_s:.1f}" for stage in self.stages)
        lines.append(f"seconds     {seconds}")
        for advice in self.advice[:MAX_ADVICE]:
            texts = filter(None, (advice.why, advice.command))
            lines.append("try         " + "\n            ".join(texts))
        return "\n".join([*lines, *self._last_lines(said)])

    def _last_lines(self, said: Callable[[Words], str]) -> list[str]:
        """Return what reports that know more end with; ``said`` as for :meth:`summary`."""
        del said  # this one knows no more
        return []

    def stage_warnings(self, said: Callable[[Words], str]) -> dict[str, str]:
        """Return what stages warned of, by what it is about."""
        of_stages = (stage.warned for stage in self.stages)
        return texts_by_subject(itertools.chain.from_iterable(of_stages), said)

    def _few_matches_lines(self) -> list[str]:
        """Return what else ties a model of which too few pairs are verified."""
        largest = largest_of(self.models)
        num_needed = len(largest.registered_names) - 1
        is_tied = self.num_verified_pairs >= num_needed
        if is_tied or self.extended or largest.tie_points:
            return []
        return ["            others have fewer matches, which agree beyond chance"]

    def _extension_lines(self) -> list[str]:
        if not self.extended:
            return []
        num_before = len(self.extended)
        return [
            f"extended    {num_before} were there, {len(self.added)} came in",
            *[f"            new {name}" for name in self.added],
        ]

    def _missing_lines(self) -> list[str]:
        missing = {name: why.text() for name, why in self.unregistered.items()}
        return _some(f"        not {line}" for line in by_story(missing))

    def _matching_lines(self) -> list[str]:
        """Return what guided matching and escalation have done."""
        lines = []
        if self.guided:
            num_pairs = self.guided["pairs"]
            pairs = "pair" if num_pairs == 1 else "pairs"
            before = self.guided["matches_before"]
            after = self.guided["matches_after"]
            lines.append(
                f"guided      {num_pairs} {pairs} matched again: {after} inliers, "
                f"{before} before"
            )
        if self.matched_again:
            texts = ", ".join(again.text() for again in self.matched_again)
            lines.append(f"again       {texts} (effort {self.effort})")
        return lines

    def _camera_lines(self, said: Callable[[Words], str]) -> list[str]:
        """Return where focal lengths are from, and what may be wrong of them."""
        if not self.cameras:
            return []
        counts = Counter(str(camera["source"]) for camera in self.cameras)
        sources = counts.most_common()
        texts = [f"{count} {SOURCES.get(source, source)}" for source, count in sources]
        return [
            f"cameras     focal lengths: {', '.join(texts)}",
            *[f"            {said(note)}" for note in camera_notes(self.cameras)],
        ]

    def _model_lines(self) -> list[str]:
        if not self.models:
            return []
        lines = self.models[0].summary_lines()
        if len(self.models) > 1:
            sizes = ", ".join(str(len(model.registered_names)) for model in self.models)
            lines.append(f"models      {len(self.models)}, of {sizes} images")
        for number, model in enumerate(self.models[1:MAX_LINES], 1):
            lines.append(f"            sparse/{number}: sure {model.classes_text()}")
        return lines

    def _preset_lines(self) -> list[str]:
        """Return the preset and the mapper, unless they are the usual ones."""
        options = self.mapping["mapper_options"]
        given = [f"{key}={value}" for key, value in options.items()]
        chosen = ", ".join([self.preset, f"{self.mapping['name']} mapper", *given])
        return [] if chosen == USUAL else [f"preset      {chosen}"]
