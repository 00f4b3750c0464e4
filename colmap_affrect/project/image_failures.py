"""Why a photograph cannot be used: codes with values, and the one place that says them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from colmap_affrect.errors import (
    MEMORY_ADVICE,
    AffrectError,
    ImageError,
    Words,
    with_arguments,
    with_flags,
)
from colmap_affrect.options import documented

FailureCode = Literal[
    "camera_of_another_size",
    "damaged",
    "foreign_format",
    "limit_of_opencv",
    "longer_than_its_pixels",
    "mask_of_another_size",
    "no_file",
    "no_image",
    "no_memory",
    "not_convertible",
    "refused_by_colmap",
    "too_long",
    "too_many_pixels",
    "unread_by_colmap",
    "unreadable",
]

NO_IMAGE = "not a readable image (damaged, empty, or of an unknown format)"

SENTENCES: dict[FailureCode, str] = {
    "camera_of_another_size": (
        "is {width} x {height} px, and its camera in the database {camera_width} x "
        "{camera_height} px"
    ),
    "damaged": "is damaged ({reason})",
    "foreign_format": "is of the format {format}, which COLMAP cannot read",
    "limit_of_opencv": (
        "is larger than OpenCV may read here, by {settings} of the environment"
    ),
    "longer_than_its_pixels": (
        "is {gigabytes:.1f} GB long, which its {megapixels:.1f} megapixels do not need"
    ),
    "mask_of_another_size": (
        "is {width} x {height} px and its mask {mask_width} x {mask_height} px ({mask})"
    ),
    "no_file": "{reason}",
    "no_image": NO_IMAGE,
    "no_memory": "not enough memory",
    "not_convertible": "is of a format that cannot be converted",
    "refused_by_colmap": (
        "COLMAP cannot read it, or does not take it (camera mode {camera_mode})"
    ),
    "too_long": (
        "is {gigabytes:.0f} GB long, and {most_gigabytes:.0f} are the most that are read"
    ),
    "too_many_pixels": (
        "claims to be {width} x {height} px, and {most_megapixels} megapixels are the most "
        "that are read"
    ),
    "unread_by_colmap": "COLMAP cannot read it or its mask",
    "unreadable": "cannot be read ({reason})",
}
"""What to say of each; the names in braces are the values of the failure."""

ADVICE: dict[FailureCode, Words] = {
    "camera_of_another_size": "give the images that the database is of",
    "foreign_format": "convert it to PNG or JPEG (colmap-affrect convert)",
    "limit_of_opencv": "unset it",
    "longer_than_its_pixels": (
        "it is damaged, or something else hangs on it: save it again"
    ),
    "mask_of_another_size": "they must have one size",
    "no_memory": MEMORY_ADVICE,
    "too_long": "shrink it",
    "too_many_pixels": "shrink it",
}
"""What to do, where that is not plain."""
HEIC_ADVICE = "HEIC needs: pip install pillow-heif"
HEIC_SUFFIXES = (".heic", ".heif")


@documented
@dataclass(frozen=True)
class ImageFailure:
    """Why a photograph cannot be used."""

    code: FailureCode
    """Kind of the reason."""
    path: str = ""
    """The file that is meant: the photograph, its mask; empty where its name says it."""
    values: dict[str, int | float | str] = field(default_factory=dict)
    """Numbers and names that belong to it."""

    def what(self) -> str:
        """Return what is wrong, in words."""
        return SENTENCES[self.code].format(**self.values)

    def advice(self) -> Words:
        """Return what to do, empty where that is plain."""
        is_heic = Path(self.path).suffix.lower() in HEIC_SUFFIXES
        if self.code == "not_convertible" and is_heic:
            return HEIC_ADVICE
        return ADVICE.get(self.code, "")

    @property
    def words(self) -> Words:
        """All that is said of it."""
        return UnusableImageError(self).words

    def text(self) -> str:
        """Return all of it in one line, to who gives commands."""
        return with_flags(self.words)

    def to_mapping(self) -> dict[str, Any]:
        """Return what ``report.json`` has of it."""
        return {"code": self.code, "text": self.text(), **self.values}


class UnusableImageError(ImageError):
    """One photograph cannot be used."""

    def __init__(self, failure: ImageFailure) -> None:
        """Take the reason, which says the error."""
        super().__init__(failure.what(), where=failure.path, advice=failure.advice())
        self.failure = failure

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.failure,)


def failure_of(error: AffrectError) -> ImageFailure:
    """Return why a photograph cannot be used, by the error that came of it."""
    if isinstance(error, UnusableImageError):
        return error.failure
    where = error.where if isinstance(error.where, str | Path) else ""
    return ImageFailure(
        "unreadable", str(where), values={"reason": with_flags(error.what)}
    )


def texts_of_failures(
    failed: Mapping[str, ImageFailure], said: Callable[[Words], str] = with_arguments
) -> dict[str, str]:
    """Return why photographs cannot be used, in words, by their names.

    Args:
        failed: why, by name.
        said: what options are called: :func:`with_arguments`, or :func:`with_flags`.
    """
    return {name: said(why.words) for name, why in failed.items()}


def failures_to_mapping(failed: Mapping[str, ImageFailure]) -> dict[str, Any]:
    """Return what files for programs have of photographs that cannot be used."""
    return {name: why.to_mapping() for name, why in failed.items()}


def unusable(
    code: FailureCode, path: Path, **values: float | str
) -> UnusableImageError:
    """Return the error of a photograph that cannot be used.

    Args:
        code: of the reason.
        path: of the file that is meant.
        values: that belong to the reason.
    """
    return UnusableImageError(ImageFailure(code, str(path), values))
