"""Manual input: tie points, wrong pairs, photographs to leave out.

None of it changes ``database.db``: what is mapped is a copy with the tie points as keypoints behind
the others, and without the verified pairs that are not to be used.
"""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from itertools import chain, combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    cameras_of_images,
    ids_of_images,
    names_of_images,
)
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.masked_matches import leave_out_masked, read_painted_masks
from colmap_affrect.errors import Option, OptionError, Row, Words
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.options import Options, suggestion
from colmap_affrect.project.paths import GivenPath
from colmap_affrect.project.regular_files import read_regular
from colmap_affrect.project.tables import read_table

SIGMA_PX = 3.0  # standard deviation of a mark by hand; judged
# Of the error of a mark that fits: one of 3,000 has more by chance; theory
AGREEING_SIGMAS = 4.0
COLUMNS = {
    "point": ("point", "marker", "label"),
    "photograph": ("photograph", "photo", "image", "camera"),
    "x": ("px", "x"),
    "y": ("py", "y"),
}
"""What a table of tie points may call its columns; x and y beside px and py are those of points."""
# COLMAP's kinds of keypoints
SIZE_COLUMNS = {4: [2], 6: [2, 5]}
"""Columns of keypoints that hold a radius, or the diagonal of a shape, by the number of columns."""
Marks = Mapping[str, Mapping[str, Array]]
"""(2,) px from the upper left corner of the image, as COLMAP has them, by point and image name."""
# Numbers of keypoints, by point and image name
Indices = Mapping[str, Mapping[str, int]]
Names = Annotated[tuple[str, str], Field(strict=False)]  # a list, too
# (width, height) of a photograph by its name
SizeOf = Callable[[str], tuple[int, int] | None]


def unknown_size(_: str) -> None:
    """Return that the size of a photograph is not known."""


