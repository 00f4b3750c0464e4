"""Give a COLMAP model its scale and place: by positions, control points, or known distances."""

import json
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Annotated, TypedDict, Unpack

import numpy as np
from pydantic import Field

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import require_inside, triangulated
from colmap_affrect.colmap.checks import FATAL_FOR_IMAGES, FATAL_FOR_MAPPING
from colmap_affrect.colmap.database_copy import open_copy
from colmap_affrect.colmap.model_files import (
    FAR,
    model_folder,
    why_unusable,
    write_model,
)
from colmap_affrect.errors import DatabaseError, Option, OptionError, Row
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.earth import why_not_on_earth
from colmap_affrect.interop.consensus import agreeing, similarity
from colmap_affrect.interop.consensus import residuals as residuals_of
from colmap_affrect.interop.finished_models import read_finished_model, stand_upright
from colmap_affrect.options import Options, Summarized, documented, takes_fields_of
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.paths import GivenPath, PathLike, as_path
from colmap_affrect.project.tables import read_table

# Beside a model: what COLMAP's files have no place for
GEOREFERENCE = "georeference.json"
# Of known places across the line that fits them best, in units of its length; numeric
MIN_WIDTH = 0.01
METRIC = ("x", "y", "z")
ON_EARTH = ("latitude", "longitude", "altitude")
WGS84 = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
# A position on earth that is no further off is not left out;
# theory: of receivers without corrections
GPS_ERROR_M = 10.0
TABLE_ERROR = 0.02  # the same of other positions, of how far they spread; judged
# Share of the variance of places that an aligned model leaves open: beyond, their errors are larger
# than what it explains; theory
MAX_UNEXPLAINED = 0.5
SHOWN = 12  # residuals in the summary, the largest first; display

Distance = Annotated[tuple[str, str, float], Field(strict=False)]  # a list, too
Places = dict[str, Array]  # (3,) by the name of a photograph or a marked point


class Reference(Options):
    """What a model is aligned to; exactly one of the first three, or distances."""

    gps_database: GivenPath | None = None
    """COLMAP database with positions of the photographs."""
    positions_path: GivenPath | None = None
    """CSV table: ``name`` and ``x, y, z``, or ``latitude, longitude, altitude``."""
    points_path: GivenPath | None = None
    """CSV table of marks: ``point, image, px, py``, and where it is known ``x, y, z``."""
    distances: Annotated[tuple[Distance, ...], Field(strict=False)] = ()
    """Two photographs, or two marks of ``points_path``, and the metres between them."""


@documented
@dataclass(frozen=True)
class Alignment(Summarized):
    """What was done."""

    scale: float
    """Metres for a unit of the model as it was."""
    residuals: Mapping[str, float]
    """How far each position, point or distance is off, in metres."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why positions did not count."""
    upright: str = ""
    """Whose straight lines tell where up is, where distances alone are known; z is up then."""
    spread: float = 0.0
    """How far positions or control points are from their middle, root mean square, in metres."""

    @property
    def contradicts_itself(self) -> bool:
        """Whether places are off by so much that they hardly tell scale and directions."""
        if not self.spread:
            return False
        variance = np.mean(np.square(list(self.residuals.values())))
        return bool(variance > MAX_UNEXPLAINED * self.spread**2)

    def summary(self) -> str:
        """Return a few lines."""
        lines = [f"scale       {self.scale:.6g} metres for a unit of the old model"]
        if self.upright:
            lines.append(f"upright     {self.upright}: z is up")
        if len(self.residuals) > 1:  # a single distance is met exactly
            largest = sorted(self.residuals.items(), key=lambda item: -item[1])
            lines.append(
                f"off         {median(self.residuals.values()):.3g} m in the median of "
                f"{len(largest)}, {largest[0][1]:.3g} m at most"
            )
            lines += [
                f"            {name} {value:.3g}" for name, value in largest[:SHOWN]
            ]
        if self.contradicts_itself:
            lines.append(
                f"doubtful    places that spread {self.spread:.3g} m are off by too much to "
                "tell scale and directions: mend them, or give others"
            )
        lines += [
            f"left out    {name}: {why}" for name, why in sorted(self.left_out.items())
        ]
        return "\n".join(lines)


