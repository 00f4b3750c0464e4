"""What a mapper is: it makes models from verified pairs.

Entry points of other packages are in the group ``colmap_affrect.mappers``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol

from pydantic import Field

from colmap_affrect.options import (
    MAX_SEED,
    PartOptions,
    PresetOptions,
    Registry,
    within,
)

if TYPE_CHECKING:
    from colmap_affrect.colmap import pycolmap
    from colmap_affrect.colmap.cameras import CameraRecord
    from colmap_affrect.geometry.lines import LineCamera
    from colmap_affrect.mappers.existing import ExistingModel
    from colmap_affrect.mappers.other_cameras import OtherCameras
    from colmap_affrect.mappers.pair_graph import PairGraph
    from colmap_affrect.project.reasons import Doubt
    from colmap_affrect.project.report import Bridge


class MapperOptions(PartOptions, PresetOptions):
    """Base of the options of all mappers, by default the sparse preset (names as in pycolmap)."""

    ignore_two_view_tracks: bool = False
    """COLMAP's True leaves sparse sets without a model: there most tracks have two views."""
    min_model_size: Annotated[int, within(2, 1_000_000)] = 2
    """Models of fewer images are dropped, as with COLMAP unless they have four fifths of all."""
    keep_given_intrinsics: bool = True
    """Leave camera parameters that the user gave as they are; refining them on a few images of a
    sparse set moves them far away."""
    random_seed: Annotated[int, within(-1, MAX_SEED)] = 0
    """Of all that mapping leaves to chance; -1: another one each time."""
    mapper_options: dict[str, Any] = Field(default_factory=dict)
    """Other options of pycolmap's pipeline, by dotted key (``mapper.init_max_error``); they win
    over those above."""
    can_extend: ClassVar[bool] = True  # register images into a finished model
    max_images_of_some_pairs: ClassVar[int] = 0
    """Fewer images than these a mapper can map by some of their pairs."""


@dataclass(frozen=True)
class RefinedIntrinsics:
    """Which parameters of cameras are refined."""

    focal_lengths: bool
    distortion: bool


@dataclass(frozen=True, eq=False)
class MappingTask:
    """What to map."""

    database_path: Path  # COLMAP database with two-view geometries
    image_path: Path | None  # folder of the photographs, for the colours of points
    extend: ExistingModel | None = None  # register images into this model
    # models from before pairs were matched again, the best first: mappers may begin with them
    previous_models: Sequence[MappedModel] = ()
    # Of snapshots to go on from; mappers may leave it unused
    snapshot_path: Path | None = None
    cancellation: pycolmap.CancellationToken | None = None  # stops mapping from outside
    # pairs of image names whose matches are of features without measured affine shapes, which
    # mistake sides that look alike for each other
    unmeasured_pairs: frozenset[tuple[str, str]] = frozenset()
    # what is known of cameras, by id
    cameras: Mapping[int, CameraRecord] = field(default_factory=dict)
    # what the straight lines of images say of their cameras, by image name
    lines: Mapping[str, LineCamera] = field(default_factory=dict)
    # Images of one size may turn out to share an uncalibrated camera
    may_share: bool = False
    # keypoints of the tie points, by point and image name
    tie_points: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    # pairs of image ids that are not used, by mappers that can leave out pairs
    without_pairs: frozenset[tuple[int, int]] = frozenset()
    # graphs that pair_graph.graph_of has read, by database and fewest inliers of a pair;
    # tasks that ``replace`` makes of this one share them
    graphs: dict[tuple[Path, int], PairGraph] = field(default_factory=dict, repr=False)

    @property
    def colors_path(self) -> Path:
        """A folder that exists, as pycolmap needs one also where there are no photographs."""
        if self.image_path and self.image_path.is_dir():
            return self.image_path
        return self.database_path.parent

    def refined_intrinsics(self, options: MapperOptions) -> RefinedIntrinsics:
        """Return what is to be refined, of at least one camera."""
        records = list(self.cameras.values())
        if not records or not options.keep_given_intrinsics:
            return RefinedIntrinsics(focal_lengths=True, distortion=True)
        focals = not all("focal" in record.given for record in records)
        distortion = focals or not all(record.is_all_given for record in records)
        return RefinedIntrinsics(focals, distortion)

    def constant_cameras(self, options: MapperOptions) -> set[int]:
        """Return the ids of the cameras that are not to be refined.

        One whose focal length alone is given is among them where others are refined: pycolmap has
        no focal length that is constant for some cameras only.
        """
        if not options.keep_given_intrinsics:
            return set()
        refines_focals = self.refined_intrinsics(options).focal_lengths
        found = set[int]()
        for key, record in self.cameras.items():
            if record.is_all_given or (refines_focals and "focal" in record.given):
                found.add(key)
        return found


