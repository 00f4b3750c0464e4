"""The photographs of a run: which there are, how they share cameras, and their masks."""

import os
import posixpath
import unicodedata
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np

from colmap_affrect.data import Mask
from colmap_affrect.errors import (
    ImageError,
    Option,
    OptionError,
    StoreError,
    not_utf_8,
    one_line,
    such_as,
)
from colmap_affrect.images import reading
from colmap_affrect.images.masks import alpha_mask, read_mask
from colmap_affrect.images.reading import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from colmap_affrect.options import Options, within
from colmap_affrect.project.image_failures import ImageFailure, unusable
from colmap_affrect.project.match_store import pair_key
from colmap_affrect.project.outputs import is_output_folder
from colmap_affrect.project.paths import PathLike, as_path, resolved
from colmap_affrect.project.regular_files import read_regular_text
from colmap_affrect.project.stage_warnings import (
    ODD_NAMES,
    OddName,
    StageWarning,
    WarningCode,
    texts_by_subject,
)

TIFF_SUFFIXES = (".tif", ".tiff")
FOLDERS_OF_SYSTEMS: dict[str, WarningCode] = {
    "@eaDir": "thumbnails", "@__thumb": "thumbnails", "__MACOSX": "thumbnails",
    "#recycle": "deleted_folder", "@Recycle": "deleted_folder",
    "$RECYCLE.BIN": "deleted_folder", "#snapshot": "deleted_folder",
    "@Recently-Snapshot": "deleted_folder",
}  # fmt: skip
"""What folders hold that are beside photographs, but nobody has put there, by their names."""
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts")


class CameraOptions(Options):
    """How images share cameras (COLMAP's camera modes, models and parameters)."""

    mode: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Which images share a camera. ``auto``: as ``cameras_path`` says, else those of one body,
    lens, focal length and size by EXIF; without EXIF each has its own, unless matches show that
    images of one size share one."""
    model: str = "SIMPLE_RADIAL"
    """COLMAP's name of the camera model."""
    params: str = ""
    """Known intrinsics in COLMAP's order, separated by commas; empty if they are not known."""
    default_focal_length_factor: Annotated[float, within(0.01, 100.0)] = 1.2  # COLMAP's
    """Focal length in units of the longer side where EXIF has none."""
    ignore_exif: bool = False
    """Take no focal length from EXIF, and do not ask it which images share a camera."""
    cameras_path: str = ""
    """COLMAP model, or CSV table by image name, with cameras that are known; empty for none."""
    focal_length_px: Annotated[float, within(0.0, 1e7)] = 0.0
    """Focal length of all images that ``cameras_path`` does not name; 0 if it is not known."""
    focal_mm: Annotated[float, within(0.0, 1e5)] = 0.0
    """Focal length of the lens of all images of which nothing else tells one; 0 if it is not
    known. Needs ``film_width_mm``."""
    film_width_mm: Annotated[float, within(0.0, 1e5)] = 0.0
    """Longer side of what these images show of film, plate or sensor."""
    principal_point: str = ""
    """``cx,cy`` in px from the image's corner; empty for the middle."""


class MaskOptions(Options):
    """Where features may be, as COLMAP has it: nowhere that a mask is black."""

    path: str = ""
    """Folder of masks, a/b.jpg has a/b.jpg.png or a/b.png; images without one are used whole."""
    camera_path: str = ""
    """One mask for all images; empty for none."""


