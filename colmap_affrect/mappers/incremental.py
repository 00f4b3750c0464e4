"""COLMAP's incremental mapper."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import ONE_MAPPING, run_mapping
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.model_files import model_poses, registered_names
from colmap_affrect.colmap.native_options import resolve, set_values
from colmap_affrect.errors import Option, OptionError
from colmap_affrect.mappers.base import MappedModel, MapperOptions, MappingTask
from colmap_affrect.mappers.existing import ExistingModel
from colmap_affrect.mappers.snapshots import (
    drop_old_snapshots,
    frames_between_snapshots,
    largest_snapshot,
)
from colmap_affrect.options import within

FLAG = Option("mapper-options")


class PipelineOptions(MapperOptions):
    """Options of COLMAP's incremental pipeline."""

    # COLMAP's 16 and 100, halved, as its pipeline does where no first pair is found
    init_min_tri_angle_deg: Annotated[float, within(0.0, 180.0)] = 8.0
    """Smallest angle between the rays of a point, in the first pair of images."""
    init_min_num_inliers: Annotated[int, within(1, 1_000_000)] = 50  # COLMAP
    """Fewest inliers of the first pair of images."""
    abs_pose_min_num_inliers: Annotated[int, within(3, 1_000_000)] = 12  # judged
    """Fewest points that an image is registered by."""
    max_focal_length_ratio: Annotated[float, within(1.0, 1000.0)] = 30.0  # judged
    """Longest focal length, in longer sides of the image; COLMAP's 10 leaves nothing of the
    photographs of a narrow lens."""

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "ignore_two_view_tracks": True,
        "init_min_tri_angle_deg": 16.0,
        "init_min_num_inliers": 100,
        "abs_pose_min_num_inliers": 30,
        "max_focal_length_ratio": 10.0,
        "min_model_size": 10,
        "keep_given_intrinsics": False,
    }


class IncrementalOptions(PipelineOptions):
    """Incremental mapping."""

    name: Literal["incremental"] = "incremental"


