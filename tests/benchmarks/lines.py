"""Fit how far the focal lengths by straight lines can be trusted, and show how far that holds.

Measures the lines of every photograph of scenes with known cameras (folders with ``images`` and a
COLMAP text model in ``ground_truth`` or ``pseudo_ground_truth``). ``TEMPER`` and ``MODEL_SIGMA`` of
``geometry/lines`` are fitted with one scene after the other left out; each photograph is judged by
the fit without its scene. Usage:

    python tests/benchmarks/lines.py --scenes-path ../shared/scenes --diagram-path out/lines.png

Prints a table by scene, the constants by all scenes, and seconds for a photograph.
"""

from __future__ import annotations

import argparse
import itertools
import math
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from machine import table
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from colmap_affrect.geometry import lines
from colmap_affrect.images.lines import lines_of
from colmap_affrect.images.reading import read_gray

Numbers = NDArray[np.float64]

TEMPERS = (1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
MODEL_SIGMAS = (0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1)
CONSTANTS = list(itertools.product(TEMPERS, MODEL_SIGMAS))
LIES = 0.02  # of photographs whose lines mislead whatever the constants: they decide no fit
STREET_VIEWS = ("lausanne_tribunal", "gsv_*", 0.5)  # cut from panoramas
Z_LIMITS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)


@dataclass(frozen=True)
class Measured:
    """What the lines of one photograph say, and the truth."""

    scene: str
    name: str
    true_focal: float  # longer sides
    scores: (
        Numbers | None
    )  # (F, S) log-likelihoods of focal lengths and shifts, not tempered
    seconds: float  # of one core, without reading


@dataclass(frozen=True)
class Judged:
    """What is stated of one photograph."""

    scene: str
    name: str
    true_focal: float  # longer sides
    focal: float  # longer sides
    sigma: float  # of its logarithm

    @property
    def error(self) -> float:
        """Logarithm of found by true."""
        return math.log(self.focal / self.true_focal)

    @property
    def z(self) -> float:
        """Error in deviations."""
        return self.error / self.sigma


def true_focals(scene: Path) -> dict[str, float]:
    """Return the focal length of each photograph with a known camera, in longer sides."""
    if scene.name == STREET_VIEWS[0]:
        _, pattern, focal = STREET_VIEWS
        return {path.name: focal for path in (scene / "images").glob(pattern)}
    for folder in (scene / "ground_truth", scene / "pseudo_ground_truth"):
        if (folder / "cameras.txt").exists():
            focals = {}
            for words in rows_of(folder / "cameras.txt"):
                focals[words[0]] = float(words[4]) / max(int(words[2]), int(words[3]))
            images = rows_of(folder / "images.txt")
            return {words[9]: focals[words[8]] for words in images if len(words) == 10}
    return {}


def rows_of(path: Path) -> list[list[str]]:
    """Return the words of the lines of a file of COLMAP, without comments."""
    rows = path.read_text(encoding="utf-8").splitlines()
    return [row.split() for row in rows if not row.startswith("#")]


def measure(scene: Path) -> list[Measured]:
    """Measure the lines of the photographs of a scene, on one core."""
    found = []
    for name, focal in sorted(true_focals(scene).items()):
        image = read_gray(scene / "images" / name)
        start = time.process_time()
        likelihood = lines_of(image).likelihood
        seconds = time.process_time() - start
        scores = (
            None if likelihood is None else likelihood.log_likelihoods * lines.TEMPER
        )
        found.append(Measured(scene.name, name, focal, scores, seconds))
    return found


def posterior(scores: Numbers, temper: float) -> Numbers:
    """Return the (F,) probabilities of focal lengths, with the axis in the middle."""
    likelihood = lines.LineLikelihood(scores / temper, np.zeros((*scores.shape, 3, 3)))
    return lines.posterior(likelihood, lines.MIDDLE_SIGMA).sum(axis=1)


def log_densities(one: Measured) -> Numbers:
    """Return (P,) log-densities of the true focal length, for each of ``CONSTANTS``."""
    if one.scores is None:
        return np.zeros(len(CONSTANTS))
    found = []
    for temper in TEMPERS:
        chances = posterior(one.scores, temper)
        for model_sigma in MODEL_SIGMAS:
            distances = np.log(lines.FOCALS / one.true_focal) / model_sigma
            densities = (
                np.exp(-0.5 * distances**2) / model_sigma / math.sqrt(2.0 * math.pi)
            )
            found.append(math.log((1.0 - LIES) * float(chances @ densities) + LIES))
    return np.array(found)


def fitted(photographs: Sequence[Measured], densities: Numbers) -> tuple[float, float]:
    """Return the temper and the deviation of the model under which the truth is likeliest.

    Every scene counts as much as the next.

    Args:
        photographs: N of them.
        densities: (N, P) log-densities of the truth, for each of ``CONSTANTS``.
    """
    scenes = np.array([one.scene for one in photographs])
    means = [densities[scenes == scene].mean(axis=0) for scene in np.unique(scenes)]
    return CONSTANTS[int(np.mean(means, axis=0).argmax())]


def judged(one: Measured, temper: float, model_sigma: float) -> Judged | None:
    """Return what is stated of a photograph; None where it has too few segments."""
    if one.scores is None:
        return None
    chances = posterior(one.scores, temper)
    mean = float(chances @ np.log(lines.FOCALS))
    deviation = math.sqrt(float(chances @ (np.log(lines.FOCALS) - mean) ** 2))
    sigma = math.hypot(deviation, model_sigma)
    return Judged(one.scene, one.name, one.true_focal, math.exp(mean), sigma)