class ReferenceKeywords(TypedDict, total=False):
    """The fields of :class:`Reference` as keywords of :func:`align`."""

    gps_database: PathLike | None
    positions_path: PathLike | None
    points_path: PathLike | None
    distances: Sequence[tuple[str, str, float]]


@takes_fields_of(Reference)
def align(
    model_path: PathLike,
    output_path: PathLike,
    reference: Reference | None = None,
    **keywords: Unpack[ReferenceKeywords],
) -> Alignment:
    """Write a COLMAP model in metres to a new folder; the old one stays as it is.

    Positions and control points give scale, rotation and place, distances the scale alone; models
    of runs then stand upright by the straight lines of photographs, where these agree. Those
    that are no place on earth, or do not fit the others, are left out and named.

    Args:
        model_path: folder of a model, or the output folder of a run, whose largest model it is.
        output_path: folder to be made.
        reference: what the model is aligned to.
        keywords: fields of :class:`Reference`, as ``distances=[("a.jpg", "b.jpg", 2.5)]``.

    Returns:
        The scale, and how far positions, points or distances are off.

    Raises:
        AffrectError: when the reference is unreadable, or leaves open how the model lies.
    """
    model_path = as_path(model_path, "model_path")
    output_path = as_path(output_path, "output_path")
    return _align(
        model_path,
        output_path,
        Reference.with_keywords(reference, keywords, "reference"),
    )


def _align(model_path: Path, output_path: Path, reference: Reference) -> Alignment:
    """Align with checked arguments."""
    if reference.distances and (reference.gps_database or reference.positions_path):
        raise OptionError(
            "gives the scale alone",
            where=Option("distance"),
            advice="leave it out, or the positions",
        )
    model = read_finished_model(model_path)
    images = {image.name: image for image in map(model.image, model.reg_image_ids())}
    fit = _fit(model, images, reference)
    model.transform(fit.new_from_old)
    upright = ""
    if reference.distances:
        upright = stand_upright(model_folder(model_path), model)
    scale = fit.new_from_old.scale
    why = why_unusable(model)
    if not why and scale <= 1.0 / FAR:
        why = "it has no extent"
    if why:
        raise OptionError(f"a scale of {scale:.3g} cannot be right: {why}")
    with new_results(output_path, names=images) as (folder,):
        write_model(model, folder)
        if fit.origin:
            content = dict(zip(ON_EARTH, fit.origin, strict=True))
            replace_text(folder / GEOREFERENCE, json.dumps(content, indent=1) + "\n")
    return Alignment(
        scale=float(scale),
        residuals=fit.residuals,
        left_out=fit.left_out,
        upright=upright,
        spread=fit.spread,
    )


