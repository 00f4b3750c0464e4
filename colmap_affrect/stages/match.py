"""Match: raw matches of the listed pairs, into ``matches.h5`` and the database."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import (
    Callable,
    Container,
    Generator,
    Iterable,
    Mapping,
    Sequence,
)
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from colmap_affrect.errors import (
    Logged,
    Option,
    OptionError,
    PartError,
    StoreError,
    such_as,
)
from colmap_affrect.features.weights import digests, is_published, resolve
from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.geometry.neighbors import num_consistent_matches
from colmap_affrect.matchers.base import (
    MATCHERS,
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
)
from colmap_affrect.pairs.lists import (
    USUAL_IMAGES_IN_MEMORY,
    Pair,
    PairList,
    ordered_for_reuse,
)
from colmap_affrect.parallel.executor import Executor, Threads, available_cores
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import PAIRS_PER_WRITE, MatchStore, PairMatches
from colmap_affrect.project.record import WEIGHTS, file_sha256
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.session.context import Context, Resources, require_same_files
from colmap_affrect.session.database_export import (
    write_images_and_keypoints,
    write_matches,
)
from colmap_affrect.stages.stationary import StationaryFilter

logger = logging.getLogger(__name__)

SECONDS_PER_WRITE = 30.0  # pairs of a network take seconds each; resource
# Of the features matched first: photographs of different things have up to 76; measured
MANY_MATCHES = 300
NUM_TRIED = 40  # pairs matched by all features before many are; resource
# Of the matches that confirm each other, by all features; small scans have none; judged
MIN_GROWTH = 1.1
# Pairs with many matches, beside which others of an image are matched by no more features: this
# saves time; resource
NUM_WELL_TIED = 3
# Listed pairs from which on those are given up that show nothing in common: with fewer all are
# matched in seconds, and each one counts more; resource
MIN_PAIRS_TO_GIVE_UP = 100
CACHE_BYTES = 1 << 29  # memory that prepared images may take in a process; resource
# Of a feature ready for matching, with descriptors of 128 and coarse ones; measured
BYTES_PER_FEATURE = 870

Found = TypeVar("Found")


def match(
    context: Context, options: MatcherOptions | None = None, *, overwrite: bool = False
) -> StageReport:
    """Match the listed pairs and put the raw matches into the database.

    Args:
        context: of the workspace, whose photographs have features.
        options: of the matcher; by default those on record.
        overwrite: discard what there is.

    Returns:
        How many pairs were matched now, and how many before.

    Raises:
        OptionError: the matcher cannot take these features.
    """
    start = time.perf_counter()
    context.resources.require_device()
    pairs = context.listed_pairs()
    options = options or context.matching
    _record_options(context, options, overwrite=overwrite)
    missing = _match_missing(context, pairs, options)
    write_images_and_keypoints(context)
    write_matches(context, pairs)
    wall_s = time.perf_counter() - start
    num_before = len(pairs) - missing.num
    return StageReport("match", wall_s, missing.num, num_before, warned=missing.warned)


def _record_options(
    context: Context, options: MatcherOptions, *, overwrite: bool
) -> None:
    try:
        context.extraction.matchers(options)
    except OptionError as error:
        other = (
            "other features than those here take 'run' with another ",
            Option("output-path"),
        )
        raise OptionError(error, advice=other) from error
    weights = load_matchers(context, context.extraction, options)
    record = options.to_mapping()
    if weights:
        record = {**record, WEIGHTS: digests(weights)}
    context.workspace.record_options("match", record, overwrite=overwrite)


@dataclass(frozen=True)
class _Missing:
    """Pairs that were not matched before."""

    num: int
    warned: tuple[StageWarning, ...]


def _match_missing(
    context: Context, pairs: PairList, options: MatcherOptions
) -> _Missing:
    """Match the pairs that are not stored, by some of their features first, and learn what stands.

    The state has the digest of the list once all is done, so that an idle run looks at no pair.
    """
    matches = context.matches
    digest = file_sha256(context.workspace.pairs)
    finished = matches.state.listed
    is_finished = finished == digest and matches.num_pairs() == len(pairs)
    missing = pairs.at(slice(0) if is_finished else ~matches.has(pairs))
    if missing:
        matches.update_state(listed="")
    may_give_up = len(pairs) >= MIN_PAIRS_TO_GIVE_UP
    with context.progress.stage("match", len(missing), "pairs") as advance:
        match_pairs(
            context,
            missing,
            options,
            advance,
            options.max_num_first,
            may_give_up=may_give_up,
        )
    wanted = not_well_tied(matches, pairs) if pairs and not is_finished else []
    with context.progress.stage(
        "match", len(wanted), "pairs", "all features"
    ) as advance:
        left = _worth_all_features(
            context, wanted, options, digest, may_give_up=may_give_up
        )
        advance(len(wanted) - len(left))
        match_pairs(context, left, options, advance, may_give_up=may_give_up)
    warned = list[StageWarning]()
    has_new = bool(pairs) and (bool(missing) or not finished)
    if has_new and options.filter_stationary_matches:
        warned = StationaryFilter(context.features, matches).learn(pairs)
        for warning in warned:
            logger.warning("%s", Logged(warning.line))
    if finished != digest:
        matches.update_state(listed=digest)
    return _Missing(len(missing), tuple(warned))


def load_matchers(
    context: Context, extraction: ExtractionOptions, options: MatcherOptions
) -> dict[str, Path]:
    """Return the files of weights that the matchers of all levels read, by key.

    AffrectError for what cannot be used: before matching begins, networks are built once by files
    that are not the published ones.
    """
    resources = context.resources
    matchers = extraction.matchers(options)
    usable = [matchers[number] for number in resources.usable_levels(extraction)]
    learned = {matcher for matcher in usable if matcher.weights}
    keys = set[str]().union(*(matcher.weights for matcher in learned))
    weights = resolve(sorted(keys), resources.weights_path)
    if "match" not in context.workspace.started_stages:
        for matcher in learned:
            if not _are_published({key: weights[key] for key in matcher.weights}):
                MATCHERS.make(matcher, MatcherContext(weights, "cpu"))
    return weights


def _are_published(files: Mapping[str, Path]) -> bool:
    """Tell whether files of weights are the published ones, which their networks take."""
    return all(is_published(key, path) for key, path in files.items())


def match_pairs(
    context: Context,
    pairs: Sequence[Pair],
    options: MatcherOptions,
    advance: Callable[[int], None],
    max_num: int = 0,
    *,
    may_give_up: bool = False,
) -> None:
    """Match pairs by the features that every image has, and store what is found.

    Args:
        context: of the workspace.
        pairs: of image names.
        options: of the matcher.
        advance: is called with the number of pairs that are done.
        max_num: features of each image that are matched, those of the largest responses; 0: all.
        may_give_up: some features may show that a pair has nothing in common.
    """
    found = matched_at_level(
        context, pairs, options, 0, max_num, may_give_up=may_give_up
    )
    with closing(found) as found_pairs:
        write_batches(found_pairs, context.matches.write, advance)


def not_well_tied(matches: MatchStore, pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs whose remaining features are wanted, where some were matched.

    All but those with many matches, and those of two images that each have several such pairs.
    """
    nums = matches.nums_of_some(pairs)
    many = {pair for pair, num in nums.items() if num >= MANY_MATCHES}
    count = Counter(name for pair in many for name in pair)
    well_tied = {name for name, num in count.items() if num >= NUM_WELL_TIED}
    return [
        pair for pair in nums if pair not in many and not well_tied.issuperset(pair)
    ]


