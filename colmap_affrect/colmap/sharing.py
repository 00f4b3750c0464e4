"""Images of one size that may have one camera: in records, and in a database."""

import sqlite3
from collections import defaultdict
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database


def with_shared_cameras(records: Mapping[int, CameraRecord]) -> dict[int, CameraRecord]:
    """Return records in which images of one size share a camera where nothing is known of it."""
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for key, record in sorted(records.items()):
        if record.source == "guess" and not record.given:
            groups[record.size].append(key)
    shared = dict(records)
    for keys in groups.values():
        same = [shared.pop(key) for key in keys]
        names = sorted(name for record in same for name in record.names)
        shared[keys[0]] = replace(same[0], names=tuple(names))
    return shared


def share_cameras(path: Path, records: Mapping[int, CameraRecord]) -> None:
    """Give the images of a database the cameras of records; cameras without images go."""
    camera_of = {name: key for key, record in records.items() for name in record.names}
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        rigs = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
        frames = {frame.frame_id: frame for frame in database.read_all_frames()}
        for image in database.read_all_images():
            key = camera_of.get(image.name, image.camera_id)
            if key != image.camera_id:
                sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, key)
                frame_id = frames[image.frame_id].frame_id
                moved = pycolmap.Frame(frame_id=frame_id, rig_id=rigs[sensor])
                moved.add_data_id(pycolmap.data_t(sensor, image.image_id))
                database.update_frame(moved)
                image.camera_id = key
                database.update_image(image)
    with closing(sqlite3.connect(path)) as connection, connection:  # pycolmap deletes none
        connection.execute("DELETE FROM rigs WHERE rig_id NOT IN (SELECT rig_id FROM frames)")
        connection.execute("DELETE FROM rig_sensors WHERE rig_id NOT IN (SELECT rig_id FROM rigs)")
        connection.execute(
            "DELETE FROM cameras WHERE camera_id NOT IN (SELECT camera_id FROM images UNION "
            "SELECT ref_sensor_id FROM rigs WHERE ref_sensor_type = :camera UNION "
            "SELECT sensor_id FROM rig_sensors WHERE sensor_type = :camera)",
            {"camera": int(pycolmap.SensorType.CAMERA)},
        )
