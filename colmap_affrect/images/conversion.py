"""Photographs in formats that COLMAP cannot read, as PNG: JPEG 2000, WebP, AVIF, HEIC, pages.

Whatever is copied has been decoded first: what only has the name of a photograph may be anything,
also a link to what nobody should see.
"""

import io
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path, PurePosixPath

from PIL import Image, UnidentifiedImageError

from colmap_affrect.errors import ImageError, OptionError, WorkspaceError
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.images import reading
from colmap_affrect.images.photographs import (
    TIFF_SUFFIXES,
    folders_left_out,
    photograph_files,
    require_folder,
)
from colmap_affrect.images.reading import IMAGE_SUFFIXES, JPEG, PNG, pages
from colmap_affrect.options import Summarized, documented
from colmap_affrect.progress import GivenProgress, Progress
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.image_failures import (
    ImageFailure,
    UnusableImageError,
    texts_of_failures,
    unusable,
)
from colmap_affrect.project.outputs import LONGEST_NAME, fitting_name, new_results
from colmap_affrect.project.paths import PathLike, as_path

AS_STORED = ("1", "L", "I;16", "RGB")  # Pillow's modes that PNG holds and COLMAP reads
OF_PHOTOGRAPHS = (
    "AVIF", "BMP", "GIF", "HEIF", "JPEG", "JPEG2000", "JXL", "PNG", "PPM", "PSD", "TGA", "TIFF",
    "WEBP",
)  # fmt: skip
"""Formats, as Pillow calls them. Of others it knows one is a program, which it has another run."""


@documented
@dataclass
class ConversionReport(Summarized):
    """What became of the files of a folder, by their names."""

    written: dict[str, list[str]] = field(default_factory=dict)
    """Files that were made, by the one that was converted."""
    copied: list[str] = field(default_factory=list)
    """Files that COLMAP can read as they are."""
    renamed: dict[str, str] = field(default_factory=dict)
    """New names, by those that were taken already."""
    failed: dict[str, ImageFailure] = field(default_factory=dict)
    """Why files cannot be read."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Why folders were passed over."""

    @property
    def failures(self) -> dict[str, str]:
        """Why files cannot be read, in words."""
        return texts_of_failures(self.failed)

    def summary(self) -> str:
        """Return one line, and one for each file that failed or has another name than usual."""
        num_made = sum(map(len, self.written.values()))
        lines = [
            f"{len(self.written)} files converted into {num_made} PNG, "
            f"{len(self.copied)} copied",
            *[f"{new}: instead of {old}" for old, new in self.renamed.items()],
            *[f"{name}: {why}" for name, why in self.left_out.items()],
            *[f"not {name}: {why.text()}" for name, why in self.failed.items()],
        ]
        return "\n".join(lines)


def convert_images(
    image_path: PathLike,
    output_path: PathLike,
    progress: GivenProgress = None,
) -> ConversionReport:
    """Make a new folder with the photographs of another one, all in formats that COLMAP reads.

    Pages of a file become a file each, ``scan.tif-page2.png``. EXIF, its orientation too, stays.
    What cannot be decoded is left out, and no file takes the place of another one.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder to be made.
        progress: True, False, or None for where somebody looks at it.

    Returns:
        What became of each file.

    Raises:
        ImageError: none of the photographs can be decoded.
        OptionError: there are none, their folder is not there, or the new one is there
            already or inside it.
        WorkspaceError: the new folder cannot be written.
    """
    image_path = as_path(image_path, "image_path")
    output_path = as_path(output_path, "output_path")
    progress = Progress.given(progress)
    require_folder(image_path)
    with suppress(ImportError):  # of the extra "heic"
        from pillow_heif import register_heif_opener

        register_heif_opener()
    names = photograph_files(image_path)
    if not names:
        raise OptionError("holds no photographs", where=image_path)
    with (
        new_results(output_path, names=names) as (folder,),
        progress.stage("convert", len(names), "images") as advance,
    ):
        folder.mkdir()
        conversion = _Conversion(
            image_path=image_path, folder=folder, output_path=output_path, names=names
        )
        for name in names:
            conversion.add(name)
            advance(1)
        report = conversion.report
        if not (report.written or report.copied):
            raise ImageError(
                f"none of {len(names)} files can be converted; the first: "
                f"{report.failed[names[0]].text()}",
                where=image_path,
            )
    return report


