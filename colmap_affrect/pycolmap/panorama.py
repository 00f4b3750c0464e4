"""pycolmap's reconstruction of panoramas (``pycolmap.panorama``) with rectified features."""

from importlib.util import find_spec, module_from_spec
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_affrect import pycolmap

_spec: Any = find_spec("pycolmap.panorama")
_copy: Any = module_from_spec(_spec)  # the one of other scripts stays as it is
_spec.loader.exec_module(_copy)
_copy.pycolmap = pycolmap  # what its functions call


def reconstruct(
    input_image_path: str | PathLike[str],
    output_path: str | PathLike[str],
    options: "PanoramaReconstructionOptions | None" = None,  # noqa: F405
) -> dict[int, pycolmap.Reconstruction]:
    """Reconstruct panoramas by views of them, as pycolmap does.

    Args:
        input_image_path: folder of the panoramas.
        output_path: folder of the views, the database and the models.
        options: pycolmap's.

    Returns:
        The models, by number.

    Raises:
        AffrectError: features are ``SPHERICAL``.
    """
    return dict(_copy.reconstruct(Path(input_image_path), Path(output_path), options))


if TYPE_CHECKING:
    from pycolmap.panorama import *  # type: ignore[assignment] # noqa: F403
else:
    globals().update(
        {n: v for n, v in vars(_copy).items() if n[0] != "_" and n not in globals()}
    )
