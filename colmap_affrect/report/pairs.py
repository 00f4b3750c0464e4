"""Pairs of photographs side by side, with lines between what was matched."""

import shlex
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import cache
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import require_known
from colmap_affrect.colmap.checks import FATAL
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.colmap.verification import lone_ties
from colmap_affrect.data import ColorImage
from colmap_affrect.errors import AffrectError, OptionError, StoreError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Indices, rows_in
from colmap_affrect.geometry.conventions import pixel_from_colmap, resized_from_original
from colmap_affrect.images.reading import read_color, shrink_to
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.outputs import fitting_name, new_results
from colmap_affrect.project.report import ModelSummary, ReconstructionReport
from colmap_affrect.project.tables import as_row
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import inspection as sheets
from colmap_affrect.report.pictures import Picture
from colmap_affrect.session.context import Context
from colmap_affrect.stages.map import agreements

KINDS = dict(zip(("own", "warped", "learned", "guided", "by hand"), sheets.PALETTE, strict=False))
KINDS |= {"inliers": "#56B4E9", "rejected": "#C80000"}
"""Colours of inliers that are of features of the photographs, of a warp of one, of features without
measured shapes, of guided matching alone, of tie points, of another program; of other matches."""
OWN, WARPED, LEARNED, GUIDED, BY_HAND, OTHERS, REJECTED = range(len(KINDS))
COLORS = [tuple(bytes.fromhex(color[1:])) for color in KINDS.values()]
MAX_NUM_LINES = 200  # of inliers, and of other matches
MAX_NUM_SHOWN, MAX_NUM_ALIKE = 12, 3  # pairs in a page, and those that nothing speaks against
SIDE_PX = 450  # of photographs in a page


class KnownPair(NamedTuple):
    """The matches of two photographs."""

    sizes: list[tuple[int, int]]  # (width, height) of the photographs in px
    places: list[Array]  # of all matches: (N, 2) px from the upper left corner, in each photograph
    kinds: Indices  # (N,) numbers of these in ``KINDS``
    text: str  # how many there are, of which level, and what the model says


class PairReader:
    """Reads pairs of a database, with what the stores and the model of a run know."""

    def __init__(self, path: Path, context: Context) -> None:
        workspace, folder = context.workspace, context.workspace.sparse / "0"
        has_stores = "match" in workspace.begun and not workspace.is_changed
        self.path, self.context, self.stores = path, context, context if has_stores else None
        self.model = read_given_model(folder) if folder.exists() else pycolmap.Reconstruction()
        self.shares = agreements(path, self.model)

    def read(self, names: Pair) -> KnownPair:
        """Read a pair; OptionError for photographs that are not there or were never matched."""
        with open_database(self.path) as database:
            images = {image.name: image for image in database.read_all_images()}
            for name in names:
                require_known(name, images)
            ids = [images[name].image_id for name in names]
            cameras = [database.read_camera(images[name].camera_id) for name in names]
            points = [np.asarray(database.read_keypoints(i)[:, :2], np.float64) for i in ids]
            raw = np.asarray(database.read_matches(*ids), np.int64).reshape(-1, 2)
            geometry = database.read_two_view_geometry(*ids)
            is_matched = database.exists_matches(*ids)
        inliers = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        marks = self._tie_points(names, points)
        if not (is_matched or len(inliers) or len(marks[0])):
            raise OptionError(f"{names[0]}, {names[1]}: never matched; give another pair")
        rows = np.concatenate([inliers, raw[~rows_in(raw, inliers)]])
        own = self._kinds(names, rows, [len(part) for part in points])
        kinds = np.where(rows_in(rows, raw) | (own == OTHERS), own, GUIDED)
        kinds[len(inliers) :] = REJECTED
        texts = [f"{len(raw)} raw matches{self._level(names)}", f"{len(inliers)} inliers"]
        if (share := self.shares.get(names, self.shares.get(names[::-1]))) is not None:
            texts.append(f"{share:.0%} of them agree with the model")
        return KnownPair(
            [(camera.width, camera.height) for camera in cameras],
            [np.concatenate([points[k][rows[:, k]], marks[k]]) for k in (0, 1)],
            np.append(kinds, np.full(len(marks[0]), BY_HAND)),
            ", ".join(texts),
        )

    def _kinds(self, names: Pair, rows: Indices, counts: list[int]) -> Indices:
        """Return the (M,) kinds of (M, 2) matches of so many features, if these are ours."""
        kinds, not_known = np.full((2, len(rows)), [[OWN], [OTHERS]])
        for side, name in enumerate(names):
            if not self.stores:
                return not_known
            ids = self.stores.features.read(name).rectification_ids
            if len(ids) != counts[side]:  # of a database that was changed
                return not_known
            of_features = np.where(ids, WARPED, OWN)
            for level, part in self.stores.features.level_ranges(name).items():
                if not self.stores.extraction.levels[level].features.has_shapes:
                    of_features[part.start : part.stop] = LEARNED
            kinds = np.maximum(kinds, of_features[rows[:, side]])
        return kinds

    def _level(self, names: Pair) -> str:
        if not self.stores:
            return ""
        with suppress(StoreError):  # the run has not matched these, another program has
            level = self.stores.matches.levels([pair := (min(names), max(names))])[pair]
            return f" of level {level} ({self.stores.extraction.levels[level].name})"
        return ""

    def _tie_points(self, names: Pair, points: Sequence[Array]) -> list[Array]:
        """Return the tie points of the model: its keypoints behind those of the database."""
        images = [self.model.find_image_with_name(name) for name in names]
        behind = [i.points2D[len(p) :] if i else () for i, p in zip(images, points, strict=True)]
        first, second = ({p.point3D_id: p.xy for p in part if p.has_point3D()} for part in behind)
        common = [point for point in first if point in second]
        return [np.array([marks[p] for p in common]).reshape(-1, 2) for marks in (first, second)]