@dataclass(frozen=True)
class Photographs:
    """Where the photographs of a run and their masks are."""

    folder: Path  # of the photographs
    masks: MaskOptions = field(default_factory=MaskOptions)  # where features may be

    def check(self) -> None:
        """Refuse masks that are not there at all: OptionError names the option."""
        if self.masks.path and not Path(self.masks.path).is_dir():
            raise OptionError(
                "no such folder", where=Option("mask-path", self.masks.path)
            )
        if self.masks.camera_path and not Path(self.masks.camera_path).is_file():
            raise OptionError(
                "no such file", where=Option("camera-mask-path", self.masks.camera_path)
            )

    def mask(self, name: str) -> Mask | None:
        """Return an image's (H, W) mask, if any; ImageError if it is unreadable or does not fit.

        Where an image has no file of its own for it, its alpha channel is its mask.
        """
        image_path = self.folder / name
        masks = list[Mask]()
        paths = list[Path]()
        own = self.own_mask(name)
        alpha = None if own else alpha_mask(image_path)
        if own:
            paths.append(own)
        if alpha is not None:
            masks.append(alpha)
        if self.masks.camera_path:
            paths.append(Path(self.masks.camera_path))
        size = reading.header_size(image_path)
        for path in paths:
            mask = _mask_of_size(path, size, image_path)
            masks.append(mask)
            size = (mask.shape[1], mask.shape[0])
        return np.logical_and.reduce(masks) if masks else None

    def own_mask(self, name: str) -> Path | None:
        """Return the file of the mask of an image alone, None where it has none."""
        return next((path for path in self._mask_paths(name) if path.is_file()), None)

    def alpha_masks(self, names: Iterable[str]) -> dict[str, Mask]:
        """Return the (H, W) masks of the alpha channels of images, as far as they have some."""
        found: dict[str, Mask] = {}
        for name in names:
            with suppress(ImageError):  # who reads the image will find out
                mask = alpha_mask(self.folder / name)
                if mask is not None:
                    found[name] = mask
        return found

    def without_mask(self, names: Sequence[str]) -> list[str]:
        """Return the images without a mask, if masks are given.

        OptionError when none has one, or the mask of one is itself a photograph of these names.
        """
        self._refuse_photographs(names)
        paths = {name: self._mask_paths(name) for name in names if self.masks.path}
        found = [name for name in paths if not self.own_mask(name)]
        if found and len(found) == len(names):
            raise OptionError(
                f"has no mask of any image, such as {paths[found[0]][0]}",
                where=Option("mask-path", self.masks.path),
            )
        return found

    def _refuse_photographs(self, names: Sequence[str]) -> None:
        """Refuse masks that are photographs, as in the folder of the photographs; OptionError."""
        given = {
            "mask-path": self.masks.path,
            "camera-mask-path": self.masks.camera_path,
        }
        if not any(given.values()):
            return
        photographs = {resolved(self.folder / name) for name in names}
        for option, where in given.items():
            paths = [Path(where)] if where else []
            if option == "mask-path":
                paths = [path for name in names for path in self._mask_paths(name)]
            for path in paths:
                if resolved(path) in photographs:
                    raise OptionError(
                        f"{path.name} is one of the photographs in {self.folder}",
                        where=Option(option, where),
                        advice="give the masks a folder of their own, outside of that",
                    )

    def _mask_paths(self, name: str) -> list[Path]:
        """Return where the mask of an image may be, the first that is there counts."""
        if not self.masks.path:
            return []
        path = Path(self.masks.path) / name
        return [path.with_name(f"{path.name}.png"), path.with_suffix(".png")]

    def files(self, name: str) -> list[Path]:
        """Return the files that the extraction of an image reads, as far as they are there."""
        paths = [self.folder / name, *self._mask_paths(name)]
        if self.masks.camera_path:
            paths.append(Path(self.masks.camera_path))
        return [path for path in paths if reading.may_be_photograph(path)]

    def why_impossible(self, name: str) -> ImageFailure | None:
        """Return which of these files is none, or claims more pixels than photographs have."""
        for path in (self.folder / name, *self.files(name)):
            why = reading.why_unusable(path)
            if why:
                return why
        return None


def _mask_of_size(path: Path, size: tuple[int, int] | None, image_path: Path) -> Mask:
    """Read the mask of an image of (width, height) px; None: of any size.

    Its header is looked at first: a mask of another size is not decoded. Raises ImageError.
    """
    found = reading.header_size(path)
    if size is None:
        return read_mask(path)
    if found is None or found == size:
        mask = read_mask(path)
        found = (mask.shape[1], mask.shape[0])
        if found == size:
            return mask
    raise unusable(
        "mask_of_another_size",
        image_path,
        width=size[0],
        height=size[1],
        mask_width=found[0],
        mask_height=found[1],
        mask=str(path),
    )


def list_images(image_path: Path, image_list_path: Path | None = None) -> list[str]:
    """Return the sorted names, relative to ``image_path``, of all images below it or of a list.

    Hidden files and other formats are passed over (:func:`left_out`). OptionError when there is no
    such folder or list, it holds none, or a listed one is missing.
    """
    require_folder(image_path)
    if image_list_path is not None:
        return _listed_images(image_path, image_list_path)
    files = photograph_files(image_path, IMAGE_SUFFIXES)
    names = [name for name in files if not _odd(name)]
    if not names:
        others = tuple(("; ", warning.line) for warning in left_out(image_path))
        what = (f"holds no images ({', '.join(IMAGE_SUFFIXES)})", others)
        raise OptionError(what, where=image_path)
    return names


