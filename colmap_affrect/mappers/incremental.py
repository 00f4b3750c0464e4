"""COLMAP's incremental mapper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_cancellable
from colmap_affrect.colmap.native_options import Plain, differences, resolve, set_values
from colmap_affrect.errors import MappingError, OptionError
from colmap_affrect.mappers.base import MappedModel, MapperOptions, MappingTask
from colmap_affrect.options import within

FLAG = "--mapper-options"


class PipelineOptions(MapperOptions):
    """Options of COLMAP's incremental pipeline."""

    init_min_tri_angle_deg: Annotated[float, within(0.0, 180.0)] = 8.0
    init_min_num_inliers: Annotated[int, within(1, 1_000_000)] = 50
    abs_pose_min_num_inliers: Annotated[int, within(3, 1_000_000)] = 12
    max_num_attempts: Annotated[int, within(1, 100)] = 3
    """The choice of the first pair is partly chance, and a bad one ends in a small model."""

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "ignore_two_view_tracks": True,
        "init_min_tri_angle_deg": 16.0,
        "init_min_num_inliers": 100,
        "abs_pose_min_num_inliers": 30,
        "min_model_size": 10,
        "max_num_attempts": 1,
        "keep_given_intrinsics": False,
    }


class IncrementalOptions(PipelineOptions):
    """Incremental mapping."""

    name: Literal["incremental"] = "incremental"


class IncrementalMapper:
    """COLMAP's incremental mapper, in one thread.

    With several the choice of the first pair, and so the model, may differ from run to run in
    spite of the seed.
    """

    Options = IncrementalOptions

    def __init__(self, options: PipelineOptions) -> None:
        """Check the options for pycolmap."""
        native = pycolmap.IncrementalPipelineOptions()
        resolved = resolve(native, options.mapper_options, FLAG)
        if not native.check():
            given = " ".join(f"{key}={value}" for key, value in resolved.items())
            raise OptionError(f"{FLAG} {given}: COLMAP does not accept these values")
        self.options = options.changed(mapper_options=resolved)

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        count = 0

        def add(number: int) -> None:
            nonlocal count
            count += number
            show(count)

        native = self.native(random_seed, intrinsics_given=task.intrinsics_given)
        try:
            models = run_cancellable(
                lambda token: pycolmap.incremental_mapping(
                    task.database_path,
                    task.image_path,
                    output_path,
                    options=native,
                    initial_image_pair_callback=lambda: add(2),
                    next_image_callback=lambda: add(1),
                    cancellation_token=token,
                )
            )
        except (RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise MappingError(f"COLMAP's incremental mapper failed: {reason}") from error
        return [MappedModel(model) for model in models.values()]

    def native(
        self, random_seed: int, *, intrinsics_given: bool
    ) -> pycolmap.IncrementalPipelineOptions:
        """Translate the options into pycolmap's."""
        options = self.options
        refine = not (intrinsics_given and options.keep_given_intrinsics)
        native = pycolmap.IncrementalPipelineOptions(
            min_model_size=options.min_model_size,
            random_seed=random_seed,
            num_threads=1,
            ba_refine_focal_length=refine,
            ba_refine_extra_params=refine,
            mapper=dict(
                init_min_tri_angle=options.init_min_tri_angle_deg,
                init_min_num_inliers=options.init_min_num_inliers,
                abs_pose_min_num_inliers=options.abs_pose_min_num_inliers,
                abs_pose_refine_focal_length=refine,
                abs_pose_refine_extra_params=refine,
                random_seed=random_seed,
                num_threads=1,
            ),
            triangulation=dict(
                ignore_two_view_tracks=options.ignore_two_view_tracks, random_seed=random_seed
            ),
        )
        set_values(native, options.mapper_options)
        return native

    def differences(self, *, intrinsics_given: bool) -> dict[str, Plain]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        native = self.native(self.options.random_seed, intrinsics_given=intrinsics_given)
        return differences(native, pycolmap.IncrementalPipelineOptions())
