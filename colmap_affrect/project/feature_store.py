"""Features of a run in HDF5, in hloc's layout (docs/formats.md).

Features of the levels of escalation follow each other in the order in which they were asked for:
those of ``levels[k]`` end at ``level_ends[k]``. Descriptors of several sizes are filled up with
zeros, which change no distance. The file is opened for one image and closed again; what is written
in between appears as a whole (:mod:`colmap_affrect.project.atomic_files`).
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import LocalFeatures, of_one_size, union
from colmap_affrect.errors import StoreError
from colmap_affrect.geometry.arrays import Floats, Indices, Singles
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.geometry.lines import LineFindings, Lines
from colmap_affrect.project.feature_summary import (
    ImageSummary,
    read_summaries,
    summary_path,
    write_summaries,
)
from colmap_affrect.project.group_store import (
    GroupStore,
    entries_of,
    has_entry,
    num_rows,
    read_checked,
)
from colmap_affrect.project.line_report import (
    LINE_DATASETS,
    line_datasets,
    lines_from_datasets,
)
from colmap_affrect.project.record import Content, stamp_of

NOT_KNOWN = Content()


@lru_cache(maxsize=8)
def _kept_summaries(path: Path, stamp: str) -> dict[str, ImageSummary] | None:
    """Return the summaries beside a file while they belong to it."""
    return read_summaries(path, stamp)


@lru_cache(maxsize=8)
def _entries_of(path: Path, stamp: str) -> Mapping[str, ImageSummary]:
    """Return summaries, perhaps without lines.

    A file is gone through, which takes long, unless that was done when its stamp was the same.
    """
    kept = _kept_summaries(path, stamp)
    if kept is not None:
        return kept
    found = dict[str, ImageSummary]()
    with FeatureStore(path)._open("r") as file:
        for name, group in entries_of(file):
            width, height = read_checked(group, "image_size").tolist()
            found[name] = ImageSummary(
                content=_content(group),
                num_features=num_rows(group, "keypoints"),
                image_size=(width, height),
                lines=None,
            )
    return dict(sorted(found.items()))


@lru_cache(maxsize=8)
def _summaries_of(path: Path, stamp: str) -> Mapping[str, ImageSummary]:
    """Return summaries with what lines say, in the same way."""
    kept = _kept_summaries(path, stamp)
    if kept is not None:
        return kept
    entries = _entries_of(path, stamp)
    found = dict(entries)
    for name, lines in FeatureStore(path).lines_of(entries).items():
        found[name] = entries[name]._replace(lines=lines.findings())
    return found


def _forget_summaries() -> None:
    for known in (_kept_summaries, _entries_of, _summaries_of):
        known.cache_clear()


def _content(group: h5py.Group) -> Content:
    return Content(
        str(group.attrs.get("content", "")), str(group.attrs.get("stamp", ""))
    )


def _level_ends(group: h5py.Group) -> dict[int, int]:
    levels = read_checked(group, "levels").tolist()
    return dict(zip(levels, read_checked(group, "level_ends").tolist(), strict=True))


def _line_datasets(group: h5py.Group) -> dict[str, NDArray[Any]]:
    return {k: read_checked(group, k) for k in LINE_DATASETS if k.encode() in group.id}


def frame_datasets(lafs: Floats) -> dict[str, Singles]:
    """Return (N, 2, 3) frames, and their scales in sigmas and orientations in degrees."""
    stored = lafs.astype(np.float32)
    shapes = stored[:, :, :2].astype(np.float64)
    scales = np.sqrt(np.abs(np.linalg.det(shapes))) / MEASUREMENT_SIGMAS
    oris = np.rad2deg(np.arctan2(shapes[:, 1, 0], shapes[:, 0, 0])).astype(np.float32)
    return {"lafs": stored, "scales": scales.astype(np.float32), "oris": oris}


class FeatureStore(GroupStore):
    """Local features by image name."""

    format = "colmap_affrect/features"
    stage = "extract"

    def _entries(self) -> Mapping[str, ImageSummary]:
        if not self.path.exists():
            return {}
        return _entries_of(self.path, stamp_of([self.path]))

    @contextmanager
    def _open(self, mode: str) -> Iterator[h5py.File]:
        if mode != "r":
            # It may change again within one tick of the clock.
            summary_path(self.path).unlink(missing_ok=True)
            _forget_summaries()
        with super()._open(mode) as file:
            yield file

    def keep_summaries(self) -> None:
        """Write beside the file what later commands need of it, unless that is there."""
        if not self.path.exists():
            return
        stamp = stamp_of([self.path])
        if _kept_summaries(self.path, stamp) is None:
            write_summaries(self.path, stamp, _summaries_of(self.path, stamp))
            _kept_summaries.cache_clear()

    def names(self) -> list[str]:
        """Return the sorted names of the images."""
        return sorted(self._entries())

    def write(
        self,
        name: str,
        features: LocalFeatures,
        image_size: tuple[int, int],
        content: Content = NOT_KNOWN,
        lines: Lines | None = None,
    ) -> None:
        """Write the features of one image.

        Args:
            name: of the image.
            features: of the image.
            image_size: (width, height) in px.
            content: what the files hold that they are from.
            lines: its straight lines; None where they were not measured.
        """
        with self._open("a") as file:
            self._write_features(
                file,
                name,
                features,
                image_size,
                level_ends={0: len(features)},
                content=content,
                more={} if lines is None else line_datasets(lines),
            )

    def contents(self) -> dict[str, Content]:
        """Return for each image what the files hold that it was extracted from."""
        return {name: entry.content for name, entry in self._entries().items()}

    def record_contents(self, contents: Mapping[str, Content]) -> None:
        """Put on record what images were extracted from."""
        with self._open("a") as file:
            for name, content in contents.items():
                file[name].attrs.update(content=content.digest, stamp=content.stamp)

    def remove(self, names: Iterable[str]) -> None:
        """Remove the features of images."""
        with self._open("a") as file:
            for name in names:
                del file[name]

    def extend(self, name: str, features: LocalFeatures, level: int) -> None:
        """Add the features of another level; what is there keeps its indices.

        Args:
            name: of the image.
            features: of this level alone, in px of the stored image.
            level: number of the level in the recipe.
        """
        with self._open("a") as file:
            group = self._group(file, name)
            known = self._features(group)
            first_id = int(known.rectification_ids.max(initial=0))
            ids = features.rectification_ids
            added = replace(
                features, rectification_ids=np.where(ids, ids + first_id, 0)
            )
            both = union(of_one_size([known, added]))
            self._write_features(
                file,
                name,
                features=both,
                image_size=tuple(read_checked(group, "image_size").tolist()),
                level_ends={**_level_ends(group), level: len(both)},
                content=_content(group),
                more=_line_datasets(group),
            )

    def _write_features(
        self,
        file: h5py.File,
        name: str,
        features: LocalFeatures,
        image_size: tuple[int, int],
        level_ends: dict[int, int],
        content: Content,
        more: Mapping[str, NDArray[Any]],
    ) -> None:
        datasets = {
            "keypoints": features.keypoints.astype(np.float32),
            "descriptors": features.descriptors.T.astype(np.float16),
            "scores": features.responses,
            "image_size": np.asarray(image_size),
            **frame_datasets(features.lafs),
            "rectification_ids": features.rectification_ids,
            "levels": np.asarray(list(level_ends)),
            "level_ends": np.asarray(list(level_ends.values())),
            **more,
        }
        self._write(file, name, datasets, content=content.digest, stamp=content.stamp)

    def read(self, name: str) -> LocalFeatures:
        """Read all features of one image; StoreError if they are missing."""
        with self._open("r") as file:
            return self._features(self._group(file, name))

    def lines_of(self, names: Iterable[str]) -> dict[str, Lines]:
        """Return the straight lines of images; files of older versions have none."""
        found = dict[str, Lines]()
        if not self.path.exists():
            return found
        with self._open("r") as file:
            for name in names:
                if has_entry(file, name):
                    lines = lines_from_datasets(_line_datasets(file[name]))
                    if lines is not None:
                        found[name] = lines
        return found

    def line_findings(self) -> dict[str, LineFindings]:
        """Return what the straight lines of images say, of all that have some on record."""
        if not self.path.exists():
            return {}
        found = dict[str, LineFindings]()
        for name, summary in _summaries_of(self.path, stamp_of([self.path])).items():
            if summary.lines:
                found[name] = summary.lines
        return found

    def level_indices(self, name: str, level: int, base: int = 0) -> Indices:
        """Return the indices of the features of two levels, each once, rising.

        Args:
            name: of the image.
            level: number of a level in the recipe.
            base: number of another one, or the same.

        Returns:
            (N,) int64.
        """
        ranges = self.level_ranges(name)
        indices = np.arange(ranges[level].start, ranges[level].stop)
        if base == level:
            return indices
        others = np.arange(ranges[base].start, ranges[base].stop)
        return np.sort(np.concatenate([others, indices]))

    def _group(self, file: h5py.File, name: str) -> h5py.Group:
        if not has_entry(file, name):
            raise StoreError(
                f"no features of {name}", where=self.path, advice="run extract first"
            )
        return file[name]

    @staticmethod
    def _features(group: h5py.Group) -> LocalFeatures:
        return LocalFeatures(
            lafs=read_checked(group, "lafs").astype(np.float64),
            responses=read_checked(group, "scores"),
            descriptors=np.ascontiguousarray(
                read_checked(group, "descriptors").T, dtype=np.float32
            ),
            rectification_ids=read_checked(group, "rectification_ids"),
        )

    def level_ranges(self, name: str) -> dict[int, range]:
        """Return which features are of each level that an image has, in their order."""
        with self._open("r") as file:
            ends = _level_ends(self._group(file, name))
        ranges = dict[int, range]()
        start = 0
        for level, end in ends.items():
            ranges[level] = range(start, end)
            start = end
        return ranges

    def num_keypoints(self) -> dict[str, int]:
        """Return the number of features of each image."""
        return {name: entry.num_features for name, entry in self._entries().items()}

    def image_size(self, name: str) -> tuple[int, int]:
        """Return the (width, height) of one image in px."""
        width, height = self._values(name, "image_size").tolist()
        return width, height

    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """Return the (width, height) of each image in px."""
        return {name: entry.image_size for name, entry in self._entries().items()}

    def read_frames(self, name: str) -> Singles:
        """Read the (N, 2, 3) frames of one image."""
        return self._values(name, "lafs")

    def read_rectification_ids(self, name: str) -> Indices:
        """Read the (N,) warps that the features of one image come from; 0 is the image itself."""
        return self._values(name, "rectification_ids")

    def _values(self, name: str, dataset: str) -> NDArray[Any]:
        with self._open("r") as file:
            return read_checked(self._group(file, name), dataset)
