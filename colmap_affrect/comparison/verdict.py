"""What a comparison means, in plain words: one small rule per function.

Gains are counted in photographs registered, or registered correctly where there is ground truth.
"""

import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

from colmap_affrect.comparison.results import Comparison, MethodResult, Span, in_most

REFERENCES = ("sift", "sift-affine-dsp", "sift-colmap")
"""What gains are measured against: the first of these that was run."""

MIN_MEAN_GAIN = 0.5
"""More photographs on average over the seeds than this is a gain, though no single photograph is
registered in most seeds that was not before."""

MIN_IMAGES = 3  # fewer are a pair, not a reconstruction
MAX_NAMES = 6
MIN_WHOLE_SECONDS = 10


def verdict(comparison: Comparison) -> tuple[str, ...]:
    """Return the paragraphs, the most important one first."""
    return (*headline(comparison), *changes(comparison), *cautions(comparison))


def cautions(comparison: Comparison) -> tuple[str, ...]:
    """Return what follows on gains and losses: what is missing, wrong or doubtful."""
    rules = (
        seeds_disagree, wrong_poses, registered_by_none, failures, doubts, unstable_poses,
        contradictions, not_compared,
    )  # fmt: skip
    return tuple(text for rule in rules for text in rule(comparison))


def ranked(methods: Iterable[MethodResult]) -> list[MethodResult]:
    """Put the method with most photographs first, of equals the fastest."""
    return sorted(methods, key=lambda method: (-_count(method).mean, method.total_s))


def not_compared(comparison: Comparison) -> list[str]:
    """Say which learned methods could be compared too, and how their weights are had."""
    absent = comparison.settings.get("not_compared")
    return [f"Not compared for want of weights: {absent}"] if absent else []


@dataclass(frozen=True)
class Change:
    """What one method does better or worse than another.

    Attributes:
        gained: images that it usually registers and the other does not, sorted.
        mean: more images on average over the seeds.
        time_ratio: of their total times; 0 where the other one took none.
    """

    gained: tuple[str, ...]
    lost: tuple[str, ...]
    mean: float
    time_ratio: float

    @classmethod
    def between(cls, method: MethodResult, reference: MethodResult) -> Self:
        """Compare a method with a reference; both have finished."""
        ours, others = method.usually_correct, reference.usually_correct
        ratio = method.total_s / reference.total_s if reference.total_s else 0.0
        mean = _count(method).mean - _count(reference).mean
        return cls(tuple(sorted(ours - others)), tuple(sorted(others - ours)), mean, ratio)

    @property
    def is_gain(self) -> bool:
        """Whether more photographs are registered, or the same ones more often."""
        more = len(self.gained) - len(self.lost)
        return more > 0 or (more == 0 and self.mean >= MIN_MEAN_GAIN)


def reference_of(comparison: Comparison) -> MethodResult | None:
    """Return the method that gains are measured against, None if no SIFT has finished."""
    finished = {method.name: method for method in comparison.finished}
    return next((finished[name] for name in REFERENCES if name in finished), None)


def is_unrectified(method: MethodResult) -> bool:
    """Tell whether a method is a recipe that warps nothing."""
    rectifier = method.options.get("rectifier", {})
    return rectifier.get("name") == "identity" and not method.options.get("escalation")


def is_rectified(method: MethodResult) -> bool:
    """Tell whether a method is a recipe that warps photographs."""
    return "rectifier" in method.options and not is_unrectified(method)


def headline(comparison: Comparison) -> list[str]:
    """Say first of all whether anything was gained."""
    finished, total = comparison.finished, len(comparison.image_names)
    if not finished:
        return ["No method finished."]
    best = ranked(finished)[0]
    most = max(method.registered.max for method in finished)
    if most < MIN_IMAGES <= total:
        return [
            f"Nothing was reconstructed: no method registers more than {most:g} of the {total} "
            "photographs."
        ]
    registers = "correctly registers" if comparison.has_ground_truth else "registers"
    reference = reference_of(comparison)
    best_of_total = f"{_number(_count(best))} of {total}"
    if reference is None:
        return [
            f"{best.name} {registers} {best_of_total} photographs, no method more. COLMAP's SIFT "
            "was not run, so nothing can be said about a gain."
        ]
    if len(finished) == 1:
        return [f"{best.name} {registers} {best_of_total} photographs; no other method finished."]
    num_of_reference = _number(_count(reference))
    if not Change.between(best, reference).is_gain:
        return [
            f"No benefit on this set: no method {registers} more photographs than "
            f"{reference.name}, which {registers} {num_of_reference} of {total}."
        ]
    gain = f"{best.name} {registers} {best_of_total} photographs, {reference.name} "
    return [f"{gain}{num_of_reference}.{_without_rectification(comparison, best)}"]


def _without_rectification(comparison: Comparison, best: MethodResult) -> str:
    if not is_rectified(best):
        return " Rectification is not needed for that."
    as_good = [
        method.name
        for method in comparison.finished
        if not is_rectified(method) and not Change.between(best, method).is_gain
    ]
    if not as_good:
        return ""
    verb = "does" if len(as_good) == 1 else "do"
    return f" {_listed(as_good)} {verb} as well without rectification."


def changes(comparison: Comparison) -> list[str]:
    """Say for every method what it gains and loses against SIFT, and at what cost.

    Rectified methods are set against our own features without warps too.
    """
    finished, reference = comparison.finished, reference_of(comparison)
    rectified, plain = filter(is_rectified, finished), filter(is_unrectified, finished)
    pairs = [(method, reference) for method in finished if reference and method is not reference]
    pairs += [(method, other) for other, method in itertools.product(plain, rectified)]
    return [_change_text(*pair) for pair in pairs]


