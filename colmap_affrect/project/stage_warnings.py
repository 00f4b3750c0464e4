"""What went less well than asked for: codes with values, and the one place that says them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from colmap_affrect.errors import Option, Words, with_flags
from colmap_affrect.options import documented

WarningCode = Literal[
    "camera_stands_still",
    "control_character",
    "database_changed",
    "deleted_folder",
    "folder_linked_twice",
    "folder_unreadable",
    "format_unread",
    "inputs_changed",
    "low_contrast",
    "name_not_utf_8",
    "no_mask",
    "no_weights",
    "not_in_database",
    "not_rectified",
    "pages",
    "pairs_not_listed",
    "photograph_gone",
    "several_sizes",
    "stationary_matches",
    "thumbnails",
    "time_over",
    "video",
    "white_masks",
]

OddName = Literal["control_character", "name_not_utf_8"]

ODD_NAMES: dict[OddName, str] = {
    "control_character": (
        "the name has a line break, tab or other control character, which lists of images cannot "
        "hold; rename it"
    ),
    "name_not_utf_8": "the name is not UTF-8; rename it",
}
"""Why lists of images, one a line, cannot hold a name, and what to do."""

SENTENCES: dict[WarningCode, Words] = {
    "camera_stands_still": (
        "nothing moves between most photographs, so that matches tell nothing of depth: the "
        "camera stands still; take photographs from several places, or give masks of what stands "
        "still (",
        Option("mask-path"),
        ") where something turns before it",
    ),
    "control_character": (
        f"{{num}} left out, such as {{example}}: {ODD_NAMES['control_character']}"
    ),
    "database_changed": "has changed; its copy and the models are made anew",
    "deleted_folder": "left out: what was deleted, or was there before",
    "folder_linked_twice": (
        "left out: a link to a folder that is looked through anyway, or holds that of the "
        "photographs"
    ),
    "folder_unreadable": "left out: cannot be read ({reason}); permit reading",
    "format_unread": (
        "{num} left out, such as {example}: COLMAP or OpenCV cannot read this format; "
        "colmap-affrect convert makes PNG"
    ),
    "inputs_changed": "{what}; all that hangs on them is made again",
    "low_contrast": (
        "is low in {num} of {num_images} photographs, such as {example}; it was stretched (",
        Option("set", "stretch_contrast=false"),
        " leaves it as it is)",
    ),
    "name_not_utf_8": (
        f"{{num}} left out, such as {{example}}: {ODD_NAMES['name_not_utf_8']}"
    ),
    "no_mask": "{num} images have none and are used whole, as {example} is",
    "no_weights": (
        "its weights are not here; it may tie {examples}: {how}; then run this again"
    ),
    "not_in_database": (
        "{num} photographs are left out, such as {example}: the database does not name them"
    ),
    "not_rectified": "not rectified: {reason}",
    "pages": (
        "has {num_pages} pages, and only the first is used; colmap-affrect convert makes a file "
        "of each"
    ),
    "pairs_not_listed": (
        "{num} pairs are not listed any more, such as {first} and {second}"
    ),
    "photograph_gone": "is gone since its features were extracted; these are used",
    "several_sizes": (
        "{example}; images that should share a camera have {num_sizes} sizes, and those of each "
        "share one"
    ),
    "stationary_matches": (
        "{num_matches} matches of {num_pairs} pairs never move (a caption, a frame, a watermark, "
        "or the background of something that turns?) and were left out (",
        Option("set", "matching.filter_stationary_matches=false"),
        " keeps them)",
    ),
    "thumbnails": (
        "left out: thumbnails that a NAS or another system keeps, not photographs"
    ),
    "time_over": (
        "it is over; the same again without ",
        Option("max-time"),
        " tries more",
    ),
    "video": (
        "{num} left out, such as {example}: it is a video; take photographs out of it, as: "
        "ffmpeg -i it -vf fps=2 %04d.jpg"
    ),
    "white_masks": (
        "{num} masks are white all over, such as that of {example}, and leave out nothing; black "
        "is where features are not wanted"
    ),
}
"""What to say of each; the names in braces are the values of the warning."""


@documented
@dataclass(frozen=True)
class StageWarning:
    """What went less well than asked for, in one stage."""

    code: WarningCode
    """Kind of the warning."""
    about: str
    """An image, a file, a folder, or what else the warning is about, as a line begins with it."""
    values: dict[str, int | str] = field(default_factory=dict)
    """Numbers and names that belong to it."""

    @property
    def words(self) -> Words:
        """What is said of it, without what it is about."""
        return filled(SENTENCES[self.code], self.values)

    def text(self) -> str:
        """Return it in words, without what it is about, to who gives commands."""
        return with_flags(self.words)

    @property
    def line(self) -> Words:
        """All that is said of it, in one line."""
        return (self.about, ": ", self.words)

    def to_mapping(self) -> dict[str, Any]:
        """Return what ``report.json`` has of it."""
        found = {"code": self.code, "about": self.about, "text": self.text()}
        return {**found, **self.values}


def filled(words: Words, values: Mapping[str, object]) -> Words:
    """Return words with values in the place of their names in braces."""
    if isinstance(words, tuple):
        return tuple(filled(part, values) for part in words)
    return words.format(**values) if isinstance(words, str) else words


def texts_by_subject(
    warnings: Iterable[StageWarning], said: Callable[[Words], str] = with_flags
) -> dict[str, str]:
    """Return warnings in words, by what they are about.

    Args:
        warnings: of one stage, or of several.
        said: what options are called: :func:`with_flags`, or :func:`with_arguments`.

    Returns:
        Texts by image, file, folder, or what else they are about.
    """
    found = dict[str, str]()
    for warning in warnings:
        before = found.get(warning.about)
        text = said(warning.words)
        found[warning.about] = f"{before}; {text}" if before else text
    return found
