"""COLMAP's global mapper, in a process of its own.

``pycolmap.global_mapping`` takes no cancellation token: only the end of its process stops it.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import all_cameras
from colmap_affrect.colmap.model_files import read_written_model
from colmap_affrect.colmap.native_options import Plain, differences, resolve, set_values
from colmap_affrect.errors import MappingError
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX, Adjuster, priors_of
from colmap_affrect.mappers.base import MappedModel, MapperOptions, MappingTask
from colmap_affrect.parallel.executor import return_freed_memory
from colmap_affrect.parallel.subprocesses import child, end_with

TRACK_LENGTHS = (
    "mapper.track_min_num_views_per_track",
    "mapper.global_positioning.min_num_view_per_track",
    "mapper.bundle_adjustment.min_track_length",
)
SEEDED_SECTIONS = (
    "",
    "mapper.",
    "mapper.rotation_averaging.",
    "mapper.global_positioning.",
    "mapper.retriangulation.",
)


class GlobalOptions(MapperOptions):
    """Global mapping."""

    name: Literal["global"] = "global"

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "ignore_two_view_tracks": True,
        "min_model_size": 3,
        "keep_given_intrinsics": False,
    }


class GlobalMapper:
    """COLMAP's global mapper, in one thread.

    Tracks of two views count in all steps or in none: triangulated at the end only, they would
    make points that bundle adjustment has not seen. It refines all cameras or none; those that are
    to stay get their parameters back, and the model is adjusted to them.
    """

    Options = GlobalOptions

    def __init__(self, options: GlobalOptions) -> None:
        """Check the options for pycolmap."""
        native = pycolmap.GlobalPipelineOptions()
        resolved = resolve(native, options.mapper_options, "--mapper-options")
        self.options = options.changed(mapper_options=resolved)

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`; all images register at once."""
        native = self.native(task, random_seed)
        values = differences(native, pycolmap.GlobalPipelineOptions())
        map_globally(task.database_path, task.colors_path, output_path, values)
        models = [read_written_model(path) for path in sorted(output_path.iterdir())]
        for model in models:
            self._hold_cameras(model, task, native.mapper.bundle_adjustment)
        show(max((model.num_reg_images() for model in models), default=0))
        return [MappedModel(model) for model in models]

    def _hold_cameras(
        self,
        model: pycolmap.Reconstruction,
        task: MappingTask,
        options: pycolmap.BundleAdjustmentOptions,
    ) -> None:
        """Give the cameras that are to stay their parameters back, and adjust all else."""
        constant = task.constant_cameras(self.options) & set(model.cameras)
        given = {c.camera_id: c.params.tolist() for c in all_cameras(task.database_path)}
        moved = {key for key in constant if model.cameras[key].params.tolist() != given[key]}
        for key in moved:
            model.cameras[key].params = given[key]
        if moved:
            priors = priors_of(model.cameras.values(), task.cameras)
            Adjuster(priors, NOISE_PX, options, frozenset(constant)).adjust(model, FINAL)

    def native(self, task: MappingTask, random_seed: int) -> pycolmap.GlobalPipelineOptions:
        """Translate the options into pycolmap's."""
        options = self.options
        distortion = not task.keeps_intrinsics(options)
        native = pycolmap.GlobalPipelineOptions()
        values: dict[str, Plain] = {
            "min_model_size": options.min_model_size,
            "mapper.retriangulation.ignore_two_view_tracks": options.ignore_two_view_tracks,
            "mapper.bundle_adjustment.refine_focal_length": not task.keeps_focal_lengths(options),
            "mapper.bundle_adjustment.refine_extra_params": distortion,
        }
        if not options.ignore_two_view_tracks:
            values |= dict.fromkeys(TRACK_LENGTHS, 2)
        for section in ("", "mapper.", "mapper.bundle_adjustment.ceres.solver_options."):
            values[f"{section}num_threads"] = 1
        for section in SEEDED_SECTIONS:
            values[f"{section}random_seed"] = random_seed
        set_values(native, values | options.mapper_options)
        return native

    def differences(self, task: MappingTask) -> dict[str, Plain]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        native = self.native(task, self.options.random_seed)
        return differences(native, pycolmap.GlobalPipelineOptions())


def map_globally(
    database_path: Path, image_path: Path, output_path: Path, values: Mapping[str, Plain]
) -> None:
    """Map a verified database; models go into ``output_path``/0, /1, ...

    Args:
        database_path: database with two-view geometries.
        image_path: folder of the images, for the colours of the points.
        output_path: an empty folder.
        values: what differs from the default ``pycolmap.GlobalPipelineOptions``.

    Raises:
        MappingError: when COLMAP ends with an error.
        KeyboardInterrupt: after mapping has been stopped.
    """
    return_freed_memory()
    paths = [str(path.resolve()) for path in (database_path, image_path, output_path)]
    with child(__name__, json.dumps([*paths, dict(values)])) as process:
        printed = process.stdout.read() if process.stdout else ""
    code = process.returncode
    if code:
        reason = (printed.splitlines() or ["run.log in the output folder may say more"])[-1]
        raise MappingError(f"COLMAP's global mapper failed (exit code {code}): {reason}")


def main() -> None:
    """Map as the argument says."""
    database_path, image_path, output_path, values = json.loads(sys.argv[1])
    end_with(int(sys.argv[2]))
    options = pycolmap.GlobalPipelineOptions()
    set_values(options, values)
    try:
        pycolmap.global_mapping(database_path, image_path, output_path, options=options)
    except (RuntimeError, ValueError) as error:
        sys.stdout.write("\n" + " ".join(str(error).split()))
        raise


if __name__ == "__main__":
    main()