def require_folder(image_path: Path) -> None:
    """Refuse what is no folder of photographs; OptionError."""
    if image_path.is_file():
        raise OptionError(
            "is a file", where=image_path, advice="give the folder that it is in"
        )
    if not image_path.is_dir():
        raise OptionError(
            "no such folder",
            where=image_path,
            advice="give the folder of the photographs",
        )


def left_out(image_path: Path) -> list[StageWarning]:
    """Return why photographs in a folder are passed over: for their format, names, or as pages."""
    suffixes = (*IMAGE_SUFFIXES, *OTHER_IMAGE_SUFFIXES, *VIDEOS)
    files, found = _walk(image_path, suffixes)
    names_of_kinds: dict[tuple[WarningCode, str], list[str]] = {}
    for name in sorted(files):
        kind = _kind_left_out(name)
        if kind:
            names_of_kinds.setdefault(kind, []).append(name)
        is_tiff = _suffix(name) in TIFF_SUFFIXES
        num_pages = len(reading.pages(image_path / name)) if is_tiff else 1
        if num_pages > 1:
            found.append(StageWarning("pages", name, {"num_pages": num_pages}))
    for (code, about), names in names_of_kinds.items():
        values: dict[str, int | str] = {
            "num": len(names),
            "example": one_line(names[0]),
        }
        found.append(StageWarning(code, about, values))
    return found


def _kind_left_out(name: str) -> tuple[WarningCode, str] | None:
    """Return why a file is passed over, and what the warning begins with; None if it is not."""
    suffix = _suffix(name)
    if suffix in VIDEOS:
        return "video", f"*{suffix}"
    if suffix not in IMAGE_SUFFIXES:
        return "format_unread", f"*{suffix}"
    odd = _odd(name)
    return (odd, "names") if odd else None


def not_named(image_path: Path, names: Collection[str]) -> list[StageWarning]:
    """Return a warning of the photographs in a folder that a database does not name, if any."""
    files = photograph_files(image_path, IMAGE_SUFFIXES)
    found = [name for name in files if name not in names]
    if not found:
        return []
    values: dict[str, int | str] = {"num": len(found), "example": one_line(found[0])}
    return [StageWarning("not_in_database", str(image_path), values)]


def photograph_files(
    folder: Path, suffixes: Collection[str] = (*IMAGE_SUFFIXES, *OTHER_IMAGE_SUFFIXES)
) -> list[str]:
    """Return the sorted names of all photographs below a folder, without hidden ones and output.

    Folders that are linked count, each folder once.
    """
    return sorted(_walk(folder, suffixes)[0])


def folders_left_out(folder: Path) -> dict[str, str]:
    """Return why folders below that of the photographs are passed over, by what is said of them."""
    return texts_by_subject(_walk(folder, ())[1])


def _walk(
    folder: Path, suffixes: Collection[str]
) -> tuple[list[str], list[StageWarning]]:
    """Return the names of the files below a folder that end so, and why folders are left out."""
    walk = _Walk(folder, suffixes)
    while walk.ahead or walk.linked:
        walk.enter(walk.ahead.popleft() if walk.ahead else walk.linked.popleft())
    warnings = list[StageWarning]()
    for (code, reason), names in walk.left_out.items():
        values: dict[str, int | str] = {"reason": reason} if reason else {}
        warnings.append(StageWarning(code, such_as(map(one_line, names)), values))
    return walk.found, warnings


