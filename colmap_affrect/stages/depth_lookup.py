"""Depth maps of the photographs of a workspace, as mapping asks them."""

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.data import Photograph
from colmap_affrect.errors import DepthError, ImageError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Floats, Singles
from colmap_affrect.geometry.conventions import (
    camera_matrix,
    pixel_from_colmap,
    resized_from_original,
)
from colmap_affrect.images.depth import DEPTH_SOURCES, DepthContext
from colmap_affrect.images.reading import read_gray
from colmap_affrect.mappers.base import DepthLookup
from colmap_affrect.stages.context import Context

logger = logging.getLogger(__name__)

NUM_CACHED_MAPS = 8  # one image is asked for each of its pairs


def depth_lookup(context: Context) -> DepthLookup | None:
    """Return where mapping finds depths, NaN without a usable map; None if no maps were given."""
    workspace = context.workspace
    options = context.extraction
    if not options.depth.is_given:
        return None
    device = context.resources.require_device(uses_network=options.depth.uses_network)
    source = DEPTH_SOURCES.make(options.depth, DepthContext(workspace.depth, device))
    folder = Path(context.inputs.image_path)
    cameras = colmap_database.read_cameras(workspace.database)

    @lru_cache(NUM_CACHED_MAPS)
    def photograph_and_map(name: str) -> tuple[tuple[int, int], Singles] | None:
        try:
            gray = read_gray(folder / name)
            size, known = (gray.shape[1], gray.shape[0]), cameras.get(name)
            matrix = colmap_database.camera_matrix(known) if known else camera_matrix(size)
            return size, source.depth(Photograph(gray, name, folder / name, matrix))
        except (DepthError, ImageError) as error:
            logger.debug("%s: no depth: %s", name, error)
            return None

    def depth_at(name: str, points: Floats) -> Array:
        found = photograph_and_map(name)
        if found is None:
            return np.full(len(points), np.nan)
        size, depth = found
        height, width = depth.shape
        resized = resized_from_original(size, (width, height))
        places = project(resized, pixel_from_colmap(np.asarray(points, np.float64)))
        columns, rows = np.rint(places).astype(int).T
        nearest = depth[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        return np.asarray(nearest, np.float64)

    return depth_at
