"""Two runs of the same photographs, one laid over the other: before and after."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import read_names
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import NoModelError, Option, OptionError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.mapping import model_folders, read_summaries
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.map_again import changes, figures
from colmap_affrect.report.observations import registered_images
from colmap_affrect.report.page import TEMPLATES, Page, write_page
from colmap_affrect.report.photographs import Quality, quality_of
from colmap_affrect.report.scene import fit_upright, view_of
from colmap_affrect.report.upright import upright_of_run
from colmap_affrect.report.verdict import QUALITIES, SIGNS

MIN_NUM_COMMON = 2  # photographs that tell rotation, scale and place; theory
MAX_NUM_PAIRS = 20_000  # of photographs that scale is measured with; resource
MIN_DISTANCE = 1e-9  # of two photographs, in units of the model; numeric


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    kind: Quality
    text: str
    groups: tuple[str, ...]


def write_two_runs(
    before_path: Path,
    after_path: Path,
    page_path: Path | None = None,
    progress: Progress = SILENT,
) -> Path:
    """Write a page with the largest models of two runs, one laid over the other.

    Args:
        before_path: output folder of a run, or a folder of its models.
        after_path: output folder of a run of the same photographs.
        page_path: HTML file to make; None: ``compared.html`` in the folder of the second run.
        progress: where to show it.

    Returns:
        The path of the page.

    Raises:
        NoModelError: a run has no model.
        OptionError: a folder is not that of a run, or the file is there and no such page.
    """
    workspace = Workspace(after_path)
    target = page_path or after_path / "compared.html"
    _refuse_others(target)
    sides = [_Side.read(before_path), _Side.read(after_path)]
    before = sides[0]
    after = sides[1]
    upright = upright_of_run(after.folder, after.model)
    fit_upright(after.model, None if upright is None else upright.direction)
    similarity = similarity_of(before.model, after.model)
    note = ""
    if similarity is None:
        note = (
            "The models have too few photographs in common to be laid over each other."
        )
        fit_upright(before.model)
    else:
        before.model.transform(similarity)
    names = sorted({*before.names, *after.names, *_all_names(workspace)})
    views = [
        replace(view_of(after.model), kinds=after.kinds()),
        replace(view_of(before.model), kinds=dict.fromkeys(before.names, "before")),
    ]
    changed = changes(names, before.models, after.models)
    page = Page(
        template=TEMPLATES / "two_runs.html",
        content={
            "titles": (before_path.name, after_path.name),
            "views": views,
            "note": note,
            "figures": figures(before.models, after.models),
            "changes": changed,
            "cards": _cards(names, changed, after.models),
            "signs": SIGNS,
            "qualities": QUALITIES,
        },
        names=names,
        image_path=workspace.photographs(),
        views=views,
    )
    return write_page(target, page, progress)


MARK = "<title>Before and after"
"""How the pages of this module can be told."""


def _refuse_others(path: Path) -> None:
    """Refuse to replace a file that is no such page."""
    if path.is_dir():
        raise OptionError(
            "is a folder", where=path, advice="give the path of an HTML file"
        )
    if path.exists() and MARK not in path.read_text("utf-8", errors="replace"):
        raise OptionError(
            "is there already",
            where=path,
            advice=("give another ", Option("output-path")),
        )


@dataclass(frozen=True)
class _Side:
    """The models of a run."""

    folder: Path  # of the largest model
    model: pycolmap.Reconstruction  # the largest
    models: Sequence[ModelSummary]  # the largest first

    @classmethod
    def read(cls, path: Path) -> "_Side":
        """Read the models of a folder; NoModelError where there is none."""
        sparse = path / "sparse" if (path / "sparse").is_dir() else path
        folders = model_folders(sparse)
        if not folders:
            raise NoModelError(
                "has no model", where=path, advice="give the output folder of a run"
            )
        return cls(folders[0], read_given_model(folders[0]), read_summaries(sparse))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs of all models."""
        found = list[str]()
        for model in self.models:
            found += model.registered_names
        return tuple(found)

    def kinds(self) -> Mapping[str, str]:
        """Return the classes of the photographs of the largest model."""
        largest = self.models[0]
        return {name: quality_of(name, largest) for name in largest.registered_names}


def _all_names(workspace: Workspace) -> Sequence[str]:
    """Return the names of the photographs of the database of a run, if it has one."""
    return read_names(workspace.database) if workspace.database.is_file() else []


def _cards(
    names: Sequence[str],
    changed: Sequence[Sequence[str]],
    models: Sequence[ModelSummary],
) -> list[Card]:
    """Return all photographs with what has become of each."""
    texts = {name: f"was {was}, is {now}" for name, was, now in changed}
    found = []
    for name in names:
        kind: Quality = "missing"
        for model in models:
            if name in model.registered_names:
                kind = quality_of(name, model)
                break
        groups = ["all", kind]
        if name in texts:
            groups.append("changed")
        text = texts.get(name, f"{QUALITIES[kind]}, as before")
        found.append(Card(name, kind, text, tuple(groups)))
    return found


def similarity_of(
    source: pycolmap.Reconstruction, target: pycolmap.Reconstruction
) -> pycolmap.Sim3d | None:
    """Return what lays a model over another one of the same photographs.

    The rotation is that of one photograph which agrees best with the others; scale and place are
    medians, given the rotation. So some photographs may be elsewhere, and all may be in a line.

    Args:
        source: model that is to be moved.
        target: model that stays.

    Returns:
        The similarity; None where fewer than two photographs are in both.
    """
    poses = []
    for model in (source, target):
        of_model = {}
        for image in registered_images(model):
            of_model[image.name] = image.cam_from_world().inverse()
        poses.append(of_model)
    common = sorted(poses[0].keys() & poses[1].keys())
    if len(common) < MIN_NUM_COMMON:
        return None
    axes = [
        np.array([side[name].rotation.matrix() for name in common]) for side in poses
    ]
    centers = [np.array([side[name].translation for name in common]) for side in poses]
    rotation = _median_rotation(np.einsum("mab,mcb->mac", axes[1], axes[0]))
    turned = centers[0] @ rotation.T
    scale = _scale(turned, centers[1])
    if scale is None:
        return None
    place = np.median(centers[1] - scale * turned, axis=0)
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), place)


def _median_rotation(rotations: Array) -> Array:
    """Return that of (M, 3, 3) rotations whose median angle to the others is smallest."""
    flat = rotations.reshape(len(rotations), 9)
    cosines = (flat @ flat.T - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.asarray(rotations[int(np.median(angles, axis=1).argmin())])


def _scale(source: Array, target: Array) -> float | None:
    """Return the median ratio of distances between (M, 3) places; None where all are one."""
    pairs = np.array(list(combinations(range(len(source)), 2)))
    if len(pairs) > MAX_NUM_PAIRS:
        pairs = np.random.default_rng(0).choice(pairs, MAX_NUM_PAIRS, replace=False)
    lengths = []
    for places in (source, target):
        apart = places[pairs[:, 0]] - places[pairs[:, 1]]
        lengths.append(np.linalg.norm(apart, axis=1))
    is_apart = lengths[0] > MIN_DISTANCE
    if not is_apart.any():
        return None
    return float(np.median(lengths[1][is_apart] / lengths[0][is_apart]))
