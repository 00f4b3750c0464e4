"""Whether ids, rigs and frames of a database belong together: else COLMAP ends with an error."""

import sqlite3
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from colmap_affrect.colmap.tables import (
    MAX_NUM_IMAGES,
    SENSOR_CAMERA,
    Tables,
    columns_of,
    rows_of,
)

Value = TypeVar("Value", bound=Hashable)

SENSOR_IMU = 1  # COLMAP's number of the kind of sensor
SENSOR_NAMES = {SENSOR_CAMERA: "camera", SENSOR_IMU: "IMU"}
IDS = {
    "cameras": "camera_id",
    "images": "image_id",
    "rigs": "rig_id",
    "frames": "frame_id",
    "pose_priors": "pose_prior_id",
    "keypoints": "image_id",
    "descriptors": "image_id",
    "matches": "pair_id",
    "two_view_geometries": "pair_id",
}
"""The column of each table that tells its rows apart."""
MAX_ID = MAX_NUM_IMAGES - 1  # COLMAP's largest id of an image
MAX_PAIR_ID = MAX_ID * MAX_NUM_IMAGES + MAX_ID

# By kind of problem the rows concerned; see checks.toml
Found = Mapping[str, list[str]]


class _Sensor(NamedTuple):
    kind: int
    number: int

    def __str__(self) -> str:
        return f"{SENSOR_NAMES.get(self.kind, f'sensor of kind {self.kind},')} {self.number}"


class _Member(NamedTuple):
    """A sensor of a rig."""

    rig_id: int
    sensor: _Sensor
    is_reference: bool
    has_pose: bool  # sensor_from_rig is known; that of the reference is the identity


class _Datum(NamedTuple):
    """What a sensor has recorded for a frame, an image for one."""

    frame_id: int
    data_id: int
    sensor: _Sensor

    def __str__(self) -> str:
        return f"frame {self.frame_id}: {self.sensor}"


def check_links(connection: sqlite3.Connection, tables: Tables, found: Found) -> None:
    """Find what is wrong with ids, rigs and frames.

    Args:
        connection: to the database.
        tables: what the database holds.
        found: gets the problems, by kind.
    """
    _check_ids(connection, found)
    _check_foreign_keys(connection, found)
    members = _members(connection)
    _check_rigs(members, tables, found)
    _check_frames(connection, members, tables, found)


def _twice(values: Iterable[Value]) -> list[Value]:
    """Return the values that are there more than once."""
    return [value for value, count in Counter(values).items() if count > 1]


def _is_id(value: Any, highest: int = MAX_ID) -> bool:
    """Tell whether COLMAP can have a value as an id."""
    return isinstance(value, int) and 0 <= value <= highest


def _check_ids(connection: sqlite3.Connection, found: Found) -> None:
    for table, column in IDS.items():
        if column not in columns_of(connection, table):
            continue
        highest = MAX_PAIR_ID if column == "pair_id" else MAX_ID
        ids = [value for (value,) in rows_of(connection, column, table)]
        for value in ids:
            if not _is_id(value, highest):
                found["bad-id"].append(f"{column} {value!r} of {table}")
        for value in _twice(ids):
            found["bad-id"].append(f"{column} {value!r} of {table}, twice")
    _check_priors(connection, found)


def _check_priors(connection: sqlite3.Connection, found: Found) -> None:
    priors = rows_of(
        connection, "corr_sensor_type corr_sensor_id corr_data_id", "pose_priors"
    )
    known = [row for row in priors if row[1]]  # databases of old have no such columns
    for kind, number, data_id in known:
        if not (_is_id(number) and _is_id(data_id)):
            found["bad-id"].append(
                f"pose prior of {data_id!r} of {_Sensor(kind, number)}"
            )
    for kind, number, data_id in _twice(known):
        found["bad-id"].append(
            f"pose prior of {data_id!r} of {_Sensor(kind, number)}, twice"
        )


def _check_foreign_keys(connection: sqlite3.Connection, found: Found) -> None:
    for table in ("rig_sensors", "frames", "frame_data"):
        if not columns_of(connection, table):
            continue
        for _, row, parent, _ in connection.execute(
            f"PRAGMA foreign_key_check({table})"
        ):
            found["no-parent"].append(f"row {row} of {table}, {parent}")


