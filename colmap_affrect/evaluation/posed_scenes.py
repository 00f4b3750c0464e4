"""What scenes of images with known poses have in common, however they are laid out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import ClassVar

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import Dataset, EvaluationPair
from colmap_affrect.evaluation.relative_pose import (
    PosedImage,
    RelativePoseProtocol,
    category_start,
    posed_pair,
)
from colmap_affrect.evaluation.truth_checks import counted
from colmap_affrect.images.reading import IMAGE_SUFFIXES

Names = tuple[str, str]
"""Of the images of a pair, without suffix."""


class PosedScenes(RelativePoseProtocol):
    """A protocol whose dataset is a scene or a folder of scenes."""

    scene_pattern: ClassVar[str]
    """Of the file or folder that makes a folder a scene."""
    dataset_title: ClassVar[str]

    def load(self, dataset_path: Path) -> Dataset:
        """Read a scene, or all in a folder; EvaluationError when no pair can be evaluated."""
        folders = [dataset_path, *sorted(dataset_path.glob("*/"))]
        paths = [path for folder in folders for path in sorted(folder.glob(self.scene_pattern))]
        if not paths:
            raise EvaluationError(
                f"{dataset_path}: has no {self.scene_pattern}, nor has a folder in it; give a "
                f"scene of {self.dataset_title}, or the folder of its scenes"
            )
        dataset = Dataset.united(map(self.load_scene, paths))
        if not dataset.pairs:
            notes = "; ".join(dataset.notes)
            raise EvaluationError(f"{dataset_path}: no pair can be evaluated; {notes}")
        return dataset

    @abstractmethod
    def load_scene(self, path: Path) -> Dataset:
        """Read a scene by the path of what makes it one."""


def stem(name: str) -> str:
    """Return a name without its suffix.

    >>> stem("left/a.1.png")
    'left/a.1'
    """
    return PurePosixPath(name).with_suffix("").as_posix()


def scene_images(folder: Path) -> dict[str, Path]:
    """Return all images below a folder by their names without suffix."""
    return {
        stem(path.relative_to(folder).as_posix()): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES
    }


def posed_pairs(
    listed: Iterable[Names], posed: Mapping[str, PosedImage], category: Callable[[Names], str]
) -> list[EvaluationPair]:
    """Return the pairs of images that are there, by category and name, each once."""
    pairs = [
        posed_pair(posed[names[0]], posed[names[1]], category(names))
        for names in listed
        if posed.keys() >= set(names)
    ]
    unique = {pair.name: pair for pair in pairs}.values()
    return sorted(unique, key=lambda pair: (category_start(pair.category), pair.name))


def missing_notes(
    listed: Sequence[Names],
    names: Sequence[str],
    files: Mapping[str, Path],
    lacking: Mapping[str, str],
    what: str,
) -> list[str]:
    """Count listed pairs, and the names of their images, without a file or a truth (``what``).

    ``files`` has the files by name, ``lacking`` the reasons why there is no truth.
    """
    lost = [pair for pair in listed if any(n not in files or n in lacking for n in pair)]
    without_file = [name for name in names if name not in files]
    of = f"of {len(names)} listed images"
    faults = [f"{name} ({why})" for name, why in lacking.items()]
    return [
        *([f"{len(lost)} of {len(listed)} listed pairs are left out"] if lost else []),
        *counted(without_file, f"{of} are not in images/", without_file),
        *counted(faults, f"{of} have no usable {what}", faults),
    ]
