"""Pairs: which photographs are matched, into ``pairs.txt``."""

import logging
import math
import time
from collections.abc import Collection, Sequence
from itertools import combinations
from pathlib import Path

from colmap_affrect.colmap.database import nearest_positions
from colmap_affrect.errors import AffrectError, Logged, Option, such_as
from colmap_affrect.pairs import lists
from colmap_affrect.pairs.lists import Pair, PairOptions
from colmap_affrect.pairs.retrieval import retrieved_pairs
from colmap_affrect.project.record import content_of, file_sha256
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.session.context import Context
from colmap_affrect.session.database_export import write_images_and_keypoints

logger = logging.getLogger(__name__)

MANY_IMAGES = 300  # resource
FEWER_PAIRS = (
    Option("pairs", "retrieval"),
    " matches the promising ones only (see ",
    Option("num-neighbors"),
    ")",
)


def choose_pairs(
    context: Context, options: PairOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Write the list of the pairs to match: by default every pair of images.

    Args:
        context: of the workspace, whose photographs have features.
        options: which pairs; None: those on record. When images are added, pairs stay that were
            chosen before.
        overwrite: discard the list that is there, and what was made of it.

    Returns:
        How many pairs are listed.

    Raises:
        AffrectError: the list that is given cannot be used.
        DatabaseError: there are no positions to choose by.
        StoreError: earlier pairs are missing in the list, or other options made them.
    """
    start = time.perf_counter()
    workspace = context.workspace
    options = options or context.pairing
    workspace.require("extract")
    listed = options.match_list_path
    if "exhaustive" in options.methods and not listed:
        num_pairs = _list_all_pairs(context, options, overwrite=overwrite)
        return StageReport(
            name="pairs", wall_s=time.perf_counter() - start, num_done=num_pairs
        )
    pairs = _given_pairs(context, options)
    workspace.record_options("pairs", options=options.to_mapping(), overwrite=overwrite)
    there = kept = _pairs_there(context)
    digest = content_of([Path(listed)]).digest if listed else ""
    if workspace.input_digest("pairs") not in ("", digest):
        kept = set()
    pairs |= kept | _similar_pairs(context, options, there=kept)
    warned = _forget_lost(context, there - pairs)
    if pairs != there or not _is_matched_list(context):
        lists.write_pairs(workspace.pairs, sorted(pairs))
    workspace.record_input_digests(pairs=digest)
    return StageReport(
        name="pairs",
        wall_s=time.perf_counter() - start,
        num_done=len(pairs),
        warned=warned,
    )


def _is_matched_list(context: Context) -> bool:
    """Return whether all pairs of the list were matched, and nobody has written it anew since."""
    return context.matches.state.listed == file_sha256(context.workspace.pairs)


def _list_all_pairs(context: Context, options: PairOptions, *, overwrite: bool) -> int:
    """Write a list of all pairs of images, and return how many they are."""
    workspace = context.workspace
    names = context.features.names()
    num_pairs = math.comb(len(names), 2)
    # 45,000 pairs are too many to wait for; of mapping it says nothing
    if len(names) > MANY_IMAGES:
        logger.warning(
            "all pairs of %d images are %d; %s",
            len(names),
            num_pairs,
            Logged(FEWER_PAIRS),
        )
    workspace.record_options("pairs", options=options.to_mapping(), overwrite=overwrite)
    lists.write_pairs(
        workspace.pairs,
        pairs=combinations(names, 2),  # too many to keep in memory
        names=names,
    )
    workspace.record_input_digests(pairs="")
    return num_pairs


def _given_pairs(context: Context, options: PairOptions) -> set[Pair]:
    """Return the pairs that are listed or chosen by names and positions."""
    names = context.features.names()
    pairs = set[Pair]()
    known = set(names)
    if "sequence" in options.methods:
        pairs.update(lists.sequence_pairs(names, options.num_neighbors))
    if "gps" in options.methods:
        write_images_and_keypoints(context)
        near = nearest_positions(
            context.workspace.database,
            options.num_neighbors,
            options.max_distance_m,
        )
        by_gps = {pair for pair in near if known.issuperset(pair)}
        _warn_of_images_without_neighbors(context, names, pairs=by_gps, options=options)
        pairs |= by_gps
    if options.match_list_path:
        # Images that could not be read may be in the list; only their pairs are dropped.
        named = known.union(context.inputs.names())  # some may have gone just now
        listed = lists.read_pairs_once(
            Path(options.match_list_path),
            names=sorted(named),
            image_path=Path(context.inputs.image_path),
        )
        pairs.update(filter(known.issuperset, listed))
    return pairs


def _warn_of_images_without_neighbors(
    context: Context,
    names: Sequence[str],
    pairs: Collection[Pair],
    options: PairOptions,
) -> None:
    """Say which photographs have no neighbour by their positions; AffrectError where none has."""
    near = f"within {options.max_distance_m:g} m of another one"
    advice = ("raise ", Option("max-distance-m"), ", or choose pairs in another way")
    if not pairs and options.methods == ("gps",) and not options.match_list_path:
        raise AffrectError(
            f"by its position no photograph was taken {near}",
            where=context.workspace.database,
            advice=advice,
        )
    paired = set[str]().union(*pairs)
    lonely = [name for name in names if name not in paired]
    if lonely:
        logger.warning(
            "gps: %d of %d photographs were not taken %s, or nobody knows where (%s); %s",
            len(lonely),
            len(names),
            near,
            such_as(lonely),
            Logged(advice),
        )


def _similar_pairs(
    context: Context, options: PairOptions, there: Collection[Pair]
) -> set[Pair]:
    """Return the pairs chosen by features; none when all images have pairs already."""
    features = context.features
    progress = context.progress
    names = [name for name, count in features.num_keypoints().items() if count]
    are_paired = set[str]().union(*there).issuperset(names)
    if len(names) < 2 or are_paired or "retrieval" not in options.methods:
        return set()
    return set(
        retrieved_pairs(
            names,
            features.read,
            num_neighbors=options.num_neighbors,
            progress=progress,
        )
    )


def add_pairs(context: Context, pairs: Sequence[Pair]) -> None:
    """Add pairs to those that are matched already, as pycolmap's matchers do."""
    context.workspace.record_options("pairs", PairOptions().to_mapping())
    lists.write_pairs(
        context.workspace.pairs, sorted(_pairs_there(context).union(pairs))
    )


def _pairs_there(context: Context) -> set[Pair]:
    path = context.workspace.pairs
    has_pairs = path.exists() and path.stat().st_size > 0
    return set(context.listed_pairs()) if has_pairs else set()


def _forget_lost(context: Context, lost: Collection[Pair]) -> tuple[StageWarning, ...]:
    """Have a database made without the pairs that are not to be matched any more."""
    if not lost:
        return ()
    context.workspace.rewind()
    context.graph.forget()
    context.matches.remove(pairs=lost)
    first, second = min(lost)
    warning = StageWarning(
        "pairs_not_listed",
        str(context.workspace.pairs),
        {"num": len(lost), "first": first, "second": second},
    )
    logger.warning("%s", Logged(warning.line))
    return (warning,)