def _change_text(method: MethodResult, reference: MethodResult) -> str:
    change = Change.between(method, reference)
    parts = []
    if change.gained:
        parts.append(f"gains {_listed(change.gained)}")
    if change.lost:
        parts.append(f"loses {_listed(change.lost)}")
    if not parts:
        parts.append("the same photographs" if method.usually_correct else "none more")
        if abs(change.mean) >= MIN_MEAN_GAIN:
            parts.append(f"{abs(change.mean):.1f} {'more' if change.mean > 0 else 'fewer'} on "
                         "average over the seeds")  # fmt: skip
    times = f"{_seconds(method.total_s)} s against {_seconds(reference.total_s)} s"
    ratio = f"{change.time_ratio:.1f}"
    speed = "about the same time" if ratio == "1.0" else f"{ratio} times the time"
    cost = f", in {speed} ({times})" if change.time_ratio else ""
    return f"{method.name} against {reference.name}: {', '.join(parts)}{cost}."


def seeds_disagree(comparison: Comparison) -> list[str]:
    """Say which methods register more or fewer photographs with another seed."""
    ranges = [
        f"{method.name} {_count(method).min:g} to {_count(method).max:g}"
        for method in comparison.finished
        if _count(method).min != _count(method).max
    ]
    if not ranges:
        return []
    verb = "registered correctly" if comparison.has_ground_truth else "registered"
    return [f"Seeds disagree: photographs {verb} depend on chance, {'; '.join(ranges)}."]


def wrong_poses(comparison: Comparison) -> list[str]:
    """Say which methods register photographs that ground truth contradicts."""
    return [
        f"{method.name} registers {_number(method.registered)} photographs, of which only "
        f"{_number(method.correct)} agree with the ground truth."
        for method in comparison.finished
        if method.correct and method.correct.mean < method.registered.mean
    ]


def registered_by_none(comparison: Comparison) -> list[str]:
    """Name the photographs that nothing registers."""
    missing = comparison.registered_by_none
    if not missing or not comparison.finished:
        return []
    often = " in most seeds" if len(comparison.seeds) > 1 else ""
    return [f"Registered by no method{often}: {_listed(missing)}."]


def failures(comparison: Comparison) -> list[str]:
    """Name the methods that failed, with the reason."""
    return [f"{method.name} failed: {method.failed}" for method in comparison.methods
            if method.failed]  # fmt: skip


def doubts(comparison: Comparison) -> list[str]:
    """Name what cannot be trusted in the models of most seeds, whatever ground truth says.

    Methods in which the same is doubtful are named together.
    """
    methods = defaultdict(list)
    for method in comparison.finished:
        for text in _doubts_of(method):
            methods[text].append(method.name)
    return [f"Doubtful in {_listed(names)}: {text}." for text, names in methods.items()]


def _doubts_of(method: MethodResult) -> list[str]:
    """Return each reason once, with all photographs that it is true of."""
    reasons = {name: why for seed in method.seeds for name, why in seed.doubtful.items()}
    names = defaultdict(list)
    for name in sorted(in_most([list(seed.doubtful) for seed in method.seeds])):
        names[reasons[name]].append(name)
    of_model = sorted(in_most([seed.doubts for seed in method.seeds]))
    return [
        *(f"{_listed(same)} ({why})" for why, same in names.items()),
        *(f"the whole model ({why})" for why in of_model),
    ]


def unstable_poses(comparison: Comparison) -> list[str]:
    """Doubt poses that differ between the seeds."""
    return [
        f"Doubtful: in {method.name} the poses of {_listed(method.unstable_names)} contradict "
        "each other from seed to seed."
        for method in comparison.finished
        if method.unstable_names
    ]


def contradictions(comparison: Comparison) -> list[str]:
    """Doubt poses that differ between methods; the method with most contradictions comes first.

    Where ground truth knows the pose, it says who is right.
    """
    known, images_of = comparison.names_with_truth, {}
    for method in comparison.finished:
        unknown = {name: set(v) - known for name, v in method.disagreements.items()}
        images_of[method.name] = {name: images for name, images in unknown.items() if images}
    texts = []
    while any(images_of.values()):
        worst = max(images_of, key=lambda name: len(images_of[name]))
        others = images_of.pop(worst)
        images = sorted({image for names in others.values() for image in names})
        texts.append(
            f"Doubtful: {worst} disagrees with {_listed(others)} about the pose of "
            f"{_listed(images)}; repeated or symmetric structures can do that."
        )
        for remaining in images_of.values():
            remaining.pop(worst, None)
    return texts


def _count(method: MethodResult) -> Span:
    """Images that count: those registered correctly, without ground truth those registered."""
    return method.correct or method.registered


def _number(span: Span) -> str:
    return span.text("{0.mean:.1f} on average ({0.min:g} to {0.max:g})")


def _seconds(value: float) -> str:
    return f"{value:.1f}" if value < MIN_WHOLE_SECONDS else f"{value:.0f}"


def _listed(names: Iterable[str]) -> str:
    """Join names, the first few of many.

    >>> _listed(["a", "b", "c"]), _listed(map(str, range(9)))
    ('a, b and c', '0, 1, 2, 3, 4, 5 and 3 more')
    """
    shown: Sequence[str] = list(names)
    if len(shown) > MAX_NAMES + 1:
        return f"{', '.join(shown[:MAX_NAMES])} and {len(shown) - MAX_NAMES} more"
    return " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))
