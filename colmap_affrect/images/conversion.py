"""Photographs in formats that COLMAP cannot read, as PNG: JPEG 2000, WebP, AVIF, HEIC, pages."""

import io
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from colmap_affrect.errors import ImageError
from colmap_affrect.images.photographs import TIFF_SUFFIXES, photograph_files, require_folder
from colmap_affrect.images.reading import IMAGE_SUFFIXES, foreign_format, pages
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.outputs import new_results

AS_STORED = ("1", "L", "I;16", "RGB")  # Pillow's modes that PNG holds and COLMAP reads


@dataclass
class ConversionReport:
    """What became of the files of a folder, by their names."""

    written: dict[str, list[str]] = field(default_factory=dict)  # files made, by the converted one
    copied: list[str] = field(default_factory=list)  # files that COLMAP can read as they are
    failures: dict[str, str] = field(default_factory=dict)  # why files cannot be read

    def summary(self) -> str:
        """Return one line, and one for each file that failed."""
        made = sum(len(names) for names in self.written.values())
        line = f"{len(self.written)} files converted into {made} PNG, {len(self.copied)} copied"
        return "\n".join([line, *(f"not {n}: {why}" for n, why in self.failures.items())])


def convert_images(
    image_path: Path, output_path: Path, progress: Progress = SILENT
) -> ConversionReport:
    """Make a new folder with the photographs of another one, all in formats that COLMAP reads.

    Pages of a file become a file each, ``scan.tif-page2.png``. EXIF, its orientation too, stays.
    Raises ImageError when there are no photographs, OptionError when their folder is not there, or
    the new one is there already or inside it.
    """
    require_folder(image_path)
    with suppress(ImportError):  # of the extra "heic"
        from pillow_heif import register_heif_opener

        register_heif_opener()
    names, report = photograph_files(image_path), ConversionReport()
    if not names:
        raise ImageError(f"{image_path}: holds no photographs")
    with (
        new_results(output_path, names=names) as (folder,),
        progress.stage("convert", len(names), "images") as advance,
    ):
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                _convert(image_path / name, folder, name, report)
            except ImageError as error:
                report.failures[name] = str(error)
            except OSError as error:
                raise cannot_write(output_path, error) from error
            advance(1)
    return report


def _convert(path: Path, folder: Path, name: str, report: ConversionReport) -> None:
    suffix = path.suffix.lower()
    numbers = pages(path) if suffix in TIFF_SUFFIXES else [0]
    if suffix in IMAGE_SUFFIXES and not foreign_format(path) and numbers == [0]:
        shutil.copy2(path, folder / name)
        report.copied.append(name)
        return
    ends = [f"-page{k}" for k in range(1, len(numbers) + 1)] if len(numbers) > 1 else [""]
    made = [f"{name}{end}.png" for end in ends]  # the suffix stays: a.jp2 may lie beside a.png
    for page, content in zip(made, _as_png(path, numbers), strict=True):
        (folder / page).write_bytes(content)
    report.written[name] = made


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