def _members(connection: sqlite3.Connection) -> list[_Member]:
    """Return the sensors of all rigs."""
    members = []
    references = rows_of(connection, "rig_id ref_sensor_type ref_sensor_id", "rigs")
    for rig_id, kind, number in references:
        members.append(
            _Member(
                rig_id=int(rig_id),
                sensor=_Sensor(int(kind), int(number)),
                is_reference=True,
                has_pose=True,
            )
        )
    others = rows_of(
        connection, "rig_id sensor_type sensor_id sensor_from_rig", "rig_sensors"
    )
    for rig_id, kind, number, pose in others:
        sensor = _Sensor(int(kind), int(number))
        members.append(
            _Member(
                rig_id=int(rig_id),
                sensor=sensor,
                is_reference=False,
                has_pose=bool(pose),
            )
        )
    return members


def _check_rigs(members: Sequence[_Member], tables: Tables, found: Found) -> None:
    """Find sensors that do not exist, are there twice, or have no known pose in their rig."""
    for member in members:
        sensor = member.sensor
        label = f"{member.sensor} of rig {member.rig_id}"
        if sensor.kind not in SENSOR_NAMES:
            found["bad-rig"].append(label)
        elif sensor.kind == SENSOR_CAMERA and sensor.number not in tables.cameras:
            found["no-parent"].append(label)
        elif not member.has_pose:
            found["rig-without-pose"].append(label)
    for sensor in _sensors_there_twice(members):
        found["bad-rig"].append(f"{sensor}, twice")


def _sensors_there_twice(members: Sequence[_Member]) -> list[_Sensor]:
    """Return sensors that are twice in a rig, the reference of two rigs, or other ones of two."""
    in_same_role = _twice((member.sensor, member.is_reference) for member in members)
    in_same_rig = _twice((member.sensor, member.rig_id) for member in members)
    return sorted({sensor for sensor, _ in [*in_same_role, *in_same_rig]})


def _data(connection: sqlite3.Connection) -> list[_Datum]:
    """Return what all frames hold."""
    data = []
    rows = rows_of(connection, "frame_id data_id sensor_type sensor_id", "frame_data")
    for frame_id, data_id, kind, number in rows:
        sensor = _Sensor(int(kind), int(number))
        data.append(_Datum(frame_id=int(frame_id), data_id=int(data_id), sensor=sensor))
    return data


def _check_frames(
    connection: sqlite3.Connection,
    members: Sequence[_Member],
    tables: Tables,
    found: Found,
) -> None:
    """Find frames that hold what is not of their rig, or not of their images."""
    rig_ids = {}
    for frame_id, rig_id in rows_of(connection, "frame_id rig_id", "frames"):
        rig_ids[int(frame_id)] = int(rig_id)
    known_rigs = {member.rig_id for member in members if member.is_reference}
    of_rigs = {(member.rig_id, member.sensor) for member in members}
    data = _data(connection)
    for datum in data:
        why = _fault(datum, tables)
        rig_id = rig_ids.get(datum.frame_id)
        if why:
            found["bad-frame"].append(f"{datum}, {why}")
        elif rig_id in known_rigs and (rig_id, datum.sensor) not in of_rigs:
            found["bad-frame"].append(f"{datum}, which is not in its rig {rig_id}")
    _check_each_once(data, found)


def _check_each_once(data: Sequence[_Datum], found: Found) -> None:
    """Find what is in two frames, and sensors that are twice in a frame."""
    for kind, data_id in _twice((datum.sensor.kind, datum.data_id) for datum in data):
        found["bad-frame"].append(f"{data_id} of {SENSOR_NAMES.get(kind, kind)}, twice")
    for frame_id, sensor in _twice((datum.frame_id, datum.sensor) for datum in data):
        found["bad-frame"].append(f"frame {frame_id}: {sensor}, twice")


def _fault(datum: _Datum, tables: Tables) -> str:
    """Return why an image cannot be what a frame holds, empty if it can."""
    if datum.sensor.kind not in SENSOR_NAMES:
        return "which is no kind of sensor"
    if datum.sensor.kind != SENSOR_CAMERA:
        return ""
    if datum.data_id not in tables.names:
        return f"which has no image {datum.data_id}"
    camera_id = tables.camera_ids[datum.data_id]
    if camera_id != datum.sensor.number and camera_id in tables.cameras:
        return f"while image {datum.data_id} is of camera {camera_id}"
    return ""
