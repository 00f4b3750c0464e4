"""The view graph of a command: images, cameras and verified pairs, read from the database once.

All stages of a command share one (``Context.graph``). What changes the database goes through
:meth:`ViewGraph.open_to_change`, or is followed by :meth:`ViewGraph.forget`. Then the graph is read
anew when it is next asked for. While a command works, its lock keeps other runs out of the folder,
and the database stays open from one stage to the next (:meth:`ViewGraph.keep_open`).
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    cameras_of_images,
    num_inliers_of_pairs,
    open_database,
)
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair


@dataclass(frozen=True)
class ImageRows:
    """What the database holds of the images, by their names."""

    ids: dict[str, int]
    cameras: dict[str, pycolmap.Camera]
    # Of the images that have keypoints on record, also none
    num_keypoints: dict[str, int]


class ViewGraph:
    """Images and verified pairs of a database; of the two images of a pair the lower id is first.

    Attributes:
        path: the database.
    """

    def __init__(self, path: Path) -> None:
        """Name the database; it is read when something is asked for."""
        self.path = path
        self._images: ImageRows | None = None
        self._inliers: dict[Pair, Indices] | None = None
        self._digest = ""
        self._is_kept_open = False
        self._closing = ExitStack()  # of the database that is kept open
        self._database: pycolmap.Database | None = None

    @contextmanager
    def keep_open(self) -> Iterator[None]:
        """Open the database at most once while the block works, unless it is forgotten there."""
        self._is_kept_open = True
        try:
            yield
        finally:
            self._is_kept_open = False
            self.close()

    def close(self) -> None:
        """Close a database that is kept open; it is opened again when it is next asked for."""
        self._database = None
        self._closing.close()

    @contextmanager
    def open_to_read(self) -> Iterator[pycolmap.Database]:
        """Open the database, or take it where it is open, to change nothing."""
        if not self._is_kept_open:
            with open_database(self.path) as database:
                yield database
            return
        self._forget_if_gone()
        if self._database is None:
            self._database = self._closing.enter_context(open_database(self.path))
        try:
            yield self._database
        except RuntimeError as error:
            self._database = None
            # What has opened it makes one line of pycolmap's errors.
            self._closing.__exit__(type(error), error, error.__traceback__)
            raise

    @contextmanager
    def open_to_change(self, *, for_pairs: bool = False) -> Iterator[pycolmap.Database]:
        """Open the database, perhaps to change it.

        Args:
            for_pairs: only matches and two-view geometries are changed.
        """
        images = self._images if for_pairs else None
        try:
            with self.open_to_read() as database:
                yield database
        finally:
            self._forget_rows()
            self._images = images

    def forget(self) -> None:
        """Read everything anew when it is next asked for: the database may be another one."""
        self.close()
        self._forget_rows()

    def _forget_rows(self) -> None:
        self._images = None
        self._inliers = None
        self._digest = ""

    @property
    def ids(self) -> dict[str, int]:
        """The image ids by name; an empty database is made if the file is missing."""
        return self._image_rows().ids

    @property
    def cameras(self) -> dict[str, pycolmap.Camera]:
        """The cameras by image name."""
        return self._image_rows().cameras

    @property
    def num_keypoints(self) -> dict[str, int]:
        """The number of keypoints by image name, where there are some on record, also none."""
        return self._image_rows().num_keypoints

    def inliers(self, min_num_inliers: int) -> dict[Pair, Indices]:
        """Return the inliers of the verified pairs.

        Args:
            min_num_inliers: of a pair; others are left out.

        Returns:
            By pair of image names (M, 2) features of both images.
        """
        inliers = self._all_inliers().items()
        return {pair: rows for pair, rows in inliers if len(rows) >= min_num_inliers}

    def num_inliers(self, min_num_inliers: int) -> dict[Pair, int]:
        """Return the number of inliers of each pair that has at least so many."""
        self._forget_if_gone()
        if self._inliers is None:
            with self.open_to_read() as database:
                self._images = self._images or _read_images(database)
                counts = _read_num_inliers(database, self._images)
        else:
            counts = {pair: len(rows) for pair, rows in self._inliers.items()}
        return {pair: num for pair, num in counts.items() if num >= min_num_inliers}

    def know_digest(self, digest: str) -> None:
        """Take the digest that all rows have now, so that nobody need read them for it."""
        self._digest = digest

    def digest(self) -> str:
        """Return a SHA-256 of all rows but descriptors."""
        self._forget_if_gone()
        if not self._digest:
            self.close()  # SQLite's own copy reads it: locks of pycolmap's would be lost
            self._digest = rows_digest(self.path)
        return self._digest

    def _forget_if_gone(self) -> None:
        if not self.path.exists():
            self.forget()

    def _image_rows(self) -> ImageRows:
        self._forget_if_gone()
        if self._images is None:
            with self.open_to_read() as database:
                self._images = _read_images(database)
        return self._images

    def _all_inliers(self) -> dict[Pair, Indices]:
        self._forget_if_gone()
        if self._inliers is None:
            with self.open_to_read() as database:
                self._images = self._images or _read_images(database)
                self._inliers = _read_inliers(database, self._images)
        return self._inliers


def _read_images(database: pycolmap.Database) -> ImageRows:
    cameras = cameras_of_images(database)
    rows = ImageRows(ids={}, cameras={}, num_keypoints={})
    for image in database.read_all_images():
        rows.ids[image.name] = image.image_id
        rows.cameras[image.name] = cameras[image.image_id]
        if database.exists_keypoints(image.image_id):
            count = database.num_keypoints_for_image(image.image_id)
            rows.num_keypoints[image.name] = count
    return rows


def _read_inliers(
    database: pycolmap.Database, images: ImageRows
) -> dict[Pair, Indices]:
    names = {image_id: name for name, image_id in images.ids.items()}
    found = dict[Pair, Indices]()
    for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
        matches = np.asarray(geometry.inlier_matches, np.int64)
        if len(matches):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            found[names[first], names[second]] = matches
    return found


def _read_num_inliers(
    database: pycolmap.Database, images: ImageRows
) -> dict[Pair, int]:
    """Return the number of inliers of each verified pair, without reading them."""
    names = {image_id: name for name, image_id in images.ids.items()}
    found = dict[Pair, int]()
    for (first, second), count in num_inliers_of_pairs(database).items():
        found[names[first], names[second]] = count
    return found
