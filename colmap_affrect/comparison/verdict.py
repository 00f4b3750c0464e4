"""What a comparison means, in plain words.

Gains are counted in photographs registered, or registered correctly where there is ground truth.
"""

import itertools
from collections import defaultdict
from collections.abc import Iterable

from colmap_affrect.comparison.results import Comparison, MethodResult, Span, in_most

REFERENCES = ("sift", "sift-affine-dsp", "sift-colmap")
"""What gains are measured against: the first of these that was run."""
MIN_MEAN_GAIN = 0.5
"""More photographs on average over the seeds than this is a gain, though no single photograph is
registered in most seeds that was not before."""
MIN_IMAGES = 3  # fewer are a pair, not a reconstruction
MAX_NAMES = 6


def verdict(comparison: Comparison) -> tuple[str, ...]:
    """Return the paragraphs, the most important one first."""
    return (headline(comparison), *changes(comparison), *cautions(comparison))


def ranked(methods: Iterable[MethodResult]) -> list[MethodResult]:
    """Put the method with most photographs first, of equals the fastest."""
    return sorted(methods, key=lambda method: (-_count(method).mean, method.total_s))


def headline(comparison: Comparison) -> str:
    """Say first of all whether anything was gained."""
    finished, total = comparison.finished, len(comparison.image_names)
    if not finished:
        return "No method finished."
    best, reference = ranked(finished)[0], _reference(comparison)
    most = max(method.registered.max for method in finished)
    if most < MIN_IMAGES <= total:
        return (
            f"Nothing was reconstructed: no method registers more than {most:g} of the {total} "
            "photographs."
        )
    registers = "correctly registers" if comparison.has_ground_truth else "registers"
    gain = f"{best.name} {registers} {_number(_count(best))} of {total} photographs"
    if reference is None:
        return (
            f"{gain}, no method more. COLMAP's SIFT was not run, so nothing can be said about a "
            "gain."
        )
    if len(finished) == 1:
        return f"{gain}; no other method finished."
    others = _number(_count(reference))
    if not _is_gain(best, reference):
        return (
            f"No benefit on this set: no method {registers} more photographs than "
            f"{reference.name}, which {registers} {others} of {total}."
        )
    gain += f", {reference.name} {others}."
    if not _is_rectified(best):
        return f"{gain} Rectification is not needed for that."
    as_good = [m.name for m in finished if not _is_rectified(m) and not _is_gain(best, m)]
    verb = "does" if len(as_good) == 1 else "do"
    without = f" {_listed(as_good)} {verb} as well without rectification." if as_good else ""
    return f"{gain}{without}"


def changes(comparison: Comparison) -> list[str]:
    """Say what methods gain and lose against SIFT, warps also against features without."""
    finished, reference = comparison.finished, _reference(comparison)
    pairs = [(method, reference) for method in finished if reference and method is not reference]
    recipes = [method for method in finished if "rectifier" in method.options]
    plain = [method for method in recipes if not _is_rectified(method)]
    pairs += [(m, other) for other, m in itertools.product(plain, recipes) if _is_rectified(m)]
    return [_change_text(*pair) for pair in pairs]


def cautions(comparison: Comparison) -> tuple[str, ...]:
    """Return what follows on gains and losses: what is missing, wrong or doubtful."""
    finished = comparison.finished
    truth, often = comparison.has_ground_truth, " in most seeds" * (len(comparison.seeds) > 1)
    counts = [(method.name, _count(method)) for method in finished]
    ranges = [f"{name} {n.min:g} to {n.max:g}" for name, n in counts if n.min != n.max]
    missing = comparison.registered_by_none if finished else ()
    absent = comparison.settings.get("not_compared")
    verb = "registered correctly" if truth else "registered"
    texts = [
        ranges and f"Seeds disagree: photographs {verb} depend on chance, {'; '.join(ranges)}.",
        *wrong_poses(comparison),
        missing and f"Registered by no method{often}: {_listed(missing)}.",
        *(f"{method.name} failed: {method.failed}" for method in comparison.methods
          if method.failed),
        *_doubts(comparison),
        *_contradictions(comparison),
        absent and f"Not compared for want of weights: {absent}",
    ]  # fmt: skip
    return tuple(text for text in texts if text)