@dataclass(frozen=True)
class _Fit:
    """How a model is to be transformed.

    Attributes:
        new_from_old: the similarity.
        residuals: how far each position, point or distance is off, in metres.
        origin: latitude, longitude and altitude (WGS 84) of the new origin; empty if not on earth.
        left_out: why positions did not count.
        spread: how far true places are from their middle, root mean square, in metres.
    """

    new_from_old: pycolmap.Sim3d
    residuals: dict[str, float]
    origin: tuple[float, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    spread: float = 0.0


def _fit(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    reference: Reference,
) -> _Fit:
    """Fit a model to its reference.

    Args:
        model: the model.
        images: its registered images by name.
        reference: what the model is aligned to.

    Returns:
        The similarity, and how well it fits.
    """
    old = Places()
    for name, image in images.items():
        old[name] = image.projection_center()
    true = Places()
    is_on_earth = False
    if reference.points_path:
        marked, true = _marked_points(model, images, reference.points_path)
        old = old | marked if reference.distances else marked
    if reference.distances:
        return _scale(old, reference.distances)
    if not reference.points_path:
        true, is_on_earth = _positions(reference)
    left_out = _not_on_earth(true) if is_on_earth else {}
    left_out |= _not_fitting(old, _without(true, left_out), is_on_earth=is_on_earth)
    fit = _similarity(old, _without(true, left_out), is_on_earth=is_on_earth)
    return replace(fit, left_out=left_out)


def _positions(reference: Reference) -> tuple[Places, bool]:
    """Return the positions of a database or a table, and whether they are on earth."""
    if reference.gps_database:
        return _gps(reference.gps_database)
    if reference.positions_path:
        return _table_of_positions(reference.positions_path)
    raise OptionError(
        "where the model is, nothing says",
        advice=(
            ("give ", Option("gps"), ", ", Option("positions"), ", ", Option("points")),
            (" or ", Option("distance")),
        ),
    )


def _without(places: Places, names: Collection[str]) -> Places:
    return {name: place for name, place in places.items() if name not in names}


def _not_on_earth(true: Places) -> dict[str, str]:
    """Return why some positions are no place on earth, by name."""
    found = dict[str, str]()
    for name, place in true.items():
        why = why_not_on_earth(place)
        if why:
            found[name] = why
    return found


def _not_fitting(old: Places, true: Places, *, is_on_earth: bool) -> dict[str, str]:
    """Return which positions the others contradict, and by how much, by name."""
    names = sorted(old.keys() & true.keys())
    if len(names) < 4:
        return {}
    before = np.array([old[name] for name in names])
    after = np.array([true[name] for name in names])
    if is_on_earth:
        after = np.asarray(WGS84.ellipsoid_to_enu(after, *np.median(after, axis=0)))
        floor = GPS_ERROR_M
    else:
        spread = np.median(np.abs(after - np.median(after, axis=0)), axis=0)
        floor = TABLE_ERROR * float(np.linalg.norm(spread))
    agree = agreeing(before, after, floor)
    found = similarity(before[agree], after[agree])
    if agree.all() or found is None:
        return {}
    off = residuals_of(found, before, after)
    contradicted = dict[str, str]()
    for name, distance, agrees in zip(names, off.tolist(), agree, strict=True):
        if not agrees:
            contradicted[name] = f"{_metres(distance)} from where the others say"
    return contradicted


def _metres(distance: float) -> str:
    return f"{distance / 1000:.0f} km" if distance >= 10_000 else f"{distance:.3g} m"


def _similarity(old: Places, true: Places, *, is_on_earth: bool) -> _Fit:
    """Return the similarity of least squares; x, y, z are east, north, up of an origin on earth."""
    names = sorted(old.keys() & true.keys())
    if len(names) < 3:
        raise OptionError(
            f"the true places of {len(names)} photographs or points of the model "
            "are known, and 3 are needed; known are those of "
            f"{', '.join(sorted(true)[:3]) or 'none'}",
        )
    before = np.array([old[name] for name in names])
    after = np.array([true[name] for name in names])
    origin = _middle_on_earth(after) if is_on_earth else ()
    if origin:
        after = np.asarray(WGS84.ellipsoid_to_enu(after, *origin))
    for points in (before, after):
        along, across, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if across <= MIN_WIDTH * along:
            raise OptionError(
                "the known places lie on one line, about which the model could be "
                "turned",
                advice=(
                    "give others beside it, or ",
                    Option("distance"),
                    " for the scale alone",
                ),
            )
    new_from_old = similarity(before, after)
    if new_from_old is None:
        raise OptionError(
            "the known places do not fit the model in any scale and rotation"
        )
    residuals = residuals_of(new_from_old, before, after).tolist()
    from_middle = np.linalg.norm(after - after.mean(axis=0), axis=1)
    return _Fit(
        new_from_old=new_from_old,
        residuals=dict(zip(names, residuals, strict=True)),
        origin=origin,
        spread=float(np.sqrt(np.mean(from_middle**2))),
    )


def _middle_on_earth(positions: Array) -> tuple[float, ...]:
    """Return latitude, longitude and altitude amid (N, 3) positions.

    Longitudes have no mean across 180 degrees or at a pole, places in space have one. That is below
    the ground where positions are far apart, so that its altitude does not count.
    """
    in_space = np.asarray(WGS84.ellipsoid_to_ecef(positions)).mean(axis=0)
    latitude, longitude, _ = np.asarray(WGS84.ecef_to_ellipsoid(in_space[None]))[0]
    altitude = positions[:, 2].mean()
    return float(latitude), float(longitude), float(altitude)


def _scale(places: Places, distances: Sequence[tuple[str, str, float]]) -> _Fit:
    """Return the scale that fits distances best, by least squares of their logarithms."""
    lengths = {}
    for first, second, length in distances:
        for name in (first, second):
            if name not in places:
                raise OptionError(
                    (
                        f"{name} is no photograph of the model, nor a point of ",
                        Option("points"),
                    ),
                    where=Option("distance"),
                )
        own = float(np.linalg.norm(places[first] - places[second]))
        if own <= 0.0 or not 0.0 < length < np.inf:
            raise OptionError(
                "must be of two places, and positive",
                where=(Option("distance"), f" {first},{second}"),
            )
        lengths[f"{first},{second}"] = own, length
    log_ratios = [np.log(true / own) for own, true in lengths.values()]
    scale = float(np.exp(np.mean(log_ratios)))
    residuals = {name: abs(scale * own - true) for name, (own, true) in lengths.items()}
    new_from_old = pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3))
    return _Fit(new_from_old, residuals)


