"""``incremental_mapping`` with pycolmap's signature, by our mapper; on any verified database."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import refuse_unusable
from colmap_affrect.interop import pycolmap_options as translate
from colmap_affrect.interop.pycolmap_api import CANCELLED, Native, PathLike, Token
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.project.outputs import new_results, temporary_folder


def incremental_mapping(
    database_path: PathLike,
    image_path: PathLike,
    output_path: PathLike,
    options: pycolmap.IncrementalPipelineOptions | Native = None,
    input_path: PathLike = "",
    initial_image_pair_callback: Callable[[], None] | None = None,
    next_image_callback: Callable[[], None] | None = None,
    cancellation_token: Token = None,
) -> dict[int, pycolmap.Reconstruction]:
    """Map any verified database by our mapper and write the models as pycolmap does.

    ``options`` that differ from pycolmap's defaults win over our preset for sparse sets. Models are
    written to 0, 1, ... in ``output_path``, or, with ``input_path``, a model to be extended, into
    it; they are returned by the number of their folder, largest first. A cancelled token stops by
    InterruptedError.
    """
    native = translate.native(options, pycolmap.IncrementalPipelineOptions, "options")
    mapper = MAPPERS.make(translate.mapper_options(native))
    database, output = Path(database_path), Path(output_path)
    refuse_unusable(database)
    with temporary_folder(output) as folder:
        existing = None
        if translate.given_path(input_path):
            extension = Extension(Path(input_path), refine_existing=not native.fix_existing_frames)
            existing = read_existing(extension, database)
        task = MappingTask(
            database,
            Path(image_path) if str(image_path) else None,
            extend=existing,
            cancellation=cancellation_token,
        )
        extends = existing is not None
        show = _Callbacks(initial_image_pair_callback, next_image_callback, extends).show
        try:
            map_database(mapper, task, folder / "sparse", show)
        except KeyboardInterrupt as error:
            if cancellation_token and cancellation_token.is_cancelled:
                raise InterruptedError(CANCELLED) from error
            raise
        return _written(folder / "sparse", output, extends=extends)


def _written(found: Path, output: Path, *, extends: bool) -> dict[int, pycolmap.Reconstruction]:
    """Read models and move their files to where pycolmap writes them."""
    models = {int(path.name): pycolmap.Reconstruction(path) for path in found.iterdir()}
    files = {
        path: (output if extends else output / path.parent.name) / path.name
        for path in found.glob("*/*")
    }
    with new_results(*files.values(), replaces=True) as made:
        for path, new in zip(files, made, strict=True):
            path.replace(new)
    return dict(sorted(models.items()))


@dataclass
class _Callbacks:
    """Calls pycolmap's callbacks for numbers of newly registered images."""

    begun: Callable[[], None] | None
    following: Callable[[], None] | None
    extends: bool
    count: int = 0

    def show(self, number: int) -> None:
        is_first, rest = not self.count, number
        self.count += number
        if is_first:  # of a model that is extended, all images that it has
            rest = 0 if self.extends else max(0, number - 2)
            if self.begun:
                self.begun()
        if self.following:
            for _ in range(rest):
                self.following()