def _worth_all_features(
    context: Context,
    pairs: Sequence[Pair],
    options: MatcherOptions,
    digest: str,
    *,
    may_give_up: bool,
) -> list[Pair]:
    """Return the pairs that are still to be matched by all features.

    None where a sample of many says that these tie pairs no better than some; otherwise the
    matches of the sample are stored.

    Args:
        context: of the workspace, where the pairs were matched by some of their features.
        pairs: of image names, that these tie not well.
        options: of the matcher.
        digest: of the list of all pairs, for which the answer is kept on record.
        may_give_up: some features may show that a pair has nothing in common.
    """
    matches = context.matches
    known = matches.state.in_vain
    is_known = known is not None and known[0] == digest
    sample: Sequence[Pair] = []
    if not is_known and len(pairs) > NUM_TRIED:
        sample = pairs[:: math.ceil(len(pairs) / NUM_TRIED)]
        matched = matched_at_level(context, sample, options, 0, may_give_up=may_give_up)
        with closing(matched) as found:
            by_all = list(found)
        num_after = _sum_consistent(context.features, by_all)
        num_before = _sum_consistent(context.features, matches.read(sample))
        is_in_vain = brings_nothing(num_before, num_after)
        known = (digest, is_in_vain)
        matches.choose([] if is_in_vain else by_all, {}, in_vain=known)
    if known == (digest, True):
        return []
    done = set(sample)
    return [pair for pair in pairs if pair not in done]