class ByHand(Options):
    """Manual input, which is used where matches alone say something else."""

    tie_points_path: GivenPath | None = None
    """Table of the same points in several photographs."""
    rejected: Annotated[tuple[Names, ...], Field(strict=False)] = ()
    """Pairs of names of photographs whose matches are wrong."""
    left_out: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names of photographs that are not to be mapped."""
    masks_path: GivenPath | None = None
    """Folder of masks painted after matching: matches below black are not mapped."""

    def marks(self, names: Collection[str], size_of: SizeOf = unknown_size) -> Marks:
        """Read the tie points, as :func:`read_marks` does.

        Args:
            names: of all photographs.
            size_of: returns (width, height) of a photograph in px, None where it is not known.

        Raises:
            OptionError: names the line that cannot be used, or a photograph that is not there.
        """
        for pair in self.rejected:
            for name in pair:
                require_known(name, names, "reject-pair")
        for name in self.left_out:
            require_known(name, names, "leave-out")
        if not self.tie_points_path:
            return {}
        return read_marks(self.tie_points_path, names, size_of)

    def allows(self, first: str, second: str) -> bool:
        """Tell whether a pair may be used.

        Args:
            first: name of one photograph.
            second: name of the other one; the order does not count.
        """
        if first in self.left_out or second in self.left_out:
            return False
        rejected = self.rejected
        return (first, second) not in rejected and (second, first) not in rejected

    def texts(self) -> tuple[str, ...]:
        """Return what is said, in a few words each."""
        found = list[str]()
        if self.tie_points_path:
            found.append(f"tie points of {self.tie_points_path.name}")
        for first, second in self.rejected:
            found.append(f"pair {first}, {second} rejected")
        for name in self.left_out:
            found.append(f"{name} left out")
        if self.masks_path:
            found.append(f"masks of {self.masks_path.name}")
        return tuple(found)

    def digest(self) -> str:
        """Return what differs where this does; empty where nothing is said."""
        if self == ByHand():
            return ""
        names = (sorted(self.rejected), sorted(self.left_out))
        found = hashlib.sha256(repr(names).encode())
        if self.tie_points_path and self.tie_points_path.is_file():
            found.update(read_regular(self.tie_points_path))
        if self.masks_path:
            for path in sorted(self.masks_path.rglob("*.png")):
                found.update(str(path.relative_to(self.masks_path)).encode())
                found.update(read_regular(path))
        return found.hexdigest()

    def copy_database(self, source: Path, target: Path) -> Indices:
        """Write the database that is to be mapped.

        Args:
            source: the database of the run, which stays as it is.
            target: the new database.

        Returns:
            The numbers of the keypoints that tie points have become.

        Raises:
            OptionError: as :meth:`marks`.
            DatabaseError: as :func:`~colmap_affrect.colmap.database_copy.copy_database`.
        """
        found: dict[str, Mapping[str, int]] = {}

        def change(database: pycolmap.Database) -> None:
            self._leave_out_masked(database)
            found.update(self._add_tie_points(database))
            self._delete_pairs(database)

        copy_database(source, target, change=change)
        return found

    def _leave_out_masked(self, database: pycolmap.Database) -> None:
        """Take out matches below masks; their pairs have to be verified again."""
        if not self.masks_path:
            return
        masks = read_painted_masks(self.masks_path, ids_of_images(database))
        leave_out_masked(database, masks)

    def _add_tie_points(self, database: pycolmap.Database) -> Indices:
        """Add the tie points behind the keypoints of their images; return their numbers."""
        cameras = cameras_of_images(database)
        image_ids = {}
        sizes = {}
        for image in database.read_all_images():
            camera = cameras[image.image_id]
            image_ids[image.name] = image.image_id
            sizes[image.name] = (camera.width, camera.height)
        indices = defaultdict[str, dict[str, int]](dict)
        added = defaultdict[str, list[Array]](list)
        for point, marks in self.marks(image_ids, sizes.get).items():
            for name, mark in marks.items():
                if name in self.left_out:
                    continue
                num_keypoints = database.num_keypoints_for_image(image_ids[name])
                indices[point][name] = num_keypoints + len(added[name])
                added[name].append(mark)
        for name, positions in added.items():
            _append_keypoints(database, image_ids[name], np.array(positions))
        return indices

    def _delete_pairs(self, database: pycolmap.Database) -> None:
        """Delete matches and two-view geometries of pairs that may not be used."""
        names = names_of_images(database)
        for ids in combinations(sorted(names), 2):
            if not self.allows(names[ids[0]], names[ids[1]]):
                database.delete_two_view_geometry(*ids)
                database.delete_matches(*ids)


NOTHING = ByHand()


def require_known(name: str, names: Collection[str], option: str = "") -> None:
    """Refuse the name of a photograph that is not there.

    Args:
        name: of a photograph.
        names: of all photographs.
        option: that the name came by, for the error; empty for none.

    Raises:
        OptionError: says which photograph may be meant.
    """
    if name not in names:
        where: Words = Option(option, name) if option else name
        hint = suggestion(name, names)
        raise OptionError(f"no such photograph{hint}", where=where)


def _append_keypoints(
    database: pycolmap.Database, image_id: int, positions: Array
) -> None:
    """Add (N, 2) positions behind the keypoints of an image, as disks of three pixels."""
    if not database.exists_keypoints(image_id):
        database.write_keypoints(image_id, positions.astype(np.float32))
        return
    known = database.read_keypoints(image_id)
    num_columns = known.shape[1]
    new = np.zeros((len(positions), num_columns), np.float32)
    new[:, :2] = positions
    new[:, SIZE_COLUMNS.get(num_columns, [])] = SIGMA_PX
    database.update_keypoints(image_id, np.concatenate([known, new]))


def require_inside(
    place: Words, mark: Array, name: str, size: tuple[int, int] | None
) -> None:
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
        raise OptionError("x and y must be finite numbers of px", where=place)
    if size and not ((mark >= -SIGMA_PX) & (mark <= np.add(size, SIGMA_PX))).all():
        raise OptionError(
            f"{mark[0]:g}, {mark[1]:g} is outside of {name}, which is {size[0]} x "
            f"{size[1]} px",
            where=place,
            advice="give px of the photograph as it is stored, from its upper left corner",
        )


def read_marks(
    path: Path, names: Collection[str], size_of: SizeOf = unknown_size
) -> Marks:
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
    full_names = _full_names(names)
    headers = [*chain(*COLUMNS.values()), "z"]
    marks = defaultdict[str, dict[str, Array]](dict)
    for place, row in read_table(
        path, "tie-points", columns=headers, key="", usual=tuple(COLUMNS)
    ):
        point = _cell(row, "point")
        photograph = _cell(row, "photograph")
        if not point or not photograph:
            raise OptionError("must name a point and a photograph", where=place)
        meant = full_names.get(photograph, [])
        if len(meant) != 1:
            hint = suggestion(photograph, names)
            raise OptionError(f"no such photograph, {photograph}{hint}", where=place)
        name = meant[0]
        mark = _read_mark(place, row)
        require_inside(place, mark, name, size_of(name))
        before = marks[point].setdefault(name, mark)
        if not np.array_equal(before, mark):
            raise OptionError(
                f"{point} is at {before[0]:g}, {before[1]:g} of {name} already",
                where=place,
                advice="leave one of both out",
            )
    if max(map(len, marks.values()), default=0) < 2:
        where = Option("tie-points", path)
        raise OptionError("no point is marked in two photographs", where=where)
    return marks


def _full_names(names: Collection[str]) -> Mapping[str, list[str]]:
    """Return the photographs that may be meant by a name, also without folder and ending."""
    found = defaultdict[str, list[str]](list)
    for name in names:
        for short in {name, Path(name).name, Path(name).stem}:
            found[short].append(name)
    for name in names:  # a whole name is that of no other
        found[name] = [name]
    return found


def _cell(row: Mapping[str, str], column: str) -> str:
    """Return the cell of a column, whichever of its names the table has; empty without one."""
    for header in COLUMNS[column]:
        if header in row:
            return row[header]
    return ""


def _read_mark(place: Row, row: Mapping[str, str]) -> Array:
    """Return the (2,) px of a row; OptionError names its line unless they are numbers."""
    try:
        return np.array([float(_cell(row, "x")), float(_cell(row, "y"))])
    except ValueError as error:
        raise OptionError("x and y must be numbers of px", where=place) from error


def triangulated(
    model: pycolmap.Reconstruction, marks: Mapping[int, Array]
) -> Array | None:
    """Return the (3,) position that marks of registered images, by their ids, have in common.

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
    if point is None:
        return None
    position: Array = np.asarray(point, np.float64).ravel()
    depths = [pose[2, :3] @ position + pose[2, 3] for pose in poses]
    return position if min(depths) > 0.0 else None
