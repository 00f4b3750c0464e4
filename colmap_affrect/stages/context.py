"""What all stages of a run have in common."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.options import Options, Registry
from colmap_affrect.pairs.base import PairOptions
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.contents import file_sha256
from colmap_affrect.project.stores import FeatureStore, GuidedStore, MatchStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions, ExtractionOptions
from colmap_affrect.stages.inputs import Inputs

AnyOptions = TypeVar("AnyOptions", bound=Options)


@dataclass(frozen=True)
class Resources:
    """What is needed from outside and does not change results."""

    weights_path: Path | None = None  # folder with the weights of networks; None: the usual places
    device: str = "auto"  # of networks and of matching: auto, cpu, cuda, cuda:1, mps
    depth_cache_path: Path | None = None  # folder that keeps the depth maps of a network, if any

    def require_device(self, *, uses_network: bool = False) -> str:
        """Return the device, if it is there; torch is loaded only to ask for one or use it."""
        if self.device in ("auto", "cpu") and not uses_network:
            return "cpu"
        from colmap_affrect.features.networks import resolve_device

        return str(resolve_device(self.device))


def require_same_files(weights: Mapping[str, Path], digests: Mapping[str, str]) -> None:
    """Refuse weights that are not those of the machine that leads the work."""
    for key, path in weights.items():
        if file_sha256(path) != digests[key]:
            raise AffrectError(
                f"{path}: is another file than {key} on the machine that leads the work; give "
                "both the same"
            )


@dataclass(frozen=True)
class Context:
    """Where a run works and with what; none of it changes a result.

    Options are those on record of the folder, which the workspace reads when a command begins: of
    photographs and features once these have been extracted, of other stages those that were done
    with or are still to be done with.
    """

    workspace: Workspace  # the output folder
    resources: Resources = field(default_factory=Resources)  # weights and device
    executor: Executor | None = None  # for images and pairs, e.g. a cluster; None: threads here
    progress: Progress = SILENT  # where to show progress

    @property
    def inputs(self) -> Inputs:
        """Which photographs the run is about, and what is known of them."""
        self.workspace.require("extract")
        return self._built(Inputs, "extract", ExtractionOptions)

    @property
    def extraction(self) -> ExtractionOptions:
        """How features are extracted."""
        self.workspace.require("extract")
        return self._built(ExtractionOptions, "extract", Inputs)

    @property
    def pairing(self) -> PairOptions:
        """How pairs are chosen."""
        return self._built(PairOptions, "pairs")

    @property
    def matching(self) -> MatcherOptions:
        """How pairs are matched."""
        options: MatcherOptions = self._part(MATCHERS, "match")
        return options

    @property
    def verification(self) -> VerificationOptions:
        """How pairs are verified."""
        return self._built(VerificationOptions, "verify")

    @property
    def escalation(self) -> EscalateOptions:
        """Which pairs are escalated."""
        return self._built(EscalateOptions, "escalate")

    @property
    def guiding(self) -> GuidedOptions:
        """How verified pairs are matched again."""
        return self._built(GuidedOptions, "guide")

    @property
    def mapping(self) -> MapperOptions:
        """How images are registered."""
        options: MapperOptions = self._part(MAPPERS, "map")
        return options

    def _built(
        self, cls: type[AnyOptions], stage: str, beside: type[Options] | None = None
    ) -> AnyOptions:
        """Return options of a stage, without those ``beside`` them in its section."""
        others = beside.model_fields if beside else {}
        where, record = str(self.workspace.config), self.workspace.planned(stage) or {}
        values = {key: value for key, value in record.items() if key not in others}
        return cls.from_mapping(values, where)

    def _part(self, registry: Registry[Any], stage: str) -> Any:
        where, values = str(self.workspace.config), self.workspace.planned(stage) or {}
        return registry.options(values, where=where)

    @property
    def features(self) -> FeatureStore:
        """The features."""
        return FeatureStore(self.workspace.features.absolute())

    @property
    def matches(self) -> MatchStore:
        """The raw matches."""
        return MatchStore(self.workspace.matches)

    @property
    def guided(self) -> GuidedStore:
        """The guided matches."""
        return GuidedStore(self.workspace.guided)
