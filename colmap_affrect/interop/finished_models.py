"""Models of runs that may be at work: what a run is about to replace is not called damaged."""

from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import OptionError, StoreError, WorkspaceError
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.upright import turn_upright, upright_of_run


def read_finished_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model of a run, which may be given by its output folder, or of another program.

    Raises WorkspaceError where a run has taken its model away to write the next one, and what
    :func:`~colmap_affrect.colmap.model_files.read_given_model` raises.
    """
    try:
        return read_given_model(folder)
    except (OptionError, StoreError):
        whole = resolved(folder)
        for path in (whole, *whole.parents[:2]):
            if Workspace(path).is_in_use():
                raise WorkspaceError(
                    "another colmap-affrect is writing this model",
                    where=folder,
                    advice="wait for it, and run the same command again",
                ) from None
    return read_given_model(folder)  # the run may have ended just now


def stand_upright(folder: Path, model: pycolmap.Reconstruction) -> str:
    """Turn a model of a run so that z is up, where the straight lines of photographs tell.

    Nobody reads the features of a run that is at work.

    Args:
        folder: of the model.
        model: its content, which is turned.

    Returns:
        Whose lines tell; empty where it stays as it is.
    """
    if Workspace(resolved(folder).parent.parent).is_in_use():
        return ""
    upright = upright_of_run(folder, model)
    if upright is None:
        return ""
    turn_upright(model, upright)
    return upright.text()
