"""What a mapper is: it makes models from verified pairs.

Entry points of other packages are in the group ``colmap_affrect.mappers``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol

from pydantic import Field

from colmap_affrect.options import MAX_SEED, PartOptions, PresetOptions, Registry, within

if TYPE_CHECKING:
    from colmap_affrect.colmap import pycolmap
    from colmap_affrect.colmap.cameras import CameraRecord
    from colmap_affrect.mappers.existing import ExistingModel
    from colmap_affrect.project.report import Bridge


class MapperOptions(PartOptions, PresetOptions):
    """Base of the options of all mappers, by default the sparse preset (names as in pycolmap)."""

    ignore_two_view_tracks: bool = False
    """COLMAP's True leaves sparse sets without a model: there most tracks have two views."""
    min_model_size: Annotated[int, within(2, 1_000_000)] = 2
    keep_given_intrinsics: bool = True
    """Leave camera parameters that the user gave as they are; refining them on a few images of a
    sparse set moves them far away."""
    random_seed: Annotated[int, within(-1, MAX_SEED)] = 0
    mapper_options: dict[str, Any] = Field(default_factory=dict)
    """Other options of pycolmap's pipeline, by dotted key (``mapper.init_max_error``); they win
    over those above."""
    can_extend: ClassVar[bool] = True  # register images into a finished model


@dataclass(frozen=True, eq=False)
class MappingTask:
    """What to map."""

    database_path: Path  # COLMAP database with two-view geometries
    image_path: Path | None  # folder of the photographs, for the colours of points
    extend: ExistingModel | None = None  # register images into this model
    # models from before pairs were matched again, the best first: mappers may begin with them
    before: Sequence[MappedModel] = ()
    snapshot_path: Path | None = None  # of snapshots to go on from; mappers may leave it unused
    cancellation: pycolmap.CancellationToken | None = None  # stops mapping from outside
    # pairs of image names that only frames verify which were not measured one by one
    unmeasured: frozenset[tuple[str, str]] = frozenset()
    cameras: Mapping[int, CameraRecord] = field(default_factory=dict)  # what is known, by id
    may_share: bool = False  # images of one size may turn out to share a camera that nobody knows
    # which keypoints show the same by hand, by point and image name
    tie_points: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    @property
    def colors_path(self) -> Path:
        """A folder that exists, as pycolmap needs one also where there are no photographs."""
        photographs = self.image_path
        return photographs if photographs and photographs.is_dir() else self.database_path.parent

    def all_given(self, options: MapperOptions) -> tuple[bool, bool]:
        """Tell whether no focal length, and no distortion, is to be refined: the user gave all."""
        known = self.cameras.values() if options.keep_given_intrinsics else ()
        focals = bool(known) and all("focal" in record.given for record in known)
        return focals, focals and all(record.is_fixed for record in known)

    def constant_cameras(self, options: MapperOptions) -> set[int]:
        """Return the ids of the cameras that are not to be refined.

        One whose focal length alone is given is among them where others are refined: pycolmap has
        no focal length that is fixed for some cameras only.
        """
        all_focals, _ = self.all_given(options)
        return {
            key
            for key, record in self.cameras.items()
            if options.keep_given_intrinsics
            and (record.is_fixed or ("focal" in record.given and not all_focals))
        }


@dataclass(frozen=True)
class MappedModel:
    """A model and how some of its images came in."""

    reconstruction: pycolmap.Reconstruction
    bridges: Mapping[str, Bridge] = field(default_factory=dict)
    """By the names of images that came in by one verified pair, not by tracks of three images."""
    moves: tuple[str, ...] = ()  # what made the model, in the words of a report
    finish: Callable[[], None] | None = None
    """Gives the reconstruction its last points and colours; called once, after it is judged."""


class Mapper(Protocol):
    """Makes models; called with its ``Options``."""

    options: Any  # checked, with pycolmap's full keys in ``mapper_options``

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """Map once; ``output_path`` is an empty folder that models may be written to.

        ``show`` is told how many images have been registered so far. AffrectError when COLMAP ends
        with an error, KeyboardInterrupt after mapping has been stopped.
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
)
