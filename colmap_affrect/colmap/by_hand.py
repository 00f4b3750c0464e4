"""What a person says of a set of photographs: tie points, wrong pairs, photographs to leave out.

None of it changes ``database.db``: what is mapped is a copy with the tie points as keypoints behind
the others, and without the verified pairs that are not to be used.
"""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import cameras_of_images
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.errors import OptionError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import Options, suggestion
from colmap_affrect.project.paths import GivenPath
from colmap_affrect.project.regular_files import read_regular
from colmap_affrect.project.tables import read_table

SIGMA_PX = 3.0  # standard deviation of a mark by hand
COLUMNS = {
    "point": ("point", "marker", "label"),
    "photograph": ("photograph", "photo", "image", "camera"),
    "x": ("px", "x"),
    "y": ("py", "y"),
}
"""What a table of tie points may call its columns; x and y beside px and py are those of points."""
Marks = Mapping[str, Mapping[str, Array]]
"""(2,) px from the upper left corner of the image, as COLMAP has them, by point and image name."""
Indices = Mapping[str, Mapping[str, int]]  # numbers of keypoints, by point and image name
Names = Annotated[tuple[str, str], Field(strict=False)]  # a list, too
SizeOf = Callable[[str], tuple[int, int] | None]  # (width, height) of a photograph by its name


def unknown_size(_: str) -> None:
    """Return that the size of a photograph is not known."""


