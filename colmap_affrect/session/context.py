"""What all stages of a run have in common: photographs, options on record, files, view graph."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from colmap_affrect.colmap.by_hand import NOTHING, ByHand
from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.colmap.database_copy import read_names
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import AffrectError, ImageError, OptionError
from colmap_affrect.features.weights import commands_for, find
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.images.photographs import (
    CameraOptions,
    MaskOptions,
    Photographs,
    checked_names,
    list_images,
    refuse_colliding_keys,
)
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.options import EffortName, Options, digest_of
from colmap_affrect.pairs import lists
from colmap_affrect.pairs.lists import Pair, PairList, PairOptions
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.guided_store import GuidedStore
from colmap_affrect.project.match_store import MatchStore
from colmap_affrect.project.outputs import database_files
from colmap_affrect.project.paths import GivenPath, resolved
from colmap_affrect.project.record import Content, ModelInputs, content_of, file_sha256
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions, ExtractionOptions
from colmap_affrect.session.view_graph import ViewGraph

Built = TypeVar("Built")


class Inputs(Options):
    """Which photographs a run is about, and what is known of them."""

    image_path: str
    """Folder of the photographs."""
    image_list_path: str = ""
    """List of the photographs to use; all below the folder if empty."""
    from_database: str = ""
    """COLMAP database whose images, cameras, rigs, frames and pose priors are taken over; it stays
    as it is."""
    cameras: CameraOptions = CameraOptions()
    """How images share cameras."""
    masks: MaskOptions = MaskOptions()
    """Where features may be; everywhere by default."""

    @classmethod
    def of(cls, image_path: Path, **given: Any) -> Self:
        """Build from paths, which are made absolute, and options; None is what is not given."""
        values: dict[str, Any] = {"image_path": str(resolved(image_path))}
        for key, value in given.items():
            if isinstance(value, Path):
                values[key] = str(resolved(value))
            elif value is not None:
                values[key] = value
        return cls(**values)

    @property
    def photographs(self) -> Photographs:
        """The folder and the masks."""
        return Photographs(Path(self.image_path), self.masks)

    def names(self) -> list[str]:
        """Return the images of the list, else of the database, else of the folder."""
        folder = Path(self.image_path)
        listed = Path(self.image_list_path)
        if not self.from_database:
            return list_images(folder, listed if self.image_list_path else None)
        known = read_names(Path(self.from_database))
        if not known:
            raise ImageError(
                "holds no images", where=self.from_database, advice="import some first"
            )
        if not self.image_list_path:
            return checked_names(folder, names=known, where=self.from_database)
        names = list_images(folder, listed)
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise OptionError(
                f"lists {unknown[0]}, which {self.from_database} has not", where=listed
            )
        return names

    def contents(
        self,
        names: Iterable[str],
        options: ExtractionOptions,
        known: Mapping[str, Content],
    ) -> dict[str, Content]:
        """Return what the files hold that the features of images depend on.

        Warps by depth depend on cameras, too; no other features do.

        Args:
            names: of the images.
            options: of extraction.
            known: what the files held; they are only read where that may be otherwise now.

        Returns:
            Digests and stamps by image.
        """
        found = {}
        cameras = ""
        if options.uses_depth and self.cameras != CameraOptions():
            cameras = digest_of(self.cameras.to_mapping())
        for name in names:
            files = self.photographs.files(name)
            if options.uses_depth:
                depth = options.depth.file(name)
                files += [depth] if depth else []
                files += self.camera_files
            found[name] = content_of(files, known=known.get(name), options=cameras)
        return found

    def cameras_digest(self) -> str:
        """Return a digest of all that says which cameras images have, empty where nothing does."""
        files = content_of(self.camera_files).digest
        if self.cameras == CameraOptions():
            return files
        # A table or a model may lie elsewhere: what it holds is in the digest of the files.
        options = self.cameras.changed(cameras_path="").to_mapping()
        return digest_of([files, options])

    @property
    def camera_files(self) -> list[Path]:
        """The files that cameras and images of the database are taken from."""
        files = list[Path]()
        for path in (self.from_database, self.cameras.cameras_path):
            if path:
                files += source_files(Path(path))
        return files

    def check(self) -> None:
        """Refuse cameras and masks that cannot be used; OptionError names the option."""
        self.photographs.check()
        read_given_cameras(self.cameras)
        if self.from_database and self.cameras != CameraOptions():
            raise OptionError(
                f"the cameras of {self.from_database} are used",
                advice="leave out camera mode, model and parameters, and other options of "
                "cameras",
            )

    def check_names(self, names: Sequence[str]) -> list[StageWarning]:
        """Refuse photographs with the same key in hloc's files, or whose cameras cannot be.

        Returns what becomes of cameras otherwise than asked for, as a warning.
        """
        refuse_colliding_keys(names)
        return [] if self.from_database else self.initial_cameras.check(names)

    @property
    def may_share(self) -> bool:
        """Whether images of one size may turn out to share a camera that nobody knows."""
        return self.cameras.mode == "auto" and not self.from_database

    @property
    def initial_cameras(self) -> InitialCameras:
        """What decides on cameras."""
        return InitialCameras(Path(self.image_path), self.cameras)


def source_files(path: Path) -> list[Path]:
    """Return the files of a database, a table, or the folder of a model."""
    files = path.iterdir() if path.is_dir() else database_files(path)
    found = [file for file in files if not file.name.endswith("-shm")]
    return sorted(filter(Path.is_file, found))


class Resources(Options):
    """What is needed from outside and does not change results."""

    weights_path: GivenPath | None = None
    """Folder with the weights of networks; None: the usual places."""
    device: str = "auto"
    """Of networks and of matching: ``auto``, ``cpu``, ``cuda``, ``cuda:1``, ``mps``."""

    def require_device(self, *, uses_network: bool = False) -> str:
        """Return the device, if it is there; torch is loaded only to ask for one or use it."""
        if self.device in ("auto", "cpu") and not uses_network:
            return "cpu"
        from colmap_affrect.features.networks import resolve_device

        return str(resolve_device(self.device))

    def usable_levels(self, options: ExtractionOptions) -> list[int]:
        """Return the first level, and those of escalation whose files of weights are here."""
        missing = set(self._missing_weights(options))
        return [
            number
            for number, level in enumerate(options.levels)
            if number == 0 or missing.isdisjoint(level.weights)
        ]

    def commands_to_complete(self, options: ExtractionOptions) -> list[str]:
        """Return commands each of which gets what other levels wait for; none if none does."""
        return commands_for(self._missing_weights(options))

    def _missing_weights(self, options: ExtractionOptions) -> list[str]:
        return [key for key in options.weights if not find(key, self.weights_path)]


def require_same_files(weights: Mapping[str, Path], digests: Mapping[str, str]) -> None:
    """Refuse weights that are not those of the machine that leads the work."""
    found = {key: file_sha256(path) for key, path in weights.items()}
    for key in sorted(found.keys() | digests.keys()):
        if found.get(key) != digests.get(key):
            raise AffrectError(
                f"is not the file {key} of the machine that leads the work",
                where=weights.get(key, key),
                advice="give both the same",
            )


class OnRecord(Generic[Built]):
    """Options of a stage, as an attribute of a :class:`Context`, built from its section."""

    def __init__(
        self,
        stage: str,
        build: Callable[[Any, str], Built],
        beside: type[Options] | None = None,
    ) -> None:
        """Take what builds them of values and of where these are; not of others ``beside`` them."""
        self._stage = stage
        self._build = build
        self._others = beside.model_fields if beside else {}

    def __get__(self, context: "Context", owner: object) -> Built:
        workspace = context.workspace
        if self._stage == "extract":
            workspace.require("extract")
        record = workspace.options_on_record(self._stage) or {}
        values = {
            key: value for key, value in record.items() if key not in self._others
        }
        return self._build(values, str(workspace.config))


@dataclass(frozen=True)
class Context:
    """Where a run works and with what; only the deadline and the effort change results.

    Options are those on record of the folder, which the workspace reads when a command begins: of
    photographs and features once these have been extracted, of other stages those that were done
    with or are still to be done with.
    """

    inputs = OnRecord("extract", Inputs.from_mapping, beside=ExtractionOptions)
    extraction = OnRecord("extract", ExtractionOptions.from_mapping, beside=Inputs)
    pairing = OnRecord("pairs", PairOptions.from_mapping)
    matching = OnRecord[MatcherOptions]("match", MATCHERS.options)
    verification = OnRecord("verify", VerificationOptions.from_mapping)
    escalation = OnRecord("escalate", EscalateOptions.from_mapping)
    guiding = OnRecord("guide", GuidedOptions.from_mapping)
    mapping = OnRecord[MapperOptions]("map", MAPPERS.options)

    workspace: Workspace  # the output folder
    resources: Resources = field(default_factory=Resources)  # weights and device
    # For images and pairs, e.g. a cluster; None: threads here
    executor: Executor | None = None
    progress: Progress = SILENT  # where to show progress
    # Of time.monotonic(): from then on nothing more is tried
    deadline_s: float = math.inf
    effort: EffortName = "normal"  # how much is tried for images to match again
    by_hand: ByHand = NOTHING  # tie points, wrong pairs, photographs to leave out
    command: tuple[str, ...] = ()  # words of the command line, for advice
    # Of the database
    graph: ViewGraph = field(default_factory=lambda: ViewGraph(Path()))

    def __post_init__(self) -> None:
        """Begin another graph where the folder, and so the database, is another."""
        if self.graph.path != self.workspace.database:
            object.__setattr__(self, "graph", ViewGraph(self.workspace.database))

    def current_model_inputs(self, extends: str = "") -> ModelInputs:
        """Return what models are made from now, perhaps with the digest of one that they extend."""
        return ModelInputs(
            verified=self.graph.digest(), by_hand=self.by_hand.digest(), extends=extends
        )

    def listed_pairs(self) -> PairList:
        """Return the pairs of the list whose images have features."""
        path = self.workspace.pairs
        self.workspace.require("pairs")
        if not path.exists():
            raise AffrectError(
                "no such file, the photographs have changed",
                where=path,
                advice="run 'colmap-affrect pairs' and then match again",
            )
        names = self.features.names()
        if len(names) < 2:
            return PairList.of(())
        return lists.read_pairs_once(path, names)

    def set_digest(self) -> str:
        """Return a digest of the pairs that are listed, and of what is said by hand."""
        return f"{self.matches.state.listed} {self.by_hand.digest()}"

    def usable(self, pairs: Iterable[Pair]) -> list[Pair]:
        """Return the pairs whose images the database has, but those rejected by hand."""
        ids = self.graph.ids
        known = [pair for pair in pairs if pair[0] in ids and pair[1] in ids]
        return [pair for pair in known if self.by_hand.allows(*pair)]

    def num_verified_inliers(self) -> dict[Pair, int]:
        """Return the number of inliers of each verified pair; another program has its threshold."""
        if self.workspace.is_foreign:
            return self.graph.num_inliers(1)
        return self.graph.num_inliers(self.verification.min_num_inliers)

    def verified_inliers(self) -> dict[Pair, Indices]:
        """Return the (M, 2) features of each verified pair that are inliers."""
        return self.graph.inliers(self.verification.min_num_inliers)

    @property
    def features(self) -> FeatureStore:
        """The features."""
        return FeatureStore(self.workspace.features.absolute())

    @property
    def matches(self) -> MatchStore:
        """The raw matches."""
        record = self.workspace.options_on_record("extract")
        num_levels = 1 + len(record.get("escalation", ())) if record else None
        return MatchStore(self.workspace.matches, num_levels)

    @property
    def guided(self) -> GuidedStore:
        """The guided matches."""
        return GuidedStore(self.workspace.guided)
