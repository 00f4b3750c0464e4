"""How the images of a model came in, and the file beside a model that keeps it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import num_long_tracks, seen_points
from colmap_affrect.colmap.verification import inlier_matches
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import Arrival

FILE_NAME = "arrivals.json"
"""Beside cameras.bin: what a COLMAP model cannot hold; other programs ignore it."""

MIN_THREE_VIEW_POINTS = 12
"""So many points tie an image to two others, as the sparse preset asks for."""


@dataclass(frozen=True)
class _Kept:
    """The content of the file, as :class:`MappedModel` has it."""

    bridges: tuple[Bridge, ...]
    taken_out: Mapping[str, str]
    rival_focals_px: Mapping[str, tuple[float, float]]
    loose: tuple[str, ...] = ()


_KEPT = TypeAdapter(_Kept)


def write_arrivals(model: MappedModel, folder: Path) -> None:
    """Keep what :func:`read_arrivals` needs; nothing where COLMAP's model says it all."""
    kept = _Kept(model.bridges, model.taken_out, model.rival_focals_px, model.loose)
    if kept != _Kept((), {}, {}):
        replace_text(folder / FILE_NAME, _KEPT.dump_json(kept, indent=2).decode() + "\n")


def read_arrivals(reconstruction: pycolmap.Reconstruction, folder: Path) -> MappedModel:
    """Return a model that was read, with what was kept beside it.

    Raises:
        StoreError: when the file is damaged.
    """
    path = folder / FILE_NAME
    if not path.exists():
        return MappedModel(reconstruction)
    try:
        kept = _KEPT.validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise StoreError(f"{path}: damaged") from error
    return MappedModel(reconstruction, **vars(kept))


def arrivals(model: MappedModel, task: MappingTask) -> dict[str, Arrival]:
    """Tell for each registered image how it came in."""
    reconstruction = model.reconstruction
    bridged = {
        name: Arrival(
            "bridged",
            bridge.pair[0],
            bridge.num_agreeing,
            bridge.num_ratios,
            bridge.scale_error_frac,
        )
        for bridge in model.bridges
        for name in bridge.names
    }
    guided = _tied_by_guided_matches(reconstruction, task) if task.guided else set()
    names = {i: reconstruction.images[i].name for i in reconstruction.reg_image_ids()}
    return {
        name: bridged.get(name, Arrival("guided" if image_id in guided else "tracks"))
        for image_id, name in sorted(names.items(), key=lambda item: item[1])
    }


def _tied_by_guided_matches(model: pycolmap.Reconstruction, task: MappingTask) -> set[int]:
    """Return the images that too few three-view tracks would tie without guided matches."""
    points = {i: seen_points(model.images[i]) for i in model.reg_image_ids()}
    links: defaultdict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for ids, matches in inlier_matches(task.database_path, 1).items():
        if not points.keys() >= set(ids):
            continue
        both = [points[i][matches[:, side]] for side, i in enumerate(ids)]
        known = (both[0] == both[1]) & (both[0] >= 0)
        guided = set(map(tuple, np.asarray(task.guided.get(ids, ())).tolist()))
        for first, second in matches[known].tolist():
            if (first, second) not in guided:
                links[ids[0], first].append((ids[1], second))
                links[ids[1], second].append((ids[0], first))
    seen = num_long_tracks(model)
    tied = Counter(
        feature[0]
        for feature, others in links.items()
        if len(others) > 1 or len(links[others[0]]) > 1
    )
    return {
        image_id for image_id in points if tied[image_id] < MIN_THREE_VIEW_POINTS <= seen[image_id]
    }
