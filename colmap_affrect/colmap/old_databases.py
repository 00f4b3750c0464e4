"""Databases of COLMAP 3.8, which COLMAP up to 3.13 reads; they hold no rigs and frames."""

import sqlite3
from contextlib import closing
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import FATAL
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database, read_names
from colmap_affrect.errors import DatabaseError
from colmap_affrect.project.atomic_files import cannot_write, require_space
from colmap_affrect.project.outputs import new_results

VERSION = 3800  # ``user_version`` of COLMAP 3.8; newer ones take the tables over by it

MAPPER_OPTIONS = (
    "--Mapper.tri_ignore_two_view_tracks 0 --Mapper.init_min_num_inliers 50 "
    "--Mapper.init_min_tri_angle 8 --Mapper.abs_pose_min_num_inliers 12 --Mapper.min_model_size 2"
)
"""Our preset for few photographs: by its defaults ``colmap mapper`` finds less, or nothing."""

# COLMAP 3.8 has camera models up to this number
LAST_MODEL = int(pycolmap.CameraModelId.THIN_PRISM_FISHEYE)

ROWS = "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB"
OF_IMAGES = f"""(image_id INTEGER PRIMARY KEY NOT NULL, {ROWS},
    FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE)"""
TABLES = f"""
PRAGMA user_version = {VERSION};
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
    prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
    prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL,
    prior_tx REAL, prior_ty REAL, prior_tz REAL,
    CONSTRAINT image_id_check CHECK (image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY (camera_id) REFERENCES cameras (camera_id));
CREATE UNIQUE INDEX index_name ON images (name);
CREATE TABLE keypoints {OF_IMAGES};
CREATE TABLE descriptors {OF_IMAGES};
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, {ROWS});
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, {ROWS},
    config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);
"""

CONTENT = """
INSERT INTO cameras SELECT camera_id, model, width, height, params, prior_focal_length
    FROM new.cameras;
INSERT INTO images (image_id, name, camera_id) SELECT image_id, name, camera_id FROM new.images;
INSERT INTO keypoints SELECT image_id, rows, cols, data FROM new.keypoints;
INSERT INTO descriptors SELECT image_id, rows, cols, data FROM new.descriptors
    WHERE type = 0 AND cols = 128;
INSERT INTO matches SELECT pair_id, rows, cols, data FROM new.matches;
INSERT INTO two_view_geometries
    SELECT pair_id, rows, cols, data, CASE config WHEN 9 THEN 2 ELSE config END,
    F, E, H, qvec, tvec FROM new.two_view_geometries;
"""
"""What fills the tables, from a database of the installed pycolmap: descriptors of type 0, SIFT;
geometries of configuration 9, calibrated with rigs, as 2, calibrated."""


def export_database(source: Path, target: Path) -> None:
    """Write a database as COLMAP 3.8 makes them; ids stay, and the source is only read.

    Rigs and descriptors of networks are left out. Positions are those of the priors, latitude,
    longitude and altitude, or in metres. DatabaseError when the source cannot be used or has a
    camera model that COLMAP 3.8 does not know, OptionError when the target exists.
    """
    with new_results(target, names=read_names(source)) as (old,):
        new = old.with_name("new.db")
        copy_database(source, new, FATAL)
        require_space(target, new.stat().st_size)
        with open_database(new) as database:
            for camera in database.read_all_cameras():
                if int(camera.model) > LAST_MODEL:
                    raise DatabaseError(
                        f"{source}: camera {camera.camera_id} is of model {camera.model.name}, "
                        "which COLMAP 3.8 does not know; extract with another --camera-model"
                    )
            priors = [prior for prior in database.read_all_pose_priors() if prior.has_position()]
        try:
            with closing(sqlite3.connect(old)) as connection:
                connection.execute("ATTACH ? AS new", (str(new),))
                connection.executescript(f"{TABLES} BEGIN; {CONTENT} COMMIT;")
                connection.executemany(
                    "UPDATE images SET prior_tx = ?, prior_ty = ?, prior_tz = ? WHERE image_id = ?",
                    [(*prior.position.tolist(), prior.corr_data_id.id) for prior in priors],
                )
                connection.commit()
        except sqlite3.Error as error:
            raise cannot_write(target, error) from error
