"""Match: raw matches of the listed pairs, into ``matches.h5`` and the database."""

import logging
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TypeVar

import numpy as np

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.errors import OptionError
from colmap_affrect.features.weights import digests, resolve
from colmap_affrect.matchers.base import MATCHERS, MatcherContext, MatcherOptions
from colmap_affrect.pairs.base import Pair, PairList
from colmap_affrect.project.contents import file_sha256
from colmap_affrect.project.record import WEIGHTS
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import FINISHED, PairMatches
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import write_images_and_keypoints
from colmap_affrect.stages.one_pair import Matching, iterate_matches
from colmap_affrect.stages.pairs import listed_pairs
from colmap_affrect.stages.stationary import StationaryFilter

logger = logging.getLogger(__name__)

PAIRS_PER_WRITE = 64
SECONDS_PER_WRITE = 30.0  # pairs of a network take seconds each

Found = TypeVar("Found")


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
    options = options or context.matching
    workspace, extraction = context.workspace, context.extraction
    try:
        matchers = extraction.matchers(options)
    except OptionError as error:
        other = "other features than those here take 'run' with another --output-path"
        raise OptionError(f"{error}; {other}") from error
    weights = load_matchers(context, matchers)
    record = options.to_mapping() | ({WEIGHTS: digests(weights)} if weights else {})
    workspace.record_options("match", record, overwrite=overwrite)
    matches, digest = context.matches, file_sha256(workspace.pairs)
    finished = matches.note(FINISHED)
    is_finished = finished == digest and matches.num_pairs() == len(pairs)
    missing = pairs.at(slice(0) if is_finished else ~matches.has(pairs))
    if missing:
        matches.keep_note(FINISHED, None)
    with context.progress.stage("match", len(missing), "pairs") as advance:
        match_pairs(context, missing, options, advance)
    warnings = {}
    if pairs and (missing or finished is None):
        is_asked = options.filter_stationary_matches
        if is_asked and (line := StationaryFilter(context.features, matches).learn(pairs)):
            warnings["matches"] = line
            logger.warning("matches: %s", line)
    if finished != digest:
        matches.keep_note(FINISHED, digest)
    write_matches(context, pairs)
    wall_s = time.perf_counter() - start
    return StageReport("match", wall_s, len(missing), len(pairs) - len(missing), warnings=warnings)


def load_matchers(context: Context, matchers: Iterable[MatcherOptions]) -> dict[str, Path]:
    """Return the files of weights that matchers read, by key.

    Their networks are built once before matching begins: AffrectError for what cannot be used.
    """
    resources, learned = context.resources, {m for m in matchers if m.weights}
    keys = sorted({key for options in learned for key in options.weights})
    weights = resolve(keys, resources.weights_path)
    if "match" not in context.workspace.begun:
        for options in learned:
            MATCHERS.make(options, MatcherContext(weights, "cpu"))
    return weights


def match_pairs(
    context: Context, pairs: Sequence[Pair], options: MatcherOptions, advance: Callable[[int], None]
) -> None:
    """Match pairs by the features that every image has, and store them batch by batch."""
    with closing(matched_at_level(context, pairs, options, 0)) as found_pairs:
        write_batches(found_pairs, context.matches.write, advance)


def write_batches(
    found: Iterable[Found], write: Callable[[list[Found]], None], advance: Callable[[int], None]
) -> None:
    """Write what is found of pairs batch by batch, also the last one when the search is stopped."""
    batch, written = list[Found](), time.monotonic()
    try:
        for item in found:
            batch.append(item)
            advance(1)
            is_due = time.monotonic() - written > SECONDS_PER_WRITE
            if len(batch) == PAIRS_PER_WRITE or is_due:
                write(batch)
                batch, written = [], time.monotonic()
    finally:
        if batch:
            write(batch)


def matched_at_level(
    context: Context, pairs: Sequence[Pair], options: MatcherOptions, level: int
) -> Generator[PairMatches, None, None]:
    """Match pairs by the features of a level, and leave out what never moves.

    ``options`` count where the level has none of its own.
    """
    features, chosen = context.features, context.extraction.levels[level]
    options, extractor = chosen.matching or options, chosen.features.kind
    matching = Matching(features, options, level, chosen.base, extractor, context.resources)
    stationary = StationaryFilter(features, context.matches)
    with closing(iterate_matches(pairs, matching, context.executor)) as found_pairs:
        for found in found_pairs:
            yield stationary.filtered(found)


def write_matches(context: Context, pairs: Sequence[Pair]) -> None:
    """Put the raw matches that the database lacks into it, after images and keypoints."""
    write_images_and_keypoints(context)
    path, listed = context.workspace.database, PairList.of(pairs)
    ids = colmap_database.image_ids(path)
    known_ids = np.array([ids.get(name, 0) for name in listed.names], np.int64)
    with colmap_database.open_database(path) as database:
        lacking = listed.at(colmap_database.lack_matches(database, known_ids[listed.numbers]))
        if not lacking:
            return
        for (first, second), found in zip(lacking, context.matches.read(lacking), strict=True):
            colmap_database.write_matches(database, ids[first], ids[second], found.indices)