def row_of(
    scene: str, photographs: Sequence[Measured], found: Sequence[Judged]
) -> list[str]:
    """Return a row of the table: truth, found, and how far what is stated holds."""
    truths = [one.true_focal for one in photographs]
    known = [one for one in found if one.sigma < lines.KNOWN_SIGMA]
    errors = np.abs([one.error for one in known])
    zs = np.abs([one.z for one in found])
    ten = int((errors < math.log(1.1)).sum())
    twenty = int((errors < math.log(1.2)).sum())
    return [
        scene,
        str(len(photographs)),
        span_of(truths),
        span_of([one.focal for one in known]) if known else "",
        f"{len(known)}: {ten}, {twenty}" if known else "none",
        f"{int((zs > 2.0).sum())}",
        f"{zs.max(initial=0.0):.1f}",
    ]


def span_of(values: Sequence[float]) -> str:
    """Return smallest and largest number."""
    low = f"{min(values):.2f}"
    high = f"{max(values):.2f}"
    return low if low == high else f"{low} to {high}"


def draw(found: Sequence[Judged], path: Path) -> None:
    """Draw how often the truth is within so many deviations, and the focal lengths themselves."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.5))
    limits = np.array(Z_LIMITS)
    expected = [math.erf(limit / math.sqrt(2.0)) for limit in limits]
    known = [one for one in found if one.sigma < lines.KNOWN_SIGMA]
    left.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for chosen, label, color in (
        (found, "all", "#1b6ca8"),
        (known, "lines know it", "#D55E00"),
    ):
        zs = np.abs([one.z for one in chosen])
        shares = [float((zs < limit).mean()) for limit in limits]
        left.plot(expected, shares, "o-", color=color, label=f"{label} ({len(chosen)})")
    left.set(
        xlabel="probability of the interval stated", ylabel="share with the truth in it"
    )
    left.legend(frameon=False)
    right.plot([0.4, 6.0], [0.4, 6.0], color="0.7", linewidth=1)
    for one in found:
        is_known = one.sigma < lines.KNOWN_SIGMA
        bar = [
            [one.focal * (1.0 - math.exp(-one.sigma))],
            [one.focal * math.expm1(one.sigma)],
        ]
        color = "#D55E00" if is_known else "#9ab8cc"
        right.errorbar(
            [one.true_focal], [one.focal], bar, fmt=".", color=color, linewidth=0.7
        )
    right.set(xscale="log", yscale="log", xlabel="true focal length, longer sides")
    right.set(ylabel="by the lines")
    ticks = [0.5, 0.7, 1.0, 1.5, 2.0, 3.0]
    for axis in (right.xaxis, right.yaxis):
        axis.set_ticks(ticks, [str(tick) for tick in ticks])
        axis.set_ticks([], minor=True)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def measured(options: argparse.Namespace) -> list[Measured]:
    """Return what lines say of all photographs, on one core; what is kept is used again."""
    if options.work_path and options.work_path.exists():
        return list(pickle.loads(options.work_path.read_bytes()))
    names = options.scenes or sorted(
        path.name for path in options.scenes_path.iterdir()
    )
    photographs = list[Measured]()
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        for name in names:
            photographs += measure(options.scenes_path / name)
    if options.work_path:
        options.work_path.write_bytes(pickle.dumps(photographs))
    return photographs


def main() -> None:
    """Measure, fit, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--scenes-path", type=Path, required=True)
    parser.add_argument("--diagram-path", type=Path, required=True)
    parser.add_argument(
        "--work-path", type=Path, help="file that keeps what was measured"
    )
    parser.add_argument("--scenes", nargs="*", help="by default all with known cameras")
    options = parser.parse_args()
    photographs = measured(options)
    densities = np.array([log_densities(one) for one in photographs])
    scenes = np.array([one.scene for one in photographs])
    rows = []
    everything = list[Judged]()
    for name in np.unique(scenes):
        others = [one for one in photographs if one.scene != name]
        constants = fitted(others, densities[scenes != name])
        print(
            f"without {name}: temper {constants[0]:g}, deviation of the model {constants[1]:g}"
        )
        inside = [one for one in photographs if one.scene == name]
        stated = [judged(one, *constants) for one in inside]
        found = [one for one in stated if one is not None]
        rows.append(row_of(name, inside, found))
        everything += found
    rows.append(row_of("all", photographs, everything))
    titles = [
        "scene",
        "images",
        "truth",
        "known ones",
        "within 10, 20 %",
        "z > 2",
        "largest z",
    ]
    print(table(titles, rows))
    zs = np.abs([one.z for one in everything])
    print(
        f"z below 1: {(zs < 1).mean():.1%}, below 2: {(zs < 2).mean():.1%} of {len(zs)}"
    )
    temper, model_sigma = fitted(photographs, densities)
    print(f"by all: TEMPER = {temper:g}, MODEL_SIGMA = {model_sigma:g}")
    seconds = [one.seconds for one in photographs]
    print(
        f"seconds for a photograph: median {np.median(seconds):.2f}, most {max(seconds):.2f}"
    )
    draw(everything, options.diagram_path)


if __name__ == "__main__":
    main()