def brings_nothing(num_before: int, num_after: int) -> bool:
    """Tell whether matching by all features is in vain, by confirmed matches of a sample.

    >>> brings_nothing(100, 109), brings_nothing(100, 111), brings_nothing(100, 200)
    (True, False, False)
    >>> brings_nothing(0, 0), brings_nothing(0, 1)
    (True, False)
    """
    return num_after == 0 or num_after < MIN_GROWTH * num_before


def _sum_consistent(features: FeatureStore, found: Iterable[PairMatches]) -> int:
    return sum(num_consistent(features, one.names, one.indices) for one in found)


def num_consistent(features: FeatureStore, names: Pair, indices: Any) -> int:
    """Return how many of the (M, 2) raw matches of a pair confirm each other."""
    first = features.read_frames(names[0])
    second = features.read_frames(names[1])
    return num_consistent_matches(first[indices[:, 0]], second[indices[:, 1]])


def write_batches(
    found: Iterable[Found],
    write: Callable[[list[Found]], None],
    advance: Callable[[int], None],
) -> None:
    """Write what is found of pairs batch by batch, also the last one when the search is stopped."""
    batch = list[Found]()
    written = time.monotonic()
    try:
        for item in found:
            batch.append(item)
            advance(1)
            is_due = time.monotonic() - written > SECONDS_PER_WRITE
            if len(batch) == PAIRS_PER_WRITE or is_due:
                write(batch)
                batch = []
                written = time.monotonic()
    finally:
        if batch:
            write(batch)


def matched_at_level(
    context: Context,
    pairs: Sequence[Pair],
    options: MatcherOptions,
    level: int,
    max_num: int = 0,
    *,
    may_give_up: bool = False,
) -> Generator[PairMatches, None, None]:
    """Match by the features of a level, and leave out what never moves.

    Args:
        context: of the workspace.
        pairs: of image names.
        options: of the matcher, where the level has none of its own.
        level: number of the level in the recipe.
        max_num: features of each image that are matched, those of the largest responses; 0: all.
        may_give_up: some features may show that a pair has nothing in common.

    Yields:
        The matches of each pair, in an order in which images are read seldom.
    """
    chosen = context.extraction.levels[level]
    matching = Matching(
        context.features,
        chosen.matching or options,
        level,
        chosen.base,
        chosen.features.name,
        context.resources,
        max_num,
        may_give_up=may_give_up,
    )
    stationary = StationaryFilter(context.features, context.matches)
    with closing(iterate_matches(pairs, matching, context.executor)) as found_pairs:
        for found in found_pairs:
            yield stationary.without_stationary(found)


# What is done for one pair, in a thread of this process or on a worker of a cluster.


@dataclass(frozen=True)
class Matching:
    """What is matched, how, and with what."""

    store: FeatureStore  # of the features
    options: MatcherOptions  # of the matcher
    level: int = 0  # of escalation: its features, together with those of its base
    base: int = 0  # level that has the features of the images themselves
    extractor: str = ""  # kind of the features; empty for another program's
    resources: Resources = field(default_factory=Resources)  # weights and device
    max_num_features: int = 0  # of each image, those of the largest responses; 0: all
    may_give_up: bool = False  # pairs that some features show to have nothing in common
    # About how many pairs of features there will be to compare
    num_comparisons: float = 0
    num_kept: int = USUAL_IMAGES_IN_MEMORY


def _require_features(
    store: FeatureStore, names: Container[str], pairs: Sequence[Pair]
) -> None:
    """Refuse pairs of images whose features are gone; StoreError.

    Args:
        store: Of the features.
        names: Of the images that have some.
        pairs: Of image names.
    """
    lost = {name for pair in pairs for name in pair if name not in names}
    if lost:
        names_lost = such_as(sorted(lost))
        raise StoreError(
            f"no features of {names_lost}", where=store.path, advice="run extract first"
        )