class _Walk:
    """A search for files below a folder.

    Links are followed after all else, so that a folder that is here and linked has its own name.
    """

    def __init__(self, folder: Path, suffixes: Collection[str]) -> None:
        self.folder = folder
        self.suffixes = suffixes
        self.found: list[str] = []
        # Names of folders, by the code of the warning and the reason that the system gives
        self.left_out: defaultdict[tuple[WarningCode, str], list[str]] = defaultdict(
            list
        )
        self.ahead = deque([folder])
        self.linked = deque[Path]()
        self.seen = {_identity(path) for path in resolved(folder).parents}

    def enter(self, path: Path) -> None:
        """Look through a folder, but not through those in it, if nobody has done that."""
        below = ""
        if path != self.folder:
            below = f"{path.relative_to(self.folder).as_posix()}/"
        try:
            identity = _identity(path)
            entries = sorted(os.scandir(path), key=lambda entry: entry.name)
        except OSError as error:
            self.left_out["folder_unreadable", error.strerror or ""].append(below)
            return
        if identity not in self.seen:
            self.seen.add(identity)
            for entry in entries:
                self._meet(entry, below)
        elif path.is_symlink():
            self.left_out["folder_linked_twice", ""].append(below)

    def _meet(self, entry: os.DirEntry[str], below: str) -> None:
        """Take a file, or put a folder among those to look through."""
        name = entry.name
        if name.startswith("."):
            return
        if not _is_folder(entry):
            if _suffix(name) in self.suffixes:
                self.found.append(below + name)
        elif name in FOLDERS_OF_SYSTEMS:
            self.left_out[FOLDERS_OF_SYSTEMS[name], ""].append(f"{below}{name}/")
        elif not is_output_folder(self.folder / below / name):
            among = self.linked if entry.is_symlink() else self.ahead
            among.append(self.folder / below / name)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Tell whether an entry is a folder; who reads it says what else is wrong with it."""
    try:
        return entry.is_dir()
    except OSError:  # a link that leads in a circle, for one
        return False


def _identity(path: Path) -> tuple[int, int]:
    there = path.stat()
    return there.st_dev, there.st_ino


def _suffix(name: str) -> str:
    return posixpath.splitext(name)[1].lower()


def _odd(name: str) -> OddName | None:
    """Return why lists of images, one a line, cannot hold a name; None if they can."""
    if name.isascii() and name.isprintable():
        return None
    if name != name.encode("utf-8", "replace").decode("utf-8"):
        return "name_not_utf_8"
    if any(unicodedata.category(character) in ("Cc", "Zl", "Zp") for character in name):
        return "control_character"
    return None


def _listed_images(image_path: Path, image_list_path: Path) -> list[str]:
    try:
        lines = read_regular_text(image_list_path, "utf-8-sig").splitlines()
    except OSError as error:
        raise OptionError(
            f"cannot be read ({error.strerror})", where=image_list_path
        ) from error
    except UnicodeDecodeError as error:
        raise not_utf_8(image_list_path) from error
    listed = []
    for line in dict.fromkeys(lines):
        if _is_below(image_path, line):  # a name may begin with a space or #
            listed.append(line)
        elif line.strip() and not line.startswith("#"):
            listed.append(line.strip())
    if not listed:
        raise OptionError("is empty", where=image_list_path)
    return checked_names(image_path, names=listed, where=str(image_list_path))


def checked_names(image_path: Path, names: Iterable[PathLike], where: str) -> list[str]:
    """Check that images are there, and can be named in lists.

    Args:
        image_path: folder of the photographs.
        names: relative to it.
        where: they are from, for errors.

    Returns:
        The sorted names, each once.

    Raises:
        OptionError: one is empty, or not below the folder.
        ImageError: one has a name that lists cannot hold.
    """
    given = list(names)
    if "" in given:
        raise OptionError(
            "an image has no name", where=where, advice="name it as its file is named"
        )
    found = sorted({PurePosixPath(as_path(name)).as_posix() for name in given})
    missing = [name for name in found if not _is_below(image_path, name)]
    for name in found:
        odd = _odd(name)
        if odd:
            raise ImageError(f"{name!r}: {ODD_NAMES[odd]}", where=image_path)
    if missing:
        raise OptionError(
            f"lists {such_as(missing, 1)}, which is not in {image_path}", where=where
        )
    return found


def _is_below(image_path: Path, name: str) -> bool:
    inside = ".." not in PurePosixPath(name).parts and not name.startswith("/")
    try:
        return inside and (image_path / name).is_file()
    except OSError:  # for one, of a name that is too long
        return False


def refuse_colliding_keys(names: Sequence[str]) -> None:
    """Refuse two names that are the same in hloc's pair keys, which turn '/' into '-'."""
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(pair_key(name, ""), name)
        if other != name:
            raise StoreError(
                f"{other} and {name} have the same key in hloc's match files, where '/' "
                "becomes '-'",
                advice="rename one of them",
            )
