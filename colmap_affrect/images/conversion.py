"""Photographs in formats that COLMAP cannot read, as PNG: JPEG 2000, WebP, AVIF, HEIC, pages."""

import io
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from PIL import Image, UnidentifiedImageError

from colmap_affrect.errors import ImageError, OptionError
from colmap_affrect.images.headers import pages
from colmap_affrect.images.photographs import TIFF_SUFFIXES, photograph_files, require_folder
from colmap_affrect.images.reading import IMAGE_SUFFIXES, foreign_format
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.outputs import OF_SYSTEMS, publish, temporary_folder

AS_STORED = ("1", "L", "I;16", "RGB")  # Pillow's modes that PNG holds and COLMAP reads


@dataclass
class ConversionReport:
    """What became of the files of a folder."""

    # names of the files that were converted, with those that were made of them
    written: dict[str, list[str]] = field(default_factory=dict)
    # names of the files that COLMAP can read as they are
    copied: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)  # names of the files that had been there before
    # names of the files that cannot be read, with the reason
    failures: dict[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """Return one line, and one for each file that failed."""
        made = sum(len(names) for names in self.written.values())
        line = f"{len(self.written)} files converted into {made} PNG, {len(self.copied)} copied"
        kept = f", {len(self.kept)} already there" if self.kept else ""
        return "\n".join([line + kept, *(f"not {n}: {why}" for n, why in self.failures.items())])


def convert_images(
    image_path: Path, output_path: Path, progress: Progress = SILENT
) -> ConversionReport:
    """Fill a folder with the photographs of another one, all in formats that COLMAP reads.

    Pages of a file become a file each, ``scan.tif-page2.png``. EXIF, its orientation too, stays.
    What is there already is not made again. Raises ImageError when there are no photographs,
    OptionError when their folder is not there, or the new one is inside it.
    """
    require_folder(image_path)
    if output_path.resolve() == image_path.resolve():
        raise OptionError(f"{output_path}: is the folder of the photographs; give another one")
    if output_path.resolve().is_relative_to(image_path.resolve()):
        raise OptionError(f"{output_path}: is inside {image_path}; give a folder beside it")
    with suppress(ImportError):  # of the extra "heic"
        from pillow_heif import register_heif_opener

        register_heif_opener()
    names, report = photograph_files(image_path), ConversionReport()
    if not names:
        raise ImageError(f"{image_path}: holds no photographs")
    _refuse_other_content(output_path, names)
    with (
        temporary_folder(output_path) as temporary,
        progress.stage("convert", len(names), "images") as advance,
    ):
        for name in names:
            try:
                _convert(image_path / name, output_path, name, report, temporary)
            except (ImageError, OptionError) as error:
                report.failures[name] = str(error)
            advance(1)
    return report


def _refuse_other_content(folder: Path, names: Sequence[str]) -> None:
    """Refuse a folder with other things than photographs and what is made of these; OptionError."""
    known = {PurePosixPath(name).parts[0] for name in names} | OF_SYSTEMS
    for path in folder.iterdir() if folder.is_dir() else ():
        is_picture = path.suffix.lower() in IMAGE_SUFFIXES and not path.is_dir()
        if not (is_picture or path.name in known or path.name.startswith(".")):
            raise OptionError(
                f"{folder}: is not empty ({path.name}), and not only photographs are there; give a "
                "new or an empty folder"
            )


def _convert(
    path: Path, folder: Path, name: str, report: ConversionReport, temporary: Path
) -> None:
    suffix = PurePosixPath(name).suffix.lower()
    numbers = pages(path) if suffix in TIFF_SUFFIXES else [0]
    as_it_is = suffix in IMAGE_SUFFIXES and not foreign_format(path) and numbers == [0]
    names = [_page_name(name, k, len(numbers)) for k in range(1, len(numbers) + 1)]
    places = {k: folder / n for k, n in zip(numbers, [name] if as_it_is else names, strict=True)}
    missing = {k: place for k, place in places.items() if place.is_symlink() or not place.exists()}
    if not missing:
        report.kept.append(name)
        return
    made = [(temporary / f"{number}.new", place) for number, place in missing.items()]
    if as_it_is:
        shutil.copy2(path, made[0][0])
    else:
        for (new, _), content in zip(made, _as_png(path, list(missing)), strict=True):
            new.write_bytes(content)
    publish(made, folder)
    if as_it_is:
        report.copied.append(name)
    else:
        report.written[name] = names


def _page_name(name: str, page: int, num_pages: int) -> str:
    """Return what a page is called; the suffix stays, since a.jp2 may lie beside a.png.

    >>> _page_name("box/a.jp2", 1, 1), _page_name("b.tif", 2, 3)
    ('box/a.jp2.png', 'b.tif-page2.png')
    """
    return f"{name}-page{page}.png" if num_pages > 1 else f"{name}.png"


def _as_png(path: Path, numbers: Sequence[int]) -> Iterator[bytes]:
    """Yield pages of a file as PNG; ImageError if it is damaged, or of no format that is known."""
    try:
        # By its name Pillow maps a file into memory, and garbles gray pages that lie on their side.
        with path.open("rb") as opened, Image.open(opened) as image:
            for number in numbers:
                image.seek(number)
                page = image if image.mode in AS_STORED else image.convert("RGB")
                file = io.BytesIO()
                page.save(file, "PNG", exif=image.getexif())
                yield file.getvalue()
    except UnidentifiedImageError as error:
        heic = path.suffix.lower() in (".heic", ".heif")
        hint = "; HEIC needs: pip install pillow-heif" if heic else ""
        raise ImageError(f"{path}: is of a format that cannot be converted{hint}") from error
    except Exception as error:  # damaged files raise nearly anything in Pillow
        raise ImageError(f"{path}: cannot be read ({error})") from error