def _gps(path: Path) -> tuple[Places, bool]:
    """Return the pose priors of a database by image name, and whether they are on earth."""
    with open_copy(path, FATAL_FOR_IMAGES - FATAL_FOR_MAPPING) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        all_priors = database.read_all_pose_priors()
    priors = [prior for prior in all_priors if prior.has_position()]
    systems = {prior.coordinate_system for prior in priors}
    if not priors:
        raise DatabaseError(
            "no photograph has a position (latitude, longitude and altitude)",
            where=path,
            advice=("give ", Option("positions"), " FILE"),
        )
    if len(systems) > 1:
        raise DatabaseError("some positions are on earth, others are not", where=path)
    true = Places()
    for prior in priors:
        image_id = prior.corr_data_id.id
        if image_id in names:
            true[names[image_id]] = np.array(prior.position).ravel()
    return true, pycolmap.PosePriorCoordinateSystem.WGS84 in systems


def _numbers(row: Mapping[str, str], columns: Sequence[str], where: Row) -> Array:
    """Return the numbers of some columns of a row of a table."""
    values = []
    for column in columns:
        try:
            values.append(float(row[column]))
        except (KeyError, ValueError) as error:
            raise OptionError(
                f"{column} is missing, or no number", where=where
            ) from error
        if not np.isfinite(values[-1]):
            raise OptionError(f"{column} is not finite", where=where)
    return np.array(values)


def _table_of_positions(path: Path) -> tuple[Places, bool]:
    """Return the positions of a table, and whether they are on earth."""
    rows = read_table(path, "positions", ("name", *METRIC, *ON_EARTH))
    is_on_earth = any("latitude" in row for _, row in rows)
    true = Places()
    for place, row in rows:
        if "name" not in row or row["name"] in true:
            raise OptionError("has no name, or one that was there before", where=place)
        true[row["name"]] = _numbers(row, ON_EARTH if is_on_earth else METRIC, place)
    return true, is_on_earth


def _marked_points(
    model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image], path: Path
) -> tuple[Places, Places]:
    """Return where marked points are in the model, and the true places of control points."""
    marks: defaultdict[str, dict[int, Array]] = defaultdict(dict)  # by image id
    true = Places()
    columns = ("point", "image", "px", "py", *METRIC)
    for place, row in read_table(path, "points", columns, "point"):
        name = row.get("point", "")
        if not name:
            raise OptionError("names no point", where=place)
        if not row.keys().isdisjoint(METRIC):
            true[name] = _numbers(row, METRIC, place)
        image = images.get(row.get("image", ""))
        if image is not None:
            camera = model.cameras[image.camera_id]
            mark = _numbers(row, ("px", "py"), place)
            require_inside(place, mark, image.name, (camera.width, camera.height))
            marks[name][image.image_id] = mark
    return _triangulated_points(model, marks, Option("points", path)), true


def _triangulated_points(
    model: pycolmap.Reconstruction,
    marks: Mapping[str, Mapping[int, Array]],
    where: Option,
) -> Places:
    """Return where points are in a model that are marked in two of its images or more."""
    old = Places()
    for name, marked in marks.items():
        if len(marked) < 2:
            continue
        point = triangulated(model, marked)
        if point is None:
            raise OptionError(
                f"the rays of point {name} do not meet",
                where=where,
                advice="look at its marks",
            )
        old[name] = point
    if not old:
        raise OptionError(
            "no point is marked in two registered photographs", where=where
        )
    return old
