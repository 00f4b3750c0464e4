-- The tables of COLMAP 3.8, filled from `new`, a database of the installed pycolmap.
PRAGMA user_version = 3800; -- newer ones take the tables over by it
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
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB);

-- Descriptors of type 0 are SIFT. Geometries of configuration 9, calibrated with rigs, become 2,
-- calibrated.
BEGIN;
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
COMMIT;
