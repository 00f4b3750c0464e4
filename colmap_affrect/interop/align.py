"""Give a COLMAP model its scale and place: by positions, control points, or known distances."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.model_files import read_given_model, write_model
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.interop.georeference import Georeference
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.tables import read_table
from colmap_affrect.project.workspace import Workspace

MIN_WIDTH = 0.01
"""Of positions, across the line that fits them best, in units of the length along it: with less
nothing tells how the model is turned about that line."""
METRIC, ON_EARTH = ("x", "y", "z"), ("latitude", "longitude", "altitude")
SHOWN = 12  # residuals that the summary lists, the largest first


@dataclass(frozen=True, kw_only=True)
class Reference:
    """What a model is aligned to; exactly one of the first three, or distances.

    Attributes:
        gps_database: COLMAP database that has positions of the photographs by GPS.
        positions_path: CSV of where photographs were taken: name and x, y, z in metres, or
            latitude, longitude, altitude.
        points_path: CSV of points marked in photographs: point, image, px, py, and for control
            points x, y, z in one row or more of each.
        distances: two names, of photographs or of marked points, and their distance in metres.
    """

    gps_database: Path | None = None
    positions_path: Path | None = None
    points_path: Path | None = None
    distances: tuple[tuple[str, str, float], ...] = ()


@dataclass(frozen=True)
class Alignment:
    """What was done.

    Attributes:
        scale: metres for a unit of the model as it was.
        residuals: how far each position, point or distance is off after it, metres.
        georeference: where the model is on earth, if that is known.
    """

    scale: float
    residuals: Mapping[str, float]
    georeference: Georeference | None = None

    def summary(self) -> str:
        """Return a few lines."""
        largest = sorted(self.residuals.items(), key=lambda item: -item[1])
        lines = [f"scale       {self.scale:.6g} metres for a unit of the old model"]
        if len(largest) == 1:  # a single distance is met exactly
            return lines[0]
        lines += [
            f"off         {median(self.residuals.values()):.3g} m in the median of "
            f"{len(largest)}, {largest[0][1]:.3g} m at most",
            *(f"            {name} {value:.3g}" for name, value in largest[:SHOWN]),
        ]
        return "\n".join(lines)


def align(model_path: Path, output_path: Path, reference: Reference) -> Alignment:
    """Write a model in metres; the old one stays as it is.

    Positions and control points give scale, rotation and place, distances the scale alone.

    Args:
        model_path: folder of a COLMAP model.
        output_path: folder of the new model, which must not exist.
        reference: what to align to.

    Raises:
        AffrectError: when the reference is unreadable, or leaves open how the model lies.
    """
    if reference.distances and (reference.gps_database or reference.positions_path):
        raise OptionError("--distance: gives the scale alone; leave it out, or the positions")
    model, place = read_given_model(model_path), None
    if reference.distances:
        new_from_old, residuals = _scale(model, reference)
    else:
        names, old, new, place = _positions(model, reference)
        new_from_old, residuals = _similarity(names, old, new)
    model.transform(new_from_old)
    photographs = Workspace.of_model(model_path).photographs()
    with new_results(output_path, photographs=photographs, names=_images(model)) as (folder,):
        write_model(model, folder)
        if place:
            place.write(folder)
    return Alignment(float(new_from_old.scale), residuals, place)


def _images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return {image.name: image for image in images}


def _centers(model: pycolmap.Reconstruction) -> dict[str, Array]:
    return {name: image.projection_center() for name, image in _images(model).items()}


def _positions(
    model: pycolmap.Reconstruction, reference: Reference
) -> tuple[list[str], Array, Array, Georeference | None]:
    """Return names, places in the model and true places of what the reference knows."""
    old, is_on_earth = _centers(model), False
    if reference.points_path:
        old, true = _marked_points(model, reference.points_path)
    elif reference.gps_database:
        true, is_on_earth = _gps(reference.gps_database)
    elif reference.positions_path:
        true, is_on_earth = _table_of_positions(reference.positions_path)
    else:
        raise OptionError("give --gps, --positions, --points or --distance")
    names = sorted(old.keys() & true.keys())
    if len(names) < 3:
        raise OptionError(
            f"the true places of {len(names)} photographs or points of the model are known, and "
            f"3 are needed; known are those of {', '.join(sorted(true)[:3]) or 'none'}"
        )
    places = np.array([true[name] for name in names])
    origin = Georeference(*places.mean(axis=0).tolist()) if is_on_earth else None
    if origin:
        places = origin.in_metres(places)
    return names, np.array([old[name] for name in names]), places, origin


def _similarity(
    names: Sequence[str], old: Array, new: Array
) -> tuple[pycolmap.Sim3d, dict[str, float]]:
    for points in (old, new):
        along, across, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if across <= MIN_WIDTH * along:
            raise OptionError(
                "the known places lie on one line, about which the model could be turned; give "
                "others beside it, or --distance for the scale alone"
            )
    found = pycolmap.estimate_sim3d(old, new)
    if found is None:
        raise OptionError("the known places do not fit the model in any scale and rotation")
    moved = np.array([found * point for point in old])
    return found, dict(zip(names, np.linalg.norm(moved - new, axis=1).tolist(), strict=True))


def _scale(
    model: pycolmap.Reconstruction, reference: Reference
) -> tuple[pycolmap.Sim3d, dict[str, float]]:
    """Return the scale that fits distances best, by least squares of their shares."""
    places = _centers(model)
    if reference.points_path:
        places |= _marked_points(model, reference.points_path)[0]
    lengths = {}
    for first, second, length in reference.distances:
        for name in (first, second):
            if name not in places:
                raise OptionError(
                    f"--distance: {name} is no photograph of the model, nor a point of --points"
                )
        own = float(np.linalg.norm(places[first] - places[second]))
        if own <= 0.0 or not 0.0 < length < np.inf:
            raise OptionError(f"--distance {first},{second}: must be of two places, and positive")
        lengths[f"{first},{second}"] = own, length
    scale = float(np.exp(np.mean([np.log(true / own) for own, true in lengths.values()])))
    residuals = {name: abs(scale * own - true) for name, (own, true) in lengths.items()}
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)), residuals


def _gps(path: Path) -> tuple[dict[str, Array], bool]:
    """Return the positions of images on record in a database, and whether they are on earth."""
    with open_copy(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        priors = [prior for prior in database.read_all_pose_priors() if prior.has_position()]
    on_earth = pycolmap.PosePriorCoordinateSystem.WGS84
    systems = {prior.coordinate_system for prior in priors}
    if not priors:
        raise DatabaseError(f"{path}: no photograph has a position; give --positions FILE")
    if len(systems) > 1:
        raise DatabaseError(f"{path}: some positions are on earth, others are not")
    found = {
        names[prior.corr_data_id.id]: np.array(prior.position).ravel()
        for prior in priors
        if prior.corr_data_id.id in names
    }
    return found, on_earth in systems


def _number(row: Mapping[str, str], column: str, where: str) -> float:
    try:
        value = float(row[column])
    except (KeyError, ValueError) as error:
        raise OptionError(f"{where}: {column} is missing, or no number") from error
    if not np.isfinite(value):
        raise OptionError(f"{where}: {column} is not finite")
    return value


def _table_of_positions(path: Path) -> tuple[dict[str, Array], bool]:
    where = f"--positions {path}"
    rows = read_table(path, where, ("name", *METRIC, *ON_EARTH))
    is_on_earth = any("latitude" in row for _, row in rows)
    columns = ON_EARTH if is_on_earth else METRIC
    found = {}
    for place, row in rows:
        if "name" not in row or row["name"] in found:
            raise OptionError(f"{place}: has no name, or one that was there before")
        found[row["name"]] = np.array([_number(row, column, place) for column in columns])
    return found, is_on_earth


def _marked_points(
    model: pycolmap.Reconstruction, path: Path
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return marked points by name, in the model and, of control points, where they are."""
    where, images = f"--points {path}", _images(model)
    seen: defaultdict[str, list[tuple[pycolmap.Image, Array]]] = defaultdict(list)
    true = {}
    for place, row in read_table(path, where, ("point", "image", "px", "py", *METRIC), "point"):
        name = row.get("point", "")
        if not name:
            raise OptionError(f"{place}: names no point")
        if any(column in row for column in METRIC):
            true[name] = np.array([_number(row, column, place) for column in METRIC])
        if row.get("image", "") in images:
            mark = np.array([_number(row, "px", place), _number(row, "py", place)])
            seen[name].append((images[row["image"]], mark))
    found = {name: _triangulated(model, views) for name, views in seen.items() if len(views) > 1}
    if not found:
        raise OptionError(f"{where}: no point is marked in two registered photographs")
    for name, place_in_model in found.items():
        if not len(place_in_model):
            raise OptionError(f"{where}: the rays of point {name} do not meet; look at its marks")
    return found, true


def _triangulated(
    model: pycolmap.Reconstruction, views: Sequence[tuple[pycolmap.Image, Array]]
) -> Array:
    """Return where the rays through the marks of a point meet, nothing if they do not."""
    cameras = [model.cameras[image.camera_id] for image, _ in views]
    flat = [camera.cam_from_img(mark) for camera, (_, mark) in zip(cameras, views, strict=True)]
    rays = np.column_stack([np.array(flat), np.ones(len(flat))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    poses = [image.cam_from_world().matrix() for image, _ in views]
    place = pycolmap.triangulate_multi_view_point(poses, rays)
    return np.zeros(0) if place is None else np.asarray(place).ravel()
