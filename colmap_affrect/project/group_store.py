"""A HDF5 file that changes as a whole: what is there is complete."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import Option, StoreError, damage, how_to_make_again
from colmap_affrect.project import atomic_files
from colmap_affrect.project.given_h5 import require_plausible
from colmap_affrect.project.regular_files import require_regular

CHECKSUM = "crc32"  # of the values of a dataset, its attribute


class GroupStore:
    """A HDF5 file of entries: groups with attributes of their own, perhaps in groups without."""

    format = ""  # attribute of the file
    stage = ""  # that makes it again

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def _open(self, mode: str) -> Iterator[h5py.File]:
        """Open to read ("r"), or to write ("a") all that the block changes or nothing.

        HDF5 itself is only let at memory when writing: a full disk ends its process, and a kill
        between two of its writes leaves a file that cannot be read.
        """
        if mode == "r":
            with self._open_file(self.path, "r") as file:
                yield file
            return
        with (
            atomic_files.uninterrupted(),
            atomic_files.FileTransaction(self.path) as changes,
        ):
            with self._open_file(changes, "r+" if self.path.exists() else "w") as file:
                yield file
            try:
                changes.commit()
            except OSError as error:
                raise atomic_files.cannot_write(self.path, error) from error

    @contextmanager
    def _open_file(
        self, where: Path | atomic_files.FileTransaction, mode: str
    ) -> Iterator[h5py.File]:
        advice = how_to_make_again(self.stage, self.path.parent)
        with damage(self.path, ("unless another program has it open, ", advice)):
            atomic_files.apply_journal(self.path)
            require_regular(self.path)
            with h5py.File(where, mode) as file:
                if mode == "w":
                    file.attrs.update(format=self.format, pixel_origin="center")
                found = file.attrs.get("format")
                if found != self.format:
                    raise StoreError(
                        f"expected the format {self.format}, found {found}",
                        where=self.path,
                        advice=("use another ", Option("output-path")),
                    )
                yield file

    def check_all(self) -> None:
        """Read all that is there; StoreError if it is damaged."""
        if self.path.exists():
            with self._open("r") as file:
                keys = list[bytes]()
                file.id.links.visit(keys.append)
                for key in keys:
                    _require_own(file.id, key)
                for _, group in entries_of(file):
                    for name in group:  # items() has None for what cannot be opened
                        read_checked(group, name)

    @classmethod
    def _write(
        cls, file: h5py.File, key: str, datasets: dict[str, Any], **attributes: Any
    ) -> None:
        if key in file:
            del file[key]
        group = file.create_group(key)
        for name, values in datasets.items():
            cls._write_dataset(group, name, values)
        group.attrs.update(attributes)

    @staticmethod
    def _write_dataset(group: h5py.Group, name: str, values: Any) -> None:
        if name in group:
            del group[name]
        group.create_dataset(name, data=values).attrs[CHECKSUM] = _checksum(values)


def read_checked(group: h5py.Group, name: str) -> NDArray[Any]:
    """Read a dataset; ValueError if it does not hold what was written."""
    key = name.encode()
    _require_own(group.id, key)
    # This takes a third of the time of group[name]
    dataset = h5py.h5d.open(group.id, key)
    properties = dataset.get_create_plist()
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise ValueError(f"the data of {name} are in another file")
    require_plausible(dataset, name)
    values = np.zeros(dataset.shape, dataset.dtype)
    if values.size:
        dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    if h5py.h5a.exists(dataset, CHECKSUM.encode()):
        attribute = h5py.h5a.open(dataset, CHECKSUM.encode())
        stored = np.zeros((), attribute.dtype)
        attribute.read(stored)
        if int(stored) != _checksum(values):
            raise ValueError(f"{group.name}/{name} is not as it was written")
    return values


def num_rows(group: h5py.Group, name: str) -> int:
    """Return the length of a dataset, without reading it."""
    return int(h5py.h5d.open(group.id, name.encode()).shape[0])


def _checksum(values: Any) -> int:
    return zlib.crc32(np.ascontiguousarray(values).data)


def _require_own(group: h5py.h5g.GroupID, key: bytes) -> None:
    """Refuse what is only linked, perhaps from another file; ValueError."""
    if group.links.get_info(key).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{key.decode()} is linked from elsewhere")


def has_entry(file: h5py.File, key: str) -> bool:
    """Return whether there is an entry of this path; what is linked from elsewhere is none."""
    group = file.id
    for part in key.encode().split(b"/"):
        if not group.links.exists(part):
            return False
        if group.links.get_info(part).type != h5py.h5l.TYPE_HARD:
            return False
        group = h5py.h5o.open(group, part)
        if not isinstance(group, h5py.h5g.GroupID):
            return False
    return int(h5py.h5a.get_num_attrs(group)) > 0


def entries_of(group: h5py.Group, path: str = "") -> Iterator[tuple[str, h5py.Group]]:
    """Yield the paths of all entries, and these.

    Their datasets are not opened, which takes long, and links are not followed.
    """
    if path and len(group.attrs):
        yield path, group
        return
    for key in group:
        is_link = not isinstance(group.get(key, getlink=True), h5py.HardLink)
        inner = None if is_link else group[key]
        if isinstance(inner, h5py.Group):
            yield from entries_of(inner, f"{path}/{key}" if path else key)