class ByHand(Options):
    """What is to be done otherwise than matches alone say."""

    tie_points_path: GivenPath | None = None
    """Table of the same points in several photographs."""
    rejected: Annotated[tuple[Names, ...], Field(strict=False)] = ()
    """Pairs of names of photographs whose matches are wrong."""
    left_out: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names of photographs that are not to be mapped."""

    def marks(self, names: Collection[str], size_of: SizeOf = unknown_size) -> Marks:
        """Read the tie points, as :func:`read_marks` does.

        OptionError also where photographs are named that are not there.
        """
        asked = [("--reject-pair", name) for pair in self.rejected for name in pair]
        for flag, name in [*asked, *(("--leave-out", name) for name in self.left_out)]:
            require_known(name, names, f"{flag} ")
        if not self.tie_points_path:
            return {}
        return read_marks(self.tie_points_path, names, size_of)

    def allows(self, first: str, second: str) -> bool:
        """Tell whether a pair may be used."""
        rejected = {frozenset(pair) for pair in self.rejected}
        return {first, second} not in rejected and not {first, second} & set(self.left_out)

    def texts(self) -> tuple[str, ...]:
        """Return what is said, in a few words each."""
        table = self.tie_points_path
        return (
            *([f"tie points of {table.name}"] if table else []),
            *(f"pair {first}, {second} rejected" for first, second in self.rejected),
            *(f"{name} left out" for name in self.left_out),
        )

    def digest(self) -> str:
        """Return what differs where this does; empty where nothing is said."""
        if self == ByHand():
            return ""
        found = hashlib.sha256(repr((sorted(self.rejected), sorted(self.left_out))).encode())
        if self.tie_points_path and self.tie_points_path.is_file():
            found.update(read_regular(self.tie_points_path))
        return found.hexdigest()

    def copy_database(self, source: Path, target: Path) -> Indices:
        """Write the database that is to be mapped; return where the tie points are in it."""
        found = defaultdict[str, dict[str, int]](dict)

        def change(database: pycolmap.Database) -> None:
            images = {image.name: image.image_id for image in database.read_all_images()}
            names = {image_id: name for name, image_id in images.items()}
            places = defaultdict[str, list[Array]](list)
            cameras = cameras_of_images(database)
            sizes = {name: (cameras[i].width, cameras[i].height) for name, i in images.items()}
            for point, marks in self.marks(images, sizes.get).items():
                for name, place in marks.items():
                    if name not in self.left_out:
                        count = database.num_keypoints_for_image(images[name])
                        found[point][name] = count + len(places[name])
                        places[name].append(place)
            for name, marked in places.items():
                _append_keypoints(database, images[name], np.array(marked))
            for pair_id in database.read_two_view_geometry_num_inliers()[0]:
                ids = pycolmap.pair_id_to_image_pair(pair_id)
                if not self.allows(*(names[i] for i in ids)):
                    database.delete_two_view_geometry(*ids)

        copy_database(source, target, change=change)
        return found


NOTHING = ByHand()


def require_known(name: str, names: Collection[str], option: str = "") -> None:
    """Refuse the name of a photograph that is not there; OptionError says which may be meant."""
    if name not in names:
        raise OptionError(f"{option}{name}: no such photograph{suggestion(name, names)}")


def _append_keypoints(database: pycolmap.Database, image_id: int, places: Array) -> None:
    """Add (N, 2) places behind the keypoints that an image has, as disks of three pixels."""
    if not database.exists_keypoints(image_id):
        database.write_keypoints(image_id, places.astype(np.float32))
        return
    known = database.read_keypoints(image_id)
    new = np.zeros((len(places), known.shape[1]), np.float32)
    new[:, :2] = places
    new[:, {4: [2], 6: [2, 5]}.get(known.shape[1], [])] = SIGMA_PX
    database.update_keypoints(image_id, np.concatenate([known, new]))


def require_inside(place: str, mark: Array, name: str, size: tuple[int, int] | None) -> None:
    """Refuse a mark that is nowhere in its photograph.

    At the border it may be beyond by what marks are off anyway.

    Args:
        place: the line of a table that an error names.
        mark: (2,) px from the upper left corner.
        name: of the photograph.
        size: (width, height) of the photograph in px, None where it is not known.

    Raises:
        OptionError: the mark is not finite, or outside.
    """
    if not np.isfinite(mark).all():
        raise OptionError(f"{place}: x and y must be finite numbers of px")
    if size and not ((mark >= -SIGMA_PX) & (mark <= np.add(size, SIGMA_PX))).all():
        raise OptionError(
            f"{place}: {mark[0]:g}, {mark[1]:g} is outside of {name}, which is {size[0]} x "
            f"{size[1]} px; give px of the photograph as it is stored, from its upper left corner"
        )


def read_marks(path: Path, names: Collection[str], size_of: SizeOf = unknown_size) -> Marks:
    """Read a table of points that are marked in photographs.

    Its columns are point, photograph, x and y, in any order, or in this order without a header;
    ``COLUMNS`` has other names for them. Photographs may lack folder and ending, where it is clear
    which are meant.

    Args:
        path: the table.
        names: of all photographs.
        size_of: returns (width, height) of a photograph in px, None where it is not known.

    Raises:
        OptionError: names the line that cannot be used.
    """
    where = f"--tie-points {path}"
    stems = defaultdict[str, list[str]](list)
    for name in names:
        for key in {name, Path(name).name, Path(name).stem}:
            stems[key].append(name)
    stems |= {name: [name] for name in names}  # a whole name is that of no other
    marks = defaultdict[str, dict[str, Array]](dict)
    known = [column for alike in COLUMNS.values() for column in alike]
    for place, row in read_table(path, where, [*known, "z"], key="", usual=tuple(COLUMNS)):
        cells = [next((row[key] for key in keys if key in row), "") for keys in COLUMNS.values()]
        point, image, *numbers = cells
        if not point or not image:
            raise OptionError(f"{place}: must name a point and a photograph")
        if len(found := stems.get(image, [])) != 1:
            raise OptionError(f"{place}: no such photograph, {image}{suggestion(image, names)}")
        try:
            mark = np.array([float(number) for number in numbers])
        except ValueError as error:
            raise OptionError(f"{place}: x and y must be numbers of px") from error
        require_inside(place, mark, found[0], size_of(found[0]))
        marks[point][found[0]] = mark
    if not any(len(images) > 1 for images in marks.values()):
        raise OptionError(f"{where}: no point is marked in two photographs")
    return marks


def triangulated(model: pycolmap.Reconstruction, marks: Mapping[int, Array]) -> Array | None:
    """Return the (3,) place that marks of registered images, by their ids, have in common.

    None where their rays do not meet in front of the cameras.
    """
    flat = []
    poses = []
    for image_id, mark in marks.items():
        image = model.images[image_id]
        flat.append(model.cameras[image.camera_id].cam_from_img(mark))
        poses.append(image.cam_from_world().matrix())
    rays = np.column_stack([np.array(flat).reshape(-1, 2), np.ones(len(flat))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    point = pycolmap.triangulate_multi_view_point(poses, rays)
    return None if point is None else np.asarray(point).ravel()