@dataclass(frozen=True)
class MappedModel:
    """A model and how some of its images came in."""

    reconstruction: pycolmap.Reconstruction
    bridges: Mapping[str, Bridge] = field(default_factory=dict)
    """By the names of images that came in by one verified pair, not by tracks of three images."""
    # Hypotheses that made the model, in the words of a report
    hypotheses: tuple[str, ...] = ()
    axis_turns_deg: Mapping[str, float] = field(default_factory=dict)
    """How far the rotation of each image changes with free principal points, by name. Only where
    points leave open whether constant ones are right, and no model with free ones is taken."""
    other_cameras: OtherCameras | None = None
    """What a camera for each image would make of a model whose images share some by assumption, or
    one camera where they have their own."""
    why_apart: Mapping[str, Doubt] = field(default_factory=dict)
    """Why images of another place, which were in one model with these, are not in this one, by
    name."""
    share_as_modelled: float = 1.0
    """Share of what the images show that moves as the model says, 1 where nothing moves otherwise.
    It was measured before cameras were freed: free ones may fit what moves otherwise."""
    one_place_by: PairGraph | None = None
    """The pairs by which all its images were found to be of one place; None where nothing has
    looked for places, or they are not clearly one."""
    add_last_points: Callable[[pycolmap.Reconstruction], None] | None = None
    """Gives a reconstruction its last points and colours: this one, or a copy, perhaps in another
    thread."""

    def first_by(self, hypothesis: str) -> MappedModel:
        """Return the model with the name of a hypothesis before those that it has."""
        hypotheses = tuple(dict.fromkeys((hypothesis, *self.hypotheses)))
        return replace(self, hypotheses=hypotheses)

    def also_by(self, hypothesis: str) -> MappedModel:
        """Return the model with the name of a hypothesis after those that it has."""
        hypotheses = tuple(dict.fromkeys((*self.hypotheses, hypothesis)))
        return replace(self, hypotheses=hypotheses)


class Mapper(Protocol):
    """Makes models; called with its ``Options``."""

    options: Any  # checked, with pycolmap's full keys in ``mapper_options``

    def map(
        self,
        task: MappingTask,
        output_path: Path,
        random_seed: int,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Map once.

        Args:
            task: What to map.
            output_path: An empty folder that models may be written to.
            random_seed: For all that is left to chance.
            show: Is told how many images have been registered so far.

        Returns:
            The models, in any order.

        Raises:
            AffrectError: When COLMAP ends with an error.
            KeyboardInterrupt: After mapping has been stopped.
        """


MAPPERS: Registry[Mapper] = Registry(
    kind="mapper",
    group="colmap_affrect.mappers",
    built_in={
        "sparse": "colmap_affrect.mappers.sparse:SparseMapper",
        "incremental": "colmap_affrect.mappers.incremental:IncrementalMapper",
        "global": "colmap_affrect.mappers.global_mapper:GlobalMapper",
    },
    default="sparse",
    protocol=Mapper,
    options_base=MapperOptions,
)