def draw_matches(pair: KnownPair, photographs: Sequence[ColorImage]) -> ColorImage:
    """Draw lines between two photographs, which may be shrunk, in the colours of :data:`KINDS`."""
    panels = [sheets.panel_of(photograph, 2) for photograph in photographs]
    whole, ends = sheets.row_of([(panel, "") for panel in panels], 2)[sheets.TITLE_PX :], []
    for side, panel in enumerate(panels):
        smaller = resized_from_original(pair.sizes[side], (panel.shape[1], panel.shape[0]))
        places = project(smaller, pixel_from_colmap(pair.places[side]))
        places[:, 0] += side * sheets.WIDTH_PX // 2
        ends.append(np.rint(places).astype(int).tolist())
    for part in (pair.kinds == REJECTED, pair.kinds != REJECTED):
        rows = np.flatnonzero(part)
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), MAX_NUM_LINES)).astype(int)
        for row in rows[chosen].tolist():
            color = COLORS[pair.kinds[row]]
            cv2.line(whole, ends[0][row], ends[1][row], color, 1, cv2.LINE_AA)
            for end in ends:
                cv2.circle(whole, end[row], 3, color, -1, cv2.LINE_AA)
    return whole


def draw_pair(
    path: Path, names: Pair, image_path: Path | None = None, picture_path: Path | None = None
) -> str:
    """Draw a pair of a run's folder, or of any database, as PNG; return what is known of it.

    By default as ``pairs/a--b.png`` in the folder of the run, where an older one gives way.
    OptionError for what is not there, was never matched, or has to be given.
    """
    is_run = path.is_dir()
    workspace = Workspace(path) if is_run else Workspace.beside(path)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        copy_database(workspace.database, copy, FATAL)
        with workspace.locked_if_possible() if is_run else nullcontext():
            pair = PairReader(copy, Context(workspace)).read(names)
    if not (image_path := image_path or workspace.photographs()):
        raise OptionError("--image-path: give the folder of the photographs")
    stem = "--".join(name.replace("/", "-").rpartition(".")[0] for name in names)
    usual = path / "pairs" / fitting_name(stem, ".png") if is_run else Path()
    target = picture_path or usual
    if target.suffix != ".png":
        raise OptionError("--output-path: give the name of a new file that ends in .png")
    text = f"{names[0]} and {names[1]}: {pair.text}"
    drawn = draw_matches(pair, [read_color(image_path / name, SIDE_PX * 2) for name in names])
    counts = zip(KINDS, COLORS, np.bincount(pair.kinds, minlength=len(KINDS)), strict=True)
    bars = [(np.full((4, 150, 3), c, np.uint8), f"{kind}: {n}") for kind, c, n in counts if n]
    legend = sheets.row_of(bars or [(drawn[:0], "no matches")], len(KINDS))
    rows = [legend, sheets.row_of([(drawn, text)], 1)]
    _, data = cv2.imencode(".png", np.concatenate(rows)[:, :, ::-1])
    with new_results(target, names=names, replaces=not picture_path) as (new,):
        replace_bytes(new, data.tobytes())
    return f"{text}\n{target}"


