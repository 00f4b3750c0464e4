"""Panoramas, by perspective views of them: pycolmap's ``panorama`` with our functions in it.

Each panorama becomes a rig of views, which are extracted, matched and mapped as photographs are.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import Any, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.model_files import require_written
from colmap_affrect.errors import ImageError, NoModelError, OptionError
from colmap_affrect.images.exif import read_camera_tags
from colmap_affrect.images.photographs import list_images
from colmap_affrect.interop import pycolmap_api as ours
from colmap_affrect.progress import GivenProgress, Progress
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.outputs import refuse_link
from colmap_affrect.project.paths import PathLike, as_path, resolved
from colmap_affrect.project.workspace import Workspace

MATCHING = ("extract_features", "match_exhaustive", "match_sequential", "match_spatial")
"""Functions that show progress; ``incremental_mapping`` has callbacks."""

Order = Literal["sequence", "exhaustive"]
MATCHERS: Mapping[Order, str] = {"sequence": "sequential", "exhaustive": "exhaustive"}


class _Functions:
    """pycolmap, with functions of ours that show progress."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        for name in MATCHING:
            setattr(self, name, partial(getattr(ours, name), progress=progress))

    def __getattr__(self, name: str) -> Any:
        return getattr(pycolmap, name)

    def incremental_mapping(
        self, database_path: Path, image_path: Path, output_path: Path, options: Any
    ) -> Any:
        """Map, and count the views.

        Args:
            database_path: the database of the views.
            image_path: folder of the views.
            output_path: folder of the models.
            options: of pycolmap.
        """
        num_views = len(image_ids(database_path))
        with self.progress.stage("map", num_views, "views") as advance:
            return ours.incremental_mapping(
                database_path,
                image_path,
                output_path,
                options,
                initial_image_pair_callback=lambda: advance(2),
                next_image_callback=lambda: advance(1),
            )


@checks_arguments
def reconstruct_panoramas(
    image_path: PathLike,
    output_path: PathLike,
    *,
    order: Order = "sequence",
    random_seed: int = 0,
    progress: GivenProgress = None,
) -> dict[int, pycolmap.Reconstruction]:
    """Reconstruct panoramas of 360 x 180 degrees.

    Args:
        image_path: folder of the panoramas, twice as wide as high and of one size.
        output_path: a new folder, or that of a call that was interrupted, which goes on. Models of
            the views come into ``sparse``, those of the panoramas themselves into
            ``sparse_equirectangular``, the views into ``images`` and ``masks``.
        order: match panoramas that follow each other by name, or all.
        random_seed: of mapping.
        progress: True, False, or None for where somebody looks at it.

    Returns:
        The models of the panoramas, by the number of their folder.

    Raises:
        ImageError: for pictures that are no panoramas.
        OptionError: when ``output_path`` holds something else.
        NoModelError: when no two panoramas can be registered.
    """
    image_path = as_path(image_path, "image_path")
    output_path = as_path(output_path, "output_path")
    progress = Progress.given(progress)
    names = list_images(image_path)
    _check(image_path, names)
    _check_output(image_path, output_path)
    module: Any = _module(_Functions(progress))
    module.render_perspective_images = _rendering(
        module.render_perspective_images, progress
    )
    options = module.PanoramaReconstructionOptions(
        matcher=module.Matcher(MATCHERS[order]),
        random_seed=random_seed,
        show_progress=False,
    )
    found = module.reconstruct(image_path, output_path, options)
    if not found:
        raise NoModelError(f"no two of the {len(names)} panoramas can be registered")
    models = dict[int, pycolmap.Reconstruction]()
    for number in found:
        folder = output_path / "sparse_equirectangular" / str(number)
        require_written(folder)
        models[number] = pycolmap.Reconstruction(folder)
    return models


def _module(functions: _Functions) -> Any:
    """Return a copy of pycolmap's module that calls functions of ours."""
    spec: Any = find_spec("pycolmap.panorama")
    module: Any = module_from_spec(spec)
    spec.loader.exec_module(module)
    module.pycolmap = functions
    return module


def _rendering(render: Callable[..., Any], progress: Progress) -> Callable[..., Any]:
    """Return what renders views and says so."""

    def rendered(names: Sequence[str], *given: Any) -> Any:
        with progress.stage("views", len(names), "panoramas") as advance:
            processor = render(names, *given)
            advance(len(names))
        return processor

    return rendered


def _check(image_path: Path, names: Sequence[str]) -> None:
    """Refuse pictures that are no panoramas of one size, before anything is made."""
    if len(names) < 2:
        raise ImageError(
            f"has {len(names)} pictures",
            where=image_path,
            advice="give two panoramas or more",
        )
    first_size = None
    for name in names:
        tags = read_camera_tags(image_path / name)
        if not (tags and tags.size):
            raise ImageError(
                "cannot be read",
                where=image_path / name,
                advice="take it out of the folder",
            )
        width, height = tags.size
        if width != 2 * height:
            raise ImageError(
                f"is {width} x {height} px, and a panorama of 360 x 180 degrees is "
                "twice as wide as high",
                where=image_path / name,
                advice="take it out of the folder",
            )
        first_size = first_size or tags.size
        if tags.size != first_size:
            raise ImageError(
                f"is {width} x {height} px, and {names[0]} is {first_size[0]} x "
                f"{first_size[1]} px",
                where=image_path / name,
                advice="panoramas must have one size",
            )


def _check_output(image_path: Path, output_path: Path) -> None:
    """Refuse to write among panoramas, or into a folder of something else."""
    if resolved(output_path).is_relative_to(resolved(image_path)):
        raise OptionError(
            "is in the folder of the panoramas",
            where=output_path,
            advice="give another one",
        )
    for name in (
        "",
        "images",
        "masks",
        "sparse",
        "sparse_equirectangular",
        "database.db",
    ):
        refuse_link(output_path / name)
    begun = Workspace.beside(output_path / "database.db").path
    is_other = output_path.exists() and not output_path.is_dir()
    if is_other or (
        output_path.is_dir() and any(output_path.iterdir()) and not begun.is_dir()
    ):
        raise OptionError(
            "exists already", where=output_path, advice="give a new folder"
        )
