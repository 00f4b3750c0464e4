"""Databases of COLMAP 3.8, which COLMAP up to 3.13 reads; they hold no rigs and frames."""

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import FATAL
from colmap_affrect.colmap.database import fill_descriptors, open_database
from colmap_affrect.colmap.database_copy import copy_database, read_names
from colmap_affrect.errors import DatabaseError, Option, OptionError
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.outputs import new_results, temporary_folder
from colmap_affrect.project.paths import PathLike, as_path
from colmap_affrect.project.workspace import Workspace

MAPPER_OPTIONS = (
    "--Mapper.tri_ignore_two_view_tracks 0 --Mapper.init_min_num_inliers 50 "
    "--Mapper.init_min_tri_angle 8 --Mapper.abs_pose_min_num_inliers 12 --Mapper.min_model_size 2"
)
"""Our preset for few photographs: by its defaults ``colmap mapper`` finds less, or nothing."""

LAST_MODEL = int(pycolmap.CameraModelId.THIN_PRISM_FISHEYE)  # that COLMAP 3.8 has
# Makes the tables, from an attached ``new``
FILL = Path(__file__).with_name("colmap_3_8.sql")


def export_database(
    path: PathLike, database_path: PathLike, *, descriptors: bool = False
) -> int:
    """Write a database as COLMAP 3.8 makes them; ids stay, and the old one is only read.

    Rigs and descriptors of networks are left out. Positions are those of the priors, latitude,
    longitude and altitude, or in metres.

    Args:
        path: a database, or the output folder of a run.
        database_path: the database to make.
        descriptors: write those of ``features.h5`` in the folder, as 8-bit SIFT.

    Returns:
        How many images have descriptors.

    Raises:
        DatabaseError: when the old one cannot be used or has a camera model that COLMAP 3.8 does
            not know.
        OptionError: when the new one exists, or the folder has no features.
    """
    path = as_path(path, "path")
    workspace = Workspace(path) if path.is_dir() else Workspace.beside(path)
    if descriptors and not workspace.features.exists():
        raise OptionError(
            f"{path} is no output folder with features.h5", where=Option("descriptors")
        )
    features = FeatureStore(workspace.features) if descriptors else None
    return _write(workspace.database, as_path(database_path, "database_path"), features)


def _write(source: Path, target: Path, features: FeatureStore | None) -> int:
    with (
        new_results(target, names=read_names(source)) as (old,),
        temporary_folder(old.parent) as folder,  # in which no name is the user's
    ):
        new = folder / "new.db"
        copy_database(source, new, FATAL)
        if features:
            fill_descriptors(new, features)
        require_space(target, new.stat().st_size)
        with open_database(new) as database:
            _refuse_new_models(database, source)
            positions = _positions(database)
        try:
            return _fill(old, new, positions)
        except sqlite3.Error as error:
            raise cannot_write(target, error) from error


def _refuse_new_models(database: pycolmap.Database, source: Path) -> None:
    """Refuse cameras of models that COLMAP 3.8 does not have."""
    for camera in database.read_all_cameras():
        if int(camera.model) > LAST_MODEL:
            raise DatabaseError(
                f"camera {camera.camera_id} is of model {camera.model.name}, which "
                "COLMAP 3.8 does not know",
                where=source,
                advice=("extract with another ", Option("camera-model")),
            )


def _positions(database: pycolmap.Database) -> list[tuple[float, float, float, int]]:
    """Return the positions of the pose priors, each with the id of its image."""
    positions = []
    for prior in database.read_all_pose_priors():
        if prior.has_position():
            x, y, z = prior.position.tolist()
            positions.append((x, y, z, prior.corr_data_id.id))
    return positions


def _fill(
    old: Path, new: Path, positions: Sequence[tuple[float, float, float, int]]
) -> int:
    """Write a database of COLMAP 3.8; return how many images have descriptors."""
    with closing(sqlite3.connect(old)) as connection:
        connection.execute("ATTACH ? AS new", (str(new),))
        connection.executescript(FILL.read_text(encoding="utf-8"))
        connection.executemany(
            "UPDATE images SET prior_tx = ?, prior_ty = ?, prior_tz = ? WHERE image_id = ?",
            positions,
        )
        connection.commit()
        return int(connection.execute("SELECT COUNT(*) FROM descriptors").fetchone()[0])
