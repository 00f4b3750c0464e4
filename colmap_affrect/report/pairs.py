"""Pictures of pairs: photographs side by side, with lines between what was matched."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from colmap_affrect.colmap.checks import FATAL
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.data import ColorImage
from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.geometry.conventions import pixel_from_colmap, resized_from_original
from colmap_affrect.images.reading import read_color, shrink_to
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.outputs import fitting_name, new_results
from colmap_affrect.project.report import ReconstructionReport
from colmap_affrect.project.tables import as_row
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.pair_choice import pairs_to_check
from colmap_affrect.report.pair_matches import MatchedPair, MatchKind, PairReader
from colmap_affrect.report.pictures import Picture
from colmap_affrect.report.sheets import (
    PALETTE,
    TITLE_PX,
    WIDTH_PX,
    Panel,
    encode_png,
    rgb,
    row_of,
    text_row,
)
from colmap_affrect.session.context import Context
from colmap_affrect.session.view_graph import ViewGraph

COLORS: Mapping[int, str] = {
    MatchKind.OWN: PALETTE[0],
    MatchKind.WARPED: PALETTE[1],
    MatchKind.LEARNED: PALETTE[2],
    MatchKind.GUIDED: PALETTE[3],
    MatchKind.BY_HAND: PALETTE[4],
    MatchKind.FOREIGN: "#56B4E9",
    MatchKind.REJECTED: "#C80000",
}
"""Colours of lines."""
LABELS: Mapping[int, str] = {
    MatchKind.OWN: "as photographed",
    MatchKind.WARPED: "in a warp",
    MatchKind.LEARNED: "learned matching",
    MatchKind.GUIDED: "guided matching",
    MatchKind.BY_HAND: "by hand",
    MatchKind.FOREIGN: "another program",
    MatchKind.REJECTED: "rejected",
}
"""What legends call the kinds of matches."""
LEGEND = {LABELS[kind]: COLORS[kind] for kind in MatchKind}

# Sizes and numbers were chosen by eye.
MAX_NUM_LINES = 200  # of inliers, and as many of rejected matches
SIDE_PX = 380  # longer side of photographs in a page
SHEET_SIDE_PX = 900  # of photographs in a picture of its own
POINT_RADIUS_PX = 3  # of a disk at the end of a line
LEGEND_BAR_PX = (150, 4)  # (width, height) of the bar of a colour


@dataclass(frozen=True)
class PairPicture:
    """A pair of a page."""

    names: Pair
    why: str  # it is shown
    text: str  # what is known of its matches
    option: str  # for a command that leaves it out; none where the model speaks for the pair
    picture: Picture


def draw_matches(pair: MatchedPair, photographs: Sequence[ColorImage]) -> ColorImage:
    """Draw the matches of a pair as lines between the photographs.

    Args:
        pair: matches in px of the original photographs.
        photographs: two (H, W, 3) images, which may have been shrunk.

    Returns:
        An (H, W, 3) picture as wide as a sheet.
    """
    panels = [Panel.fit(photograph, 2) for photograph in photographs]
    picture = row_of(panels, 2)[TITLE_PX:]
    ends = []
    for side, panel in enumerate(panels):
        height, width = panel.image.shape[:2]
        panel_from_original = resized_from_original(pair.sizes[side], (width, height))
        points = project(panel_from_original, pixel_from_colmap(pair.points[side]))
        points[:, 0] += side * WIDTH_PX // 2
        ends.append(np.rint(points).astype(int).tolist())
    is_rejected = pair.kinds == MatchKind.REJECTED
    # The last ones, which are inliers, are on top
    for rows in (np.flatnonzero(is_rejected), np.flatnonzero(~is_rejected)):
        spread = np.linspace(0, len(rows) - 1, min(len(rows), MAX_NUM_LINES)).astype(
            int
        )
        for row in rows[spread].tolist():
            color = rgb(COLORS[pair.kinds[row]])
            cv2.line(picture, ends[0][row], ends[1][row], color, 1, cv2.LINE_AA)
            for points in ends:
                cv2.circle(
                    picture, points[row], POINT_RADIUS_PX, color, -1, cv2.LINE_AA
                )
    return picture


def draw_pair(
    path: Path,
    names: Pair,
    image_path: Path | None = None,
    picture_path: Path | None = None,
) -> str:
    """Draw a pair of a run, or of any database, as PNG.

    Args:
        path: folder of a run, or a database.
        names: of the two photographs.
        image_path: folder of the photographs; by default that of the run.
        picture_path: a new file; by default ``pairs/a--b.png`` in the folder of the run, where it
            replaces an older one.

    Returns:
        What is known of the pair, and the path of the picture, a line each.

    Raises:
        OptionError: a photograph is not there, the pair was never matched, or a path has to be
            given.
    """
    is_run = path.is_dir()
    workspace = Workspace(path) if is_run else Workspace.beside(path)
    with TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        copy_database(workspace.database, database, FATAL)
        with workspace.locked_if_possible() if is_run else nullcontext():
            pair = PairReader(ViewGraph(database), Context(workspace)).read(names)
    image_path = image_path or workspace.photographs()
    if not image_path:
        raise OptionError(
            "give the folder of the photographs", where=Option("image-path")
        )
    stems = [name.replace("/", "-").rpartition(".")[0] for name in names]
    target = picture_path or path / "pairs" / fitting_name("--".join(stems), ".png")
    if target.suffix != ".png" or not (is_run or picture_path):
        raise OptionError(
            "give the name of a new file that ends in .png", where=Option("output-path")
        )
    text = f"{names[0]} and {names[1]}: {pair.text}"
    photographs = [
        read_color(image_path / name, SHEET_SIDE_PX, is_shown=True) for name in names
    ]
    picture = draw_matches(pair, photographs)
    rows = [_legend(pair.kinds), row_of([Panel(picture, text)], 1)]
    with new_results(target, names=names, replaces=not picture_path) as (new,):
        replace_bytes(new, encode_png(rows))
    return f"{text}\n{target}"


def _legend(kinds: Indices) -> ColorImage:
    """Return a row with a bar for each kind among the (N,) kinds, and how often it is there."""
    bars = []
    for kind, count in enumerate(np.bincount(kinds)):
        if count:
            bar = np.full((*LEGEND_BAR_PX[::-1], 3), rgb(COLORS[kind]), np.uint8)
            bars.append(Panel(bar, f"{LABELS[kind]}: {count}"))
    return row_of(bars, len(MatchKind)) if bars else text_row("no matches")


def draw_pairs_to_check(
    context: Context,
    reader: PairReader,
    report: ReconstructionReport,
    num_inliers: Mapping[Pair, int],
) -> list[PairPicture]:
    """Draw the pairs of a run that a person should look at.

    Args:
        context: of the run.
        reader: of its pairs.
        report: of the run.
        num_inliers: of the verified pairs that may be used.

    Returns:
        A picture of each pair; none where the folder of the photographs is not known.
    """
    image_path = context.workspace.photographs()
    if not image_path:
        return []
    chosen = pairs_to_check(
        report,
        num_inliers,
        reader.agreement,
        context.by_hand.rejected,
        context.guided.read(),
    )
    photograph = cache(
        lambda name: read_color(image_path / name, SIDE_PX, is_shown=True)
    )
    pictures = []
    for names, why in chosen.items():
        # Unreadable, or rejected by hand and never matched
        with suppress(AffrectError):
            pair = reader.read(names)
            drawn = draw_matches(pair, [photograph(name) for name in names])
            picture = Picture.from_image(shrink_to(drawn, 2 * SIDE_PX))
            option = ""
            if not pair.is_backed:
                option = shlex.join(["--reject-pair", as_row(names)])
            pictures.append(PairPicture(names, why, pair.text, option, picture))
    return pictures
