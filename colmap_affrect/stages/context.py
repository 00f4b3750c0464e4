"""What all stages of a run have in common."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from colmap_affrect.errors import WeightsError
from colmap_affrect.features.weights import file_sha256
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.stores import FeatureStore, GuidedStore, MatchStore
from colmap_affrect.project.workspace import Workspace


@dataclass(frozen=True)
class Resources:
    """What is needed from outside and does not change results.

    Attributes:
        weights_path: folder with the weights of networks; None searches the usual places.
        device: ``auto``, ``cpu``, ``cuda``, ``cuda:1``, ``mps``; of networks and of matching.
        depth_cache_path: folder that keeps the depth maps of a network; None keeps none.
    """

    weights_path: Path | None = None
    device: str = "auto"
    depth_cache_path: Path | None = None

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
            raise WeightsError(
                f"{path}: is another file than {key} on the machine that leads the work; give "
                "both the same"
            )


@dataclass(frozen=True)
class Context:
    """Where a run works and with what; none of it changes a result."""

    workspace: Workspace  # the output folder
    resources: Resources = field(default_factory=Resources)  # weights and device
    executor: Executor | None = None  # for images and pairs, e.g. a cluster; None: threads here
    progress: Progress = SILENT  # where to show progress

    @property
    def features(self) -> FeatureStore:
        """The features; a file that was made with other options than those on record is refused."""
        return FeatureStore(self.workspace.features, self.workspace.options_digest("extract"))

    @property
    def matches(self) -> MatchStore:
        """The raw matches; refused like features."""
        digest = self.workspace.options_digest("extract", "match")
        return MatchStore(self.workspace.matches, digest)

    @property
    def guided(self) -> GuidedStore:
        """The guided matches; refused like features."""
        digest = self.workspace.options_digest("extract", "match", "verify", "guide")
        return GuidedStore(self.workspace.guided, digest)