def iterate_matches(
    pairs: Sequence[Pair], matching: Matching, executor: Executor | None = None
) -> Generator[PairMatches, None, None]:
    """Match pairs, in an order in which an image, once read, stays in memory for most of its pairs.

    By default by a thread for each core. AffrectError when workers do not see the features.
    """
    if not pairs:
        return
    executor = executor or Threads(available_cores())
    counts = matching.store.num_keypoints()
    _require_features(matching.store, counts, pairs)
    limit = matching.max_num_features
    if limit:
        counts = {name: min(count, limit) for name, count in counts.items()}
    num_comparisons = sum(counts[first] * counts[second] for first, second in pairs)
    num_kept = (
        CACHE_BYTES * len(counts) // (BYTES_PER_FEATURE * sum(counts.values()) + 1)
    )
    known = replace(
        matching, num_comparisons=num_comparisons, num_kept=max(2, num_kept)
    )
    matcher = CachedMatcher(known)
    ordered = ordered_for_reuse(pairs, max(1, num_kept // 2))
    yield from executor.map(matcher, ordered, [matching.store.path])


@dataclass(frozen=True)
class PreparedImage:
    """An image ready for matching."""

    content: Any  # what the matcher made of it
    frames: Floats  # (N, 2, 3) local affine frames in pixel-centre px
    indices: Indices  # (N,) int64 that its features have in the store
    end: int  # of the indices of all that could be matched
    is_part: bool  # there are more


class _MadeOnce:
    """An image that the first thread that needs it makes ready, while others may make others."""

    def __init__(self, make: Callable[[], PreparedImage]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._image: PreparedImage | None = None

    def get(self) -> PreparedImage:
        """Return the image; who comes meanwhile waits for it."""
        with self._lock:
            if self._image is None:
                self._image = self._make()
            return self._image


class CachedMatcher:
    """Matches pairs, and keeps the images that it has prepared; a copy elsewhere has none."""

    def __init__(
        self, matching: Matching, sent: Mapping[str, str] | None = None
    ) -> None:
        """Load the networks; ``sent`` are the digests of the weights that they must have."""
        options = matching.options
        resources = matching.resources
        options.require_extractor(matching.extractor)
        self._matching = matching
        self._weights = resolve(options.weights, resources.weights_path)
        if sent is not None:
            require_same_files(self._weights, sent)
        context = MatcherContext(
            self._weights,
            resources.device,
            matching.num_comparisons,
            matching.may_give_up,
        )
        self.matcher = MATCHERS.make(options, context)
        self._images = lru_cache(matching.num_kept)(self._later)
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return CachedMatcher, (self._matching, digests(self._weights))

    def __call__(self, names: Pair) -> PairMatches:
        """Match the stored features of two images."""
        first = self.prepared(names[0])
        second = self.prepared(names[1])
        found = self.matcher.match(first.content, second.content)
        if why := found.fault(len(first.indices), len(second.indices)):
            name = self._matching.options.name
            raise PartError(f"matcher '{name}': returned {why}")
        rows = first.indices[found.indices[:, 0]]
        columns = second.indices[found.indices[:, 1]]
        indices = np.stack([rows, columns], axis=1)
        is_of_some = first.is_part or second.is_part
        level = self._matching.level
        return PairMatches(names, indices, found.scores, first.end, level, is_of_some)

    def prepared(self, name: str) -> PreparedImage:
        """Return an image ready for matching, made by the first thread that asks for it."""
        with self._lock:  # the cache may call for a name twice otherwise
            image = self._images(name)
        return image.get()

    def _later(self, name: str) -> _MadeOnce:
        return _MadeOnce(partial(self._prepare, name))

    def _prepare(self, name: str) -> PreparedImage:
        matching = self._matching
        store = matching.store
        indices = store.level_indices(name, matching.level, matching.base)
        end = int(indices.max(initial=-1)) + 1
        limit = matching.max_num_features
        everything = store.read(name)
        is_part = 0 < limit < len(indices)
        if is_part:
            order = np.argsort(-everything.responses[indices], kind="stable")
            indices = np.sort(indices[order[:limit]])
        features = everything.select(indices)
        image = ImageFeatures(features, store.image_size(name), matching.extractor)
        return PreparedImage(
            self.matcher.prepare(image), features.lafs, indices, end, is_part
        )
