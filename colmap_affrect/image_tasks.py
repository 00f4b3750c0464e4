"""Extraction of the images of a run, in threads of this process or on the workers of a cluster.

Workers read the images from shared storage. Where they do not see them, or other files in their
place, the images and masks travel with the tasks.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from colmap_affrect.colmap.database import ImageCamera
from colmap_affrect.errors import ClusterError, ImageError
from colmap_affrect.executor import Executor, Threads, available_cores, available_memory_bytes
from colmap_affrect.extraction import ExtractedImage, ImageExtractor
from colmap_affrect.features.registry import uses_networks
from colmap_affrect.photographs import Photographs

BYTES_PER_PIXEL = 256
"""Memory of the extraction of one image; measured 210 to 230 on 4 to 8 megapixels."""

Outcome = ExtractedImage | ImageError
"""Features of an image, or why it cannot be used."""


@dataclass(frozen=True)
class ImageTask:
    """One image to extract.

    Attributes:
        name: of the image.
        level: of escalation.
        known: its camera, if the database has one.
        sent: content of its files by absolute path; None where they are read.
    """

    name: str
    level: int
    known: Mapping[str, ImageCamera]
    sent: Mapping[Path, bytes] | None

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class ExtractImage:
    """What is done for one image; where it is done the recipe is prepared once."""

    photographs: Photographs
    extractor: ImageExtractor

    def __call__(self, task: ImageTask) -> Outcome:
        """Extract; an image that cannot be used is no reason to stop."""
        photographs = replace(self.photographs, known=task.known)
        try:
            if task.sent is None:
                return photographs.extract(self.extractor, task.name, task.level)
            return self._extract_sent(photographs, task, task.sent)
        except ImageError as error:
            return error

    def _extract_sent(
        self, photographs: Photographs, task: ImageTask, sent: Mapping[Path, bytes]
    ) -> ExtractedImage:
        with TemporaryDirectory() as root:
            for path, content in sent.items():
                here = moved(path, Path(root))
                here.parent.mkdir(parents=True, exist_ok=True)
                here.write_bytes(content)
            try:
                below = photographs.moved(lambda path: moved(path, Path(root)))
                return below.extract(self.extractor, task.name, task.level)
            except ImageError as error:
                raise ImageError(str(error).replace(root, "")) from error


def moved(path: Path, root: Path) -> Path:
    """Return where a file would be if ``root`` were the root of the file system.

    >>> moved(Path("/photos/a.jpg"), Path("/sent")).as_posix()
    '/sent/photos/a.jpg'
    """
    absolute = path.absolute()
    return root / absolute.relative_to(absolute.anchor)


def extract_images(
    photographs: Photographs,
    extractor: ImageExtractor,
    images: Iterable[tuple[str, int]],
    executor: Executor | None = None,
) -> Generator[Outcome, None, None]:
    """Yield the features of images at levels of escalation, in order.

    Args:
        photographs: of the run.
        extractor: prepared here.
        images: names and levels.
        executor: where; by default in threads, as many as there are cores and memory for.

    Raises:
        ClusterError: when the workers do not see the depth maps.
    """
    images = list(images)
    if not images:
        return
    executor = executor or Threads(num_images_at_once(extractor))
    _require_depth_maps(extractor, executor)
    files = photographs.files(images[0][0])
    is_shared = executor.sees(files)
    tasks = (
        ImageTask(
            name,
            level,
            {name: photographs.known[name]} if name in photographs.known else {},
            None if is_shared else _content(photographs.files(name)),
        )
        for name, level in images
    )
    function = ExtractImage(replace(photographs, known={}), extractor)
    yield from executor.map(function, tasks, files if is_shared else ())


def _content(paths: Iterable[Path]) -> dict[Path, bytes]:
    """Read files; of those that cannot be read the extraction will tell."""
    content = {}
    for path in paths:
        with suppress(OSError):
            content[path] = path.read_bytes()
    return content


def _require_depth_maps(extractor: ImageExtractor, executor: Executor) -> None:
    folder = extractor.options.depth.path
    if folder and not executor.sees([Path(folder)]):
        raise ClusterError(
            f"{folder}: the workers of the cluster do not see this folder of depth maps; put it on "
            "storage that all of them share"
        )


def num_images_at_once(extractor: ImageExtractor) -> int:
    """Return how many images are worked on at once in this process.

    They take at most half of the memory there is. With networks two: one is read while the
    networks run on the other.
    """
    if uses_networks(extractor.options):
        return 2
    num_bytes = BYTES_PER_PIXEL * extractor.options.max_image_size_px**2
    return min(available_cores(), max(1, available_memory_bytes() // 2 // num_bytes))