class IncrementalMapper:
    """COLMAP's, in one thread: with several the first pair may differ from run to run."""

    Options: ClassVar[type[PipelineOptions]] = IncrementalOptions

    def __init__(self, options: PipelineOptions) -> None:
        """Check the options for pycolmap."""
        native = pycolmap.IncrementalPipelineOptions()
        resolved = resolve(native, options.mapper_options, FLAG)
        if not native.check():
            given = " ".join(f"{key}={value}" for key, value in resolved.items())
            raise OptionError(
                "COLMAP does not accept these values", where=(FLAG, f" {given}")
            )
        self.options = options.changed(mapper_options=resolved)

    def map(
        self,
        task: MappingTask,
        output_path: Path,
        random_seed: int,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Map once, as :class:`colmap_affrect.mappers.base.Mapper` says.

        Args:
            task: What to map.
            output_path: An empty folder that models are written to.
            random_seed: For all that is left to chance.
            show: Is told how many images have been registered so far.

        Returns:
            The models.

        Raises:
            AffrectError: When COLMAP ends with an error.
            KeyboardInterrupt: After mapping has been stopped.
        """
        native = self.native(task, random_seed)
        return self.map_by(native, task, output_path, show)

    def map_by(
        self,
        native: pycolmap.IncrementalPipelineOptions,
        task: MappingTask,
        output_path: Path,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Map once by some of pycolmap's options; otherwise as :meth:`map`.

        Args:
            native: The options.
            task: What to map.
            output_path: An empty folder that models are written to.
            show: Is told how many images have been registered so far.

        Returns:
            The models.

        Raises:
            AffrectError: When COLMAP ends with an error.
            KeyboardInterrupt: After mapping has been stopped.
        """
        with ONE_MAPPING:
            if task.image_path is None:
                native.extract_colors = False
            run = _PipelineRun(
                task=task,
                options=native,
                output_path=output_path,
                show=show,
                database_path=task.database_path,
            )
            models = run_mapping(run.models, task.cancellation, "incremental mapper")
        return [MappedModel(model) for model in models]

    def native(
        self, task: MappingTask, random_seed: int
    ) -> pycolmap.IncrementalPipelineOptions:
        """Translate the options into pycolmap's.

        Args:
            task: Says which parameters of cameras are refined.
            random_seed: For all that is left to chance.
        """
        options = self.options
        refined = task.refined_intrinsics(options)
        native = pycolmap.IncrementalPipelineOptions(
            min_model_size=options.min_model_size,
            max_focal_length_ratio=options.max_focal_length_ratio,
            random_seed=random_seed,
            num_threads=1,
            ba_refine_focal_length=refined.focal_lengths,
            ba_refine_extra_params=refined.distortion,
            constant_cameras=task.constant_cameras(options),
            mapper=dict(
                init_min_tri_angle=options.init_min_tri_angle_deg,
                init_min_num_inliers=options.init_min_num_inliers,
                abs_pose_min_num_inliers=options.abs_pose_min_num_inliers,
                abs_pose_refine_focal_length=refined.focal_lengths,
                abs_pose_refine_extra_params=refined.distortion,
                random_seed=random_seed,
                num_threads=1,
            ),
            triangulation=dict(
                ignore_two_view_tracks=options.ignore_two_view_tracks,
                random_seed=random_seed,
            ),
        )
        set_values(native, options.mapper_options)
        return native


@dataclass
class _PipelineRun:
    """Calls of pycolmap that make the models of one task, and how many images they registered."""

    task: MappingTask
    options: pycolmap.IncrementalPipelineOptions
    output_path: Path
    show: Callable[[int], None]
    database_path: Path
    num_registered: int = 0

    def models(
        self, token: pycolmap.CancellationToken
    ) -> list[pycolmap.Reconstruction]:
        """Map from scratch, resume from a snapshot, or extend the model of the task."""
        snapshots = self.task.snapshot_path
        if self.task.extend:
            return self._extended(self.task.extend, token)
        has_own_snapshots = bool(self.options.snapshot_frames_freq)  # the user's
        if not snapshots or has_own_snapshots:
            return self._map(token)
        self.options.snapshot_path = snapshots
        num_images = len(image_ids(self.task.database_path))
        self.options.snapshot_frames_freq = frames_between_snapshots(num_images)
        snapshot = largest_snapshot(snapshots)
        return self._resumed(snapshot, token) if snapshot else self._map(token)

    def _resumed(
        self, snapshot: Path, token: pycolmap.CancellationToken
    ) -> list[pycolmap.Reconstruction]:
        """Resume from a snapshot, then map the images that are not in its model."""
        self._add(len(registered_names(snapshot)))
        models = self._map(token, snapshot)
        # pycolmap begins no other model after the one that it resumes.
        left = set(image_ids(self.task.database_path))
        for model in models:
            left -= model_poses(model).keys()
        self.options.image_names = sorted(left)
        if len(left) > 1:
            models += self._map(token)
        return models

    def _extended(
        self, existing: ExistingModel, token: pycolmap.CancellationToken
    ) -> list[pycolmap.Reconstruction]:
        """Triangulate the points of an existing model, then register other images."""
        existing.constrain(self.options)
        self._add(len(existing.images))
        with tempfile.TemporaryDirectory(dir=self.output_path) as name:
            folder = Path(name)
            self.database_path = folder / "database.db"
            existing.copy_database(self.task.database_path, self.database_path)
            start = pycolmap.triangulate_points(
                existing.reconstruction, self.database_path, self.task.colors_path, folder,
                options=self.options, cancellation_token=token,
            )  # fmt: skip
            start.write(folder)
            frames = {image.frame_id for image in existing.images}
            # COLMAP drops a model of which no pair ties some images to others.
            models = [
                model
                for model in self._map(token, folder)
                if frames <= set(model.frames)
            ]
        if not models:
            models = [start]
        for model in models:
            existing.restore(model)
        return models

    def _map(
        self, token: pycolmap.CancellationToken, input_path: Path | None = None
    ) -> list[pycolmap.Reconstruction]:
        # Pycolmap also calls it for a resumed model
        num_initial = 0 if input_path else 2
        models = pycolmap.incremental_mapping(
            self.database_path,
            self.task.colors_path,
            self.output_path,
            options=self.options,
            input_path=input_path or "",
            initial_image_pair_callback=lambda: self._add(num_initial),
            next_image_callback=lambda: self._add(1),
            cancellation_token=token,
        )
        return list(models.values())

    def _add(self, number: int) -> None:
        self.num_registered += number
        self.show(self.num_registered)
        if self.task.snapshot_path:
            drop_old_snapshots(self.task.snapshot_path)