def wrong_poses(comparison: Comparison) -> list[str]:
    """Say which methods register photographs that ground truth contradicts."""
    return [
        f"{method.name} registers {_number(method.registered)} photographs, of which only "
        f"{_number(method.correct)} agree with the ground truth."
        for method in comparison.finished
        if method.correct and method.correct.mean < method.registered.mean
    ]


def _reference(comparison: Comparison) -> MethodResult | None:
    """Return the method that gains are measured against, None if no SIFT has finished."""
    finished = {method.name: method for method in comparison.finished}
    return next((finished[name] for name in REFERENCES if name in finished), None)


def _is_gain(method: MethodResult, reference: MethodResult) -> bool:
    """Return whether a method registers more photographs than another, or as many more often."""
    more = len(method.usually_correct) - len(reference.usually_correct)
    return more > 0 or (more == 0 and _mean_gain(method, reference) >= MIN_MEAN_GAIN)


def _mean_gain(method: MethodResult, reference: MethodResult) -> float:
    return _count(method).mean - _count(reference).mean


def _is_rectified(method: MethodResult) -> bool:
    """Return whether a method is a recipe that warps photographs."""
    options = method.options
    is_plain = options.get("rectifier", {}).get("name") == "identity"
    return "rectifier" in options and not (is_plain and not options.get("escalation"))


def _change_text(method: MethodResult, reference: MethodResult) -> str:
    ours, others = method.usually_correct, reference.usually_correct
    named = {"gains": sorted(ours - others), "loses": sorted(others - ours)}
    parts = [f"{verb} {_listed(names)}" for verb, names in named.items() if names]
    if not parts:
        mean = _mean_gain(method, reference)
        parts.append("the same photographs" if ours else "none more")
        if abs(mean) >= MIN_MEAN_GAIN:
            more = "more" if mean > 0 else "fewer"
            parts.append(f"{abs(mean):.1f} {more} on average over the seeds")
    if reference.total_s:
        ratio = f"{method.total_s / reference.total_s:.1f}"
        speed = "about the same time" if ratio == "1.0" else f"{ratio} times the time"
        parts.append(f"in {speed} ({method.total_s:.1f} s against {reference.total_s:.1f} s)")
    return f"{method.name} against {reference.name}: {', '.join(parts)}."


def _doubts(comparison: Comparison) -> list[str]:
    """Name what is doubtful in most seeds: each reason once, with photographs and methods."""
    methods = defaultdict(list)
    for method in comparison.finished:
        reasons = {name: why for seed in method.seeds for name, why in seed.doubtful.items()}
        names = defaultdict(list)
        for name in sorted(in_most([list(seed.doubtful) for seed in method.seeds])):
            names[reasons[name]].append(name)
        for why, same in names.items():
            methods[f"{_listed(same)} ({why})"].append(method.name)
    return [f"Doubtful in {_listed(names)}: {text}." for text, names in methods.items()]


def _contradictions(comparison: Comparison) -> list[str]:
    """Name poses that differ between methods, unless ground truth knows them; worst first."""
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
    if span.min == span.max:
        return f"{span.mean:g}"
    return f"{span.mean:.1f} on average ({span.min:g} to {span.max:g})"


def _listed(names: Iterable[str]) -> str:
    """Join names, the first few of many.

    >>> _listed(["a", "b", "c"]), _listed(map(str, range(9)))
    ('a, b and c', '0, 1, 2, 3, 4, 5 and 3 more')
    """
    listed = list(names)
    if len(listed) > MAX_NAMES + 1:
        return f"{', '.join(listed[:MAX_NAMES])} and {len(listed) - MAX_NAMES} more"
    return " and ".join(filter(None, [", ".join(listed[:-1]), listed[-1]]))
