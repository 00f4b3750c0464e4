"""Match: raw matches of the listed pairs, into ``matches.h5`` and the database."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import closing

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.features.weights import digests_by_name, resolve
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import PairMatches, pair_key
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import recorded_extraction, write_images_and_keypoints
from colmap_affrect.stages.one_pair import Matching, iterate_matches
from colmap_affrect.stages.pairs import listed_pairs
from colmap_affrect.stages.stationary import StationaryFilter

logger = logging.getLogger(__name__)

PAIRS_PER_WRITE = 64

SECONDS_PER_WRITE = 30.0
"""Pairs of a network take seconds each: what is found is stored before there are so many."""


WEIGHTS = "weights"
"""Of the record, beside the options: file name to sha256."""


def recorded_matching(workspace: Workspace) -> MatcherOptions:
    """Return the options on record of matching, done or still to be done."""
    record = {k: value for k, value in (workspace.planned("match") or {}).items() if k != WEIGHTS}
    options: MatcherOptions = MATCHERS.options(record)
    return options


def match(
    context: Context, options: MatcherOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Match the listed pairs and put the raw matches into the database.

    ``options`` are by default those on record; ``overwrite`` discards what is there, and later
    stages.
    """
    start = time.perf_counter()
    context.resources.require_device()
    pairs = listed_pairs(context)
    options = options or recorded_matching(context.workspace)
    digests = digests_by_name(resolve(options.weights, context.resources.weights_path))
    record = options.to_mapping() | ({WEIGHTS: digests} if digests else {})
    context.workspace.record_options("match", record, overwrite=overwrite)
    done = context.matches.complete(pair_key(*pair) for pair in pairs)
    missing = [pair for pair in pairs if pair_key(*pair) not in done]
    if missing:
        context.matches.mark_filtered(False)
    with context.progress.stage("match", len(missing), "pairs") as advance:
        match_pairs(context, missing, options, advance)
    warnings = {}
    if options.filter_stationary_matches and not context.matches.is_filtered():
        if line := StationaryFilter(context.features, context.matches).learn(pairs):
            warnings["matches"] = line
            logger.warning("matches: %s", line)
        context.matches.mark_filtered(True)
    write_matches(context, pairs)
    wall_s = time.perf_counter() - start
    return StageReport("match", wall_s, len(missing), len(done), warnings=warnings)


def match_pairs(
    context: Context,
    pairs: Sequence[Pair],
    options: MatcherOptions,
    advance: Callable[[int], None],
) -> None:
    """Match pairs by the features that every image has, and store them batch by batch."""
    extractor = recorded_extraction(context.workspace).features.name
    matching = Matching(context.features, options, extractor=extractor, resources=context.resources)
    matches = context.matches
    stationary = StationaryFilter(context.features, matches)
    batch: list[PairMatches] = []
    written = time.monotonic()
    try:
        with closing(iterate_matches(pairs, matching, context.executor)) as found_pairs:
            for found in found_pairs:
                batch.append(stationary.filtered(found))
                advance(1)
                is_due = time.monotonic() - written > SECONDS_PER_WRITE
                if len(batch) == PAIRS_PER_WRITE or is_due:
                    matches.write(batch)
                    batch, written = [], time.monotonic()
    finally:
        if batch:
            matches.write(batch)


def write_matches(context: Context, pairs: Sequence[Pair]) -> None:
    """Put the raw matches that the database lacks into it, after images and keypoints."""
    write_images_and_keypoints(context)
    path = context.workspace.database
    ids = colmap_database.image_ids(path)
    with colmap_database.open_database(path) as database:
        lacking = [
            pair
            for pair in pairs
            if pair[0] in ids
            and pair[1] in ids
            and not database.exists_matches(ids[pair[0]], ids[pair[1]])
        ]
        if not lacking:
            return
        for (first, second), found in zip(lacking, context.matches.read(lacking), strict=True):
            colmap_database.write_matches(database, ids[first], ids[second], found.indices)
