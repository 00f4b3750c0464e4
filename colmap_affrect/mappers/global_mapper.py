"""COLMAP's global mapper: all rotations first, then all positions, then one adjustment."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import ONE_MAPPING, run_mapping
from colmap_affrect.colmap.database import cameras_of_images, open_database
from colmap_affrect.colmap.native_options import Plain, resolve, set_values
from colmap_affrect.errors import Option, OptionError
from colmap_affrect.mappers.adjustment import FINAL, NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappedModel, MapperOptions, MappingTask
from colmap_affrect.mappers.camera_priors import camera_priors

FLAG = Option("mapper-options")
TRACK_LENGTHS = (
    "mapper.track_min_num_views_per_track",
    "mapper.global_positioning.min_num_view_per_track",
    "mapper.bundle_adjustment.min_track_length",
)
"""COLMAP's 3 leaves out the tracks of two images, of which sparse sets have most."""
SEEDED_SECTIONS = (
    "",
    "mapper.",
    "mapper.rotation_averaging.",
    "mapper.global_positioning.",
    "mapper.retriangulation.",
)
THREADED_SECTIONS = ("", "mapper.", "mapper.bundle_adjustment.ceres.solver_options.")


class GlobalOptions(MapperOptions):
    """Global mapping."""

    name: Literal["global"] = "global"
    can_extend: ClassVar[bool] = False

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "ignore_two_view_tracks": True,
        "min_model_size": 3,
        "keep_given_intrinsics": False,
    }


class GlobalMapper:
    """COLMAP's, in one thread: with several threads results vary from run to run.

    Tracks of two images count in all steps or in none: triangulated at the end only, they would
    make points that bundle adjustment has not seen. COLMAP refines all cameras or none, so those
    that are to stay get their parameters back, and the model is adjusted to them.
    """

    Options: ClassVar[type[GlobalOptions]] = GlobalOptions

    def __init__(self, options: GlobalOptions) -> None:
        """Check the options for pycolmap."""
        native = pycolmap.GlobalPipelineOptions()
        resolved = resolve(native, options.mapper_options, FLAG)
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
            output_path: An empty folder.
            random_seed: For all that is left to chance.
            show: Is told the number of images at the end: all register at once.

        Returns:
            The models.

        Raises:
            OptionError: When a model is to be extended.
            AffrectError: When COLMAP ends with an error.
            KeyboardInterrupt: After mapping has been stopped, once COLMAP has ended.
        """
        if task.extend:
            raise OptionError(
                "the global mapper cannot",
                where=Option("extend"),
                advice=("use ", Option("mapper"), " sparse"),
            )
        with ONE_MAPPING:
            return self._models(task, output_path, random_seed, show)

    def _models(
        self,
        task: MappingTask,
        output_path: Path,
        random_seed: int,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Do what :meth:`map` does, while no other of COLMAP's mappers is at work."""
        native = self.native(task, random_seed)

        def call(_: pycolmap.CancellationToken) -> list[pycolmap.Reconstruction]:
            found = pycolmap.global_mapping(
                task.database_path, task.colors_path, output_path, options=native
            )
            return list(found.values())

        models = run_mapping(call, task.cancellation, "global mapper")
        for model in models:
            self._restore_given_cameras(model, task, native.mapper.bundle_adjustment)
        show(max((model.num_reg_images() for model in models), default=0))
        return [MappedModel(model) for model in models]

    def native(
        self, task: MappingTask, random_seed: int
    ) -> pycolmap.GlobalPipelineOptions:
        """Translate the options into pycolmap's.

        Args:
            task: Says which parameters of cameras are refined.
            random_seed: For all that is left to chance.
        """
        options = self.options
        refined = task.refined_intrinsics(options)
        values: dict[str, Plain] = {
            "min_model_size": options.min_model_size,
            "mapper.retriangulation.ignore_two_view_tracks": options.ignore_two_view_tracks,
            "mapper.bundle_adjustment.refine_focal_length": refined.focal_lengths,
            "mapper.bundle_adjustment.refine_extra_params": refined.distortion,
        }
        if not options.ignore_two_view_tracks:
            values |= dict.fromkeys(TRACK_LENGTHS, 2)
        for section in THREADED_SECTIONS:
            values[f"{section}num_threads"] = 1
        for section in SEEDED_SECTIONS:
            values[f"{section}random_seed"] = random_seed
        native = pycolmap.GlobalPipelineOptions()
        set_values(native, values | options.mapper_options)
        return native

    def _restore_given_cameras(
        self,
        model: pycolmap.Reconstruction,
        task: MappingTask,
        options: pycolmap.BundleAdjustmentOptions,
    ) -> None:
        """Give the cameras that are not refined their parameters back, and adjust all else.

        Args:
            model: Changed in place.
            task: Says which cameras were given.
            options: Say which parameters of the other cameras are refined.
        """
        constant = task.constant_cameras(self.options) & set(model.cameras)
        if not constant:
            return
        given = {}
        with open_database(task.database_path) as database:
            for camera in cameras_of_images(database).values():
                given[camera.camera_id] = camera.params.tolist()
        has_changed = False
        for key in constant:
            camera = model.cameras[key]
            if camera.params.tolist() != given[key]:
                camera.params = given[key]
                has_changed = True
        if has_changed:
            priors = camera_priors(model.cameras.values(), task.cameras, task.lines)
            adjuster = Adjuster(
                priors=priors,
                noise_px=NOISE_PX,
                refining=options,
                constant=frozenset(constant),
            )
            adjuster.adjust(model, FINAL)
