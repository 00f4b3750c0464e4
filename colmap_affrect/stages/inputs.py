"""Which photographs a run is about, what is known of them, and how they are extracted."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.colmap.database_copy import read_names
from colmap_affrect.colmap.initial_cameras import InitialCameras
from colmap_affrect.errors import ImageError, OptionError
from colmap_affrect.images.photographs import (
    CameraOptions,
    MaskOptions,
    Photographs,
    checked_names,
    list_images,
    refuse_colliding_keys,
)
from colmap_affrect.options import Options
from colmap_affrect.project.contents import Content, content_of
from colmap_affrect.project.outputs import database_files
from colmap_affrect.recipes import ExtractionOptions


class Inputs(Options):
    """Which photographs a run is about, and what is known of them."""

    image_path: str
    """Folder of the photographs."""
    image_list_path: str = ""
    """List of the photographs to use; all below the folder if empty."""
    from_database: str = ""
    """COLMAP database whose images, cameras, rigs, frames and pose priors are taken over; it stays
    as it is."""
    cameras: CameraOptions = CameraOptions()
    """How images share cameras."""
    masks: MaskOptions = MaskOptions()
    """Where features may be; everywhere by default."""

    @classmethod
    def of(cls, image_path: Path, **given: Any) -> Self:
        """Build from paths, which are made absolute, and options; None is what is not given."""
        values: dict[str, Any] = {
            key: str(value.resolve()) if isinstance(value, Path) else value
            for key, value in {"image_path": image_path, **given}.items()
            if value is not None
        }
        return cls(**values)

    @property
    def photographs(self) -> Photographs:
        """The folder and the masks."""
        return Photographs(Path(self.image_path), self.masks)

    def names(self) -> list[str]:
        """Return the images of the list, else of the database, else of the folder."""
        folder, listed = Path(self.image_path), Path(self.image_list_path)
        if not self.from_database:
            return list_images(folder, listed if self.image_list_path else None)
        known = read_names(Path(self.from_database))
        if not self.image_list_path:
            return checked_names(folder, known, self.from_database)
        names = list_images(folder, listed)
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise ImageError(f"{listed}: lists {unknown[0]}, which {self.from_database} has not")
        return names

    def contents(
        self, names: Iterable[str], options: ExtractionOptions, known: Mapping[str, Content]
    ) -> dict[str, Content]:
        """Return what the files hold that the features of images depend on.

        They are read only where they have changed since they held what is ``known``.
        """
        return {name: content_of(self._files(name, options), known.get(name)) for name in names}

    def _files(self, name: str, options: ExtractionOptions) -> list[Path]:
        files = self.photographs.files(name)
        if options.uses_depth:
            depth = options.depth.file(name)
            files += [*([depth] if depth else []), *self.camera_files]
        return files

    @property
    def camera_files(self) -> list[Path]:
        """The files that cameras and images of the database are taken from."""
        given = [Path(path) for path in (self.from_database, self.cameras.cameras_path) if path]
        return [file for path in given for file in source_files(path)]

    def check(self) -> None:
        """Refuse cameras and masks that cannot be used; OptionError names the option."""
        self.photographs.check()
        read_given_cameras(self.cameras)
        if self.from_database and self.cameras != CameraOptions():
            raise OptionError(
                f"the cameras of {self.from_database} are used; leave out camera mode, model and "
                "parameters, and other options of cameras"
            )

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse photographs with the same key in hloc's files, or that cannot share cameras."""
        refuse_colliding_keys(names)
        if not self.from_database:
            self.initial_cameras.check(names)

    @property
    def may_share(self) -> bool:
        """Whether images of one size may turn out to share a camera that nobody knows."""
        return self.cameras.mode == "auto" and not self.from_database

    @property
    def initial_cameras(self) -> InitialCameras:
        """What decides on cameras."""
        return InitialCameras(Path(self.image_path), self.cameras)


def source_files(path: Path) -> list[Path]:
    """Return the files of a database, a table, or the folder of a model."""
    files = path.iterdir() if path.is_dir() else database_files(path)
    return sorted(file for file in files if file.is_file() and not file.name.endswith("-shm"))
