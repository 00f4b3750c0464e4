"""Which pairs of a run a person should look at, and why."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import zip_longest

from colmap_affrect.colmap.connections import lone_ties
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.guided_store import GuidedPair
from colmap_affrect.project.report import ModelSummary, ReconstructionReport, largest_of

MAX_NUM_PAIRS = 12  # in a page; more nobody looks at
MAX_NUM_ORDINARY = 3  # pairs of each sort that nothing speaks against
# Share of the inliers; a model contradicts a pair where most disagree
MIN_AGREEMENT = 0.5


class Reason(Enum):
    """Why a pair is worth a look, as the page says it."""

    DISAGREES = "most inliers disagree with the model"
    BRIDGE_EDGE = "it alone ties two parts of the model"
    REJECTED = "rejected by hand"
    BRIDGED = "{image} came in by this pair"
    ONE_VIEW = "both show one view: prints of one negative, or taken from one place"
    DOUBTFUL = "{image} is doubtful"
    MISSING = "{image} is missing"
    STRONGEST = "the strongest pair of {image}"
    GUIDED = "guided matching found much of it"


@dataclass(frozen=True)
class Candidate:
    """A pair that may be shown."""

    pair: Pair | None  # None for an image without a verified pair
    reason: Reason
    image: str = ""  # that the reason is about

    @property
    def text(self) -> str:
        """The reason as the page says it."""
        return self.reason.value.format(image=self.image)


def pairs_to_check(
    report: ReconstructionReport,
    num_inliers: Mapping[Pair, int],
    agreement: Mapping[Pair, float],
    rejected: Sequence[Pair] = (),
    guided: Sequence[GuidedPair] = (),
) -> dict[Pair, str]:
    """Choose pairs that a person should look at.

    The reasons take turns: first a pair for each of them, then a second one.

    Args:
        report: of the run; its largest model counts.
        num_inliers: of the verified pairs that may be used.
        agreement: share of the inliers that agrees with the model, of verified pairs.
        rejected: pairs that were rejected by hand.
        guided: what guided matching has found.

    Returns:
        At most ``MAX_NUM_PAIRS`` pairs, names in order, with the reasons why they are shown.
    """
    model = largest_of(report.models)
    strongest = _strongest_pairs(num_inliers, set(model.registered_names))
    registered = [name for name in model.registered_names if name in strongest]
    disagreeing = [pair for pair, share in agreement.items() if share < MIN_AGREEMENT]
    agreeing = _agreeing(agreement)
    turns = zip_longest(
        _of_pairs(disagreeing, Reason.DISAGREES),
        _of_pairs(lone_ties(agreeing), Reason.BRIDGE_EDGE),
        _of_pairs(rejected, Reason.REJECTED),
        _bridged(model),
        _of_pairs(model.one_view, Reason.ONE_VIEW),
        _of_images(model.doubtful, strongest, Reason.DOUBTFUL),
        _of_images(report.unregistered, strongest, Reason.MISSING),
        _of_weakest(registered, strongest, num_inliers),
        _guided(guided),
    )
    reasons: dict[Pair, list[str]] = {}
    for turn in turns:
        for candidate in turn:
            if candidate is None or candidate.pair is None:
                continue
            first, second = candidate.pair
            pair = (min(first, second), max(first, second))
            if pair in reasons or len(reasons) < MAX_NUM_PAIRS:
                reasons.setdefault(pair, []).append(candidate.text)
    return {pair: "; ".join(texts) for pair, texts in reasons.items()}


def _agreeing(agreement: Mapping[Pair, float]) -> list[Pair]:
    """Return the pairs of which most inliers agree with the model."""
    return [pair for pair, share in agreement.items() if share >= MIN_AGREEMENT]


def backed_pairs(agreement: Mapping[Pair, float]) -> set[Pair]:
    """Return the pairs that the rest of a model speaks for: nobody needs to reject them.

    A pair that alone ties two parts, or a photograph, agrees with the model whether it is right or
    not.

    Args:
        agreement: share of the inliers that agrees with the model, of verified pairs.

    Returns:
        Pairs of which most inliers agree, and without which the model would still be one; names
        in order.
    """
    agreeing = _agreeing(agreement)
    num_pairs = Counter(name for pair in agreeing for name in pair)
    of_others = set[Pair]()
    for first, second in agreeing:
        if min(num_pairs[first], num_pairs[second]) > 1:
            of_others.add((min(first, second), max(first, second)))
    return of_others.difference(lone_ties(agreeing))


def _strongest_pairs(
    num_inliers: Mapping[Pair, int], registered: Collection[str]
) -> dict[str, Pair]:
    """Return the pair of each image that has most inliers.

    Where there is a model, only pairs with a registered image count.
    """
    strongest: dict[str, Pair] = {}
    for pair in sorted(num_inliers, key=lambda pair: -num_inliers[pair]):
        for name, other in (pair, pair[::-1]):
            if other in registered or not registered:
                strongest.setdefault(name, pair)
    return strongest


def _of_pairs(pairs: Iterable[Pair], reason: Reason) -> Iterator[Candidate]:
    for pair in pairs:
        yield Candidate(pair, reason)


def _bridged(model: ModelSummary) -> Iterator[Candidate]:
    """Yield the pairs by which single images were registered."""
    for name, bridge in model.bridges.items():
        yield Candidate((name, bridge.by), Reason.BRIDGED, name)


def _of_images(
    names: Iterable[str], strongest: Mapping[str, Pair], reason: Reason
) -> Iterator[Candidate]:
    """Yield the strongest pair of each image."""
    for name in names:
        yield Candidate(strongest.get(name), reason, name)


def _of_weakest(
    names: Iterable[str], strongest: Mapping[str, Pair], num_inliers: Mapping[Pair, int]
) -> Iterator[Candidate]:
    """Yield the strongest pairs of the images whose strongest pairs are weakest."""
    by_inliers = sorted((num_inliers[strongest[name]], name) for name in names)
    weakest = [name for _, name in by_inliers[:MAX_NUM_ORDINARY]]
    return _of_images(weakest, strongest, Reason.STRONGEST)


def _guided(guided: Sequence[GuidedPair]) -> Iterator[Candidate]:
    """Yield the pairs in which guided matching found most inliers that no raw matches are."""
    by_gain = sorted(guided, key=lambda pair: len(pair.exact) - pair.num_inliers)
    for pair in by_gain[:MAX_NUM_ORDINARY]:
        if pair.num_inliers:
            yield Candidate(pair.names, Reason.GUIDED)