class _Conversion:
    """The photographs of a folder on their way into another one."""

    def __init__(
        self,
        image_path: Path,
        folder: Path,
        output_path: Path,
        names: Sequence[str],
    ) -> None:
        """Take both folders, the name that the new one will have, and the photographs to come."""
        self.image_path = image_path
        self.folder = folder
        self.output_path = output_path
        self.report = ConversionReport(left_out=folders_left_out(image_path))
        self._of_copies = set(names)  # which they keep wherever they can

    def add(self, name: str) -> None:
        """Copy or convert a photograph, or report why it cannot be decoded."""
        path = self.image_path / name
        suffix = path.suffix.lower()
        written: list[str] = []
        try:
            data = reading.read_photograph(path)
            numbers = pages(path) if suffix in TIFF_SUFFIXES else [0]
            is_readable = suffix in IMAGE_SUFFIXES and not reading.foreign_format(data)
            if is_readable and numbers == [0]:
                self._copy(name, data)
                return
            for page, content in enumerate(_as_png(path, data, numbers), start=1):
                # The suffix stays: a.jp2 may lie beside a.png.
                end = f"-page{page}" if len(numbers) > 1 else ""
                written.append(self._write(f"{name}{end}.png", content))
            self.report.written[name] = written
        except UnusableImageError as error:
            for made in written:
                (self.folder / made).unlink()
            self.report.failed[name] = error.failure

    def _copy(self, name: str, data: Bytes) -> None:
        """Copy a photograph with its times; ImageError if it cannot be decoded."""
        path = self.image_path / name
        _require_picture(path, data)
        made = self._write(name, data.tobytes(), is_copy=True)
        with suppress(OSError):  # times are not worth a failure
            there = path.stat()
            os.utime(self.folder / made, ns=(there.st_atime_ns, there.st_mtime_ns))
        self.report.copied.append(made)

    def _write(self, name: str, content: bytes, *, is_copy: bool = False) -> str:
        """Write a file that is not there yet; return its name, another one where that is taken."""
        for new in _possible_names(name):
            if not is_copy and new in self._of_copies:
                continue
            target = self.folder / new
            if not self.folder.is_dir():  # else only what comes now would be there
                raise WorkspaceError(
                    "what was made for it has been removed meanwhile",
                    where=self.output_path,
                    advice="run the same command again",
                )
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as file:
                    file.write(content)
            except FileExistsError:
                # Names may differ in what the file system does not keep.
                continue
            except OSError as error:
                raise cannot_write(self.output_path, error) from error
            if new != name:
                self.report.renamed[name] = new
            return new
        raise AssertionError


def _possible_names(name: str) -> Iterator[str]:
    """Yield the name of a file and others that are like it; as short as file systems want them."""
    path = PurePosixPath(name)
    for number in count(1):
        stem = path.stem if number == 1 else f"{path.stem}-{number}"
        yield path.with_name(
            fitting_name(stem, path.suffix, most=LONGEST_NAME)
        ).as_posix()


def _require_picture(path: Path, data: Bytes) -> None:
    """Refuse what cannot be decoded to its end; ImageError.

    OpenCV fills up what is missing of a JPEG or PNG; Pillow says so.
    """
    reading.require_possible(path)
    reading.decode_bytes(data.copy(), path)
    if not data[:8].tobytes().startswith((JPEG, PNG)):
        return
    try:
        with reading.open_image(io.BytesIO(data.data)) as image:
            image.load()
    except Exception as error:  # damaged files raise nearly anything in Pillow
        raise unusable("damaged", path, reason=str(error)) from error


def _known_formats() -> list[str]:
    """Return which formats of photographs Pillow reads here."""
    Image.init()
    return [name for name in OF_PHOTOGRAPHS if name in Image.OPEN]


def _as_png(path: Path, data: Bytes, numbers: Sequence[int]) -> Iterator[bytes]:
    """Yield pages of a file as PNG; ImageError if it is damaged, or of no format that is known."""
    try:
        # By its name Pillow maps a file into memory, and garbles gray pages that lie on their side.
        with Image.open(io.BytesIO(data.data), formats=_known_formats()) as image:
            for number in numbers:
                image.seek(number)
                if reading.is_too_large(image.size):
                    raise reading.too_many_pixels(path, image.size)
                page = image if image.mode in AS_STORED else image.convert("RGB")
                file = io.BytesIO()
                page.save(file, "PNG", exif=image.getexif())
                yield file.getvalue()
    except ImageError:
        raise
    except UnidentifiedImageError as error:
        raise unusable("not_convertible", path) from error
    except Exception as error:  # damaged files raise nearly anything in Pillow
        raise unusable("unreadable", path, reason=str(error)) from error