def pairs_of_page(
    context: Context, report: ReconstructionReport, verified: Mapping[Pair, int]
) -> list[dict[str, Any]]:
    """Draw the pairs of a run that a person should see; none where photographs are not known.

    ``verified`` has the inliers of pairs that may be used. Each has ``names``, ``why`` it is shown,
    the ``text`` that is known of it, the ``option`` that leaves it out, and a ``picture``.
    """
    if not (folder := context.workspace.photographs()):
        return []
    reader, found = PairReader(context.workspace.database, context), []
    photograph = cache(lambda name: read_color(folder / name, SIDE_PX))
    for names, why in _chosen(reader, report, verified).items():
        with suppress(AffrectError):  # unreadable, or rejected by hand and never matched
            pair, option = reader.read(names), shlex.join(["--reject-pair", as_row(names)])
            drawn = draw_matches(pair, [photograph(name) for name in names])
            one = {"names": names, "why": why, "text": pair.text, "option": option}
            found.append({**one, "picture": Picture.of(shrink_to(drawn, 2 * SIDE_PX))})
    return found


def _chosen(
    reader: PairReader, report: ReconstructionReport, verified: Mapping[Pair, int]
) -> dict[Pair, str]:
    """Return at most ``MAX_NUM_SHOWN`` pairs, some of each sort, and why they are worth a look."""
    model = report.models[0] if report.models else ModelSummary((), 0, 0.0, 0.0)
    context, shares, best = reader.context, reader.shares, dict[str, Pair]()
    inside = set(model.registered_names)
    for pair in sorted(verified, key=lambda pair: -verified[pair]):
        for name, other in (pair, pair[::-1]):
            if other in inside or not inside:
                best.setdefault(name, pair)
    alone = lone_ties(pair for pair in shares if shares[pair] >= 0.5)
    held = sorted(inside & best.keys(), key=lambda name: verified[best[name]])
    guided = sorted(context.guided.read(), key=lambda pair: len(pair.exact) - pair.num_inliers)
    sorts: list[list[tuple[Any, str]]] = [
        [(pair, "most inliers disagree with the model") for pair in shares if shares[pair] < 0.5],
        [(pair, "it alone ties two parts of the model") for pair in alone],
        [(pair, "rejected by hand") for pair in context.by_hand.rejected],
        [((name, x.by), f"{name} came in by this pair") for name, x in model.bridges.items()],
        [(pair, "one view: of one negative, or from one place") for pair in model.one_view],
        [(best.get(name), f"{name} is doubtful") for name in model.doubtful],
        [(best.get(name), f"{name} is missing") for name in report.unregistered],
        [(best[name], f"the strongest pair of {name}") for name in held[:MAX_NUM_ALIKE]],
        [(one.names, "guided") for one in guided[:MAX_NUM_ALIKE] if one.num_inliers],
    ]
    why = defaultdict[Pair, list[str]](list)
    for row in zip_longest(*sorts, fillvalue=(None, "")):
        for (first, second), text in (found for found in row if found[0]):
            pair = min(first, second), max(first, second)
            if pair in why or len(why) < MAX_NUM_SHOWN:
                why[pair].append(text)
    return {pair: "; ".join(texts) for pair, texts in why.items()}
