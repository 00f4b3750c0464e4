"""Whole runs beside COLMAP's SIFT pipeline: seconds, processor time, memory, and what is right.

Every peer runs in a process of its own that begins with an empty folder, so that loading counts.
All peers run on a set in turn, in several rounds. Usage:

    python tests/benchmarks/whole_run.py --scenes-path ../shared/scenes \
        --sets strecha_herz_jesus_p25 saharov32 --output-path out/whole_run.json \
        --diagram-path out/whole_run.png

A set is a folder below --scenes-path, or SCENE:STEP for every STEP-th photograph of it. Peers are
`sift-colmap` (pycolmap: extraction, exhaustive matching, incremental mapping, all by default),
recipes, whose `run` is timed, and RECIPE+workers: the same on two workers of a cluster on this
machine, which are started before as docs/cluster.md says, and whose processor time is added.
Photographs are right as in registration.py, where a scene has a folder ground_truth or
pseudo_ground_truth. Prints a table of medians, and writes every run as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

from machine import describe_machine, parser_of, span, table
from workers import started_workers

from colmap_affrect.colmap.model_files import Poses, read_poses
from colmap_affrect.comparison.results import pose_scores
from colmap_affrect.errors import OptionError
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.recipes import load_recipe

SIFT = "sift-colmap"
ON_WORKERS = "+workers"
TRUTHS = ("ground_truth", "pseudo_ground_truth")
HEADER = (
    "set",
    "photographs",
    "peer",
    "seconds",
    "ratio",
    "processor",
    "ratio",
    "right",
)
# ``other`` is what no stage has: loading, checks, the page
STAGES = ("extract", "pairs", "match", "verify", "escalate", "guide", "map", "other")
MIB = 1 << 20
UNIT_BYTES = (
    1 if sys.platform == "darwin" else 1024
)  # of memory that the system reports


@dataclass(frozen=True)
class Set:
    """Photographs of a scene, and their true poses where they are known."""

    name: str
    folder: Path
    names: list[str]
    truth: Poses


@dataclass(frozen=True)
class Run:
    """One whole run of a peer."""

    set: str
    peer: str
    round: int
    num_images: int
    wall_s: float
    processor_s: float
    memory_mib: float
    stages_s: dict[str, float]
    num_models: int
    registered: int
    correct: int | None  # of the largest model; None without true poses


def read_set(text: str, scenes_path: Path) -> Set:
    """Return the photographs that SCENE or SCENE:STEP names."""
    scene, _, step = text.partition(":")
    folder = scenes_path / scene
    names = sorted(path.name for path in (folder / "images").iterdir())
    truth: Poses = {}
    for name in TRUTHS:
        if (folder / name).exists() and not truth:
            truth = read_poses(folder / name)
    return Set(text, folder / "images", names[:: int(step or 1)], truth)


@contextmanager
def linked_photographs(chosen: Set) -> Iterator[Path]:
    """Yield a folder that has links to the photographs of a set alone."""
    with tempfile.TemporaryDirectory() as scratch:
        for name in chosen.names:
            (Path(scratch) / name).symlink_to(chosen.folder.resolve() / name)
        yield Path(scratch)


def run_sift(image_path: Path, output_path: Path) -> None:
    """Run COLMAP's pipeline with its own defaults; leave models and ``stages.json``."""
    from colmap_affrect.colmap import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    database_path = output_path / "database.db"
    sparse_path = output_path / "sparse"
    sparse_path.mkdir()
    times = [time.perf_counter()]
    pycolmap.extract_features(database_path, image_path)
    times.append(time.perf_counter())
    pycolmap.match_exhaustive(database_path)
    times.append(time.perf_counter())
    models = pycolmap.incremental_mapping(database_path, image_path, sparse_path)
    times.append(time.perf_counter())
    for number, model in models.items():
        (sparse_path / str(number)).mkdir(exist_ok=True)
        model.write(sparse_path / str(number))
    stages = {}
    for number, name in enumerate(("extract", "match", "map")):
        stages[name] = times[number + 1] - times[number]
    (output_path / "stages.json").write_text(json.dumps(stages))


def command_of(peer: str, image_path: Path, output_path: Path) -> list[str]:
    """Return the command line of a whole run."""
    if peer == SIFT:
        own = [sys.executable, str(Path(__file__).resolve()), "--sift-only"]
        return [*own, str(image_path), "--output-path", str(output_path)]
    given = ["--image-path", str(image_path), "--output-path", str(output_path)]
    program = [sys.executable, "-m", "colmap_affrect", "run", "--quiet"]
    recipe = peer.removesuffix(ON_WORKERS)
    return [*program, "--recipe", recipe, *given]


def stages_of(output_path: Path) -> dict[str, float]:
    """Return the seconds of each stage that a run has left."""
    own = output_path / "stages.json"
    if own.exists():
        stages: dict[str, float] = json.loads(own.read_text())
        return stages
    report = json.loads((output_path / "report.json").read_text())
    return {stage["name"]: stage["wall_s"] for stage in report["stages"]}


def largest_model(output_path: Path) -> tuple[int, Poses]:
    """Return the number of models, and the poses of the largest."""
    models = []
    for folder in (output_path / "sparse").iterdir():
        if folder.name.isdecimal():
            models.append(read_poses(folder))
    return len(models), max(models, key=len, default={})


def measure(chosen: Set, peer: str, round_number: int) -> Run:
    """Run a peer once on a set."""
    with (
        linked_photographs(chosen) as image_path,
        tempfile.TemporaryDirectory() as scratch,
    ):
        output_path = Path(scratch) / "out"
        output_path.mkdir()
        command = command_of(peer, image_path, output_path)
        num_workers = 2 if peer.endswith(ON_WORKERS) else 0
        with started_workers(num_workers, Path(scratch)) as cluster:
            command += cluster.options
            idle_s = cluster.processor_s()
            begin = time.perf_counter()
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            _, status, usage = os.wait4(process.pid, 0)
            wall_s = time.perf_counter() - begin
            workers_s = cluster.processor_s() - idle_s
        code = os.waitstatus_to_exitcode(status)
        # 3 says that photographs are not registered
        if code not in (0, 3):
            raise SystemExit(f"{' '.join(command)}: ended with {code}")
        num_models, poses = largest_model(output_path)
        stages = stages_of(output_path)
    correct = None
    if chosen.truth:
        scores = pose_scores(poses, chosen.truth, chosen.names)
        correct = len(scores.correct_names)
    return Run(
        set=chosen.name,
        peer=peer,
        round=round_number,
        num_images=len(chosen.names),
        wall_s=wall_s,
        processor_s=usage.ru_utime + usage.ru_stime + workers_s,
        memory_mib=usage.ru_maxrss * UNIT_BYTES / MIB,
        stages_s=stages,
        num_models=num_models,
        registered=len(poses),
        correct=correct,
    )


def ratios_to_first(
    runs: Sequence[Run], reference: Sequence[Run], key: str
) -> list[float]:
    """Return a number of each run over that of the first peer in the same round."""
    ratios = []
    for run, first in zip(runs, reference, strict=True):
        ratios.append(getattr(run, key) / getattr(first, key))
    return ratios


def rows_of(runs: Sequence[Run]) -> list[list[str]]:
    """Return the cells of a row for each set and peer."""
    rows = []
    for name in dict.fromkeys(run.set for run in runs):
        of_set = [run for run in runs if run.set == name]
        peers = list(dict.fromkeys(run.peer for run in of_set))
        reference = [run for run in of_set if run.peer == peers[0]]
        for peer in peers:
            found = [run for run in of_set if run.peer == peer]
            right = span(run.correct for run in found)
            registered = span(run.registered for run in found)
            rows.append(
                [
                    name,
                    str(found[0].num_images),
                    peer,
                    f"{median(run.wall_s for run in found):.0f}",
                    f"{median(ratios_to_first(found, reference, 'wall_s')):.2f}",
                    f"{median(run.processor_s for run in found):.0f}",
                    f"{median(ratios_to_first(found, reference, 'processor_s')):.2f}",
                    f"{right} of {registered}",
                ]
            )
    return rows


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draw the median seconds of each set as bars of stages, a bar for each peer."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    bars = list(dict.fromkeys((run.set, run.peer) for run in runs))
    figure = Figure(figsize=(9.0, 1.2 + 0.4 * len(bars)), layout="constrained")
    axes = figure.add_subplot()
    left = [0.0] * len(bars)
    for stage in STAGES:
        widths = [median_of_stage(runs, bar, stage) for bar in bars]
        axes.barh(range(len(bars)), widths, left=left, label=stage)
        left = [end + width for end, width in zip(left, widths, strict=True)]
    axes.set_yticks(range(len(bars)), [f"{name}, {peer}" for name, peer in bars])
    axes.invert_yaxis()
    axes.set_xlabel("seconds, medians of rounds")
    axes.legend(
        ncols=len(STAGES) // 2,
        fontsize="small",
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
    )
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=120)


def median_of_stage(runs: Sequence[Run], bar: tuple[str, str], stage: str) -> float:
    """Return the median seconds of a stage of a set and a peer; ``other`` is what no stage has."""
    seconds = []
    for run in runs:
        if (run.set, run.peer) != bar:
            continue
        in_stages = sum(run.stages_s.values())
        other = max(0.0, run.wall_s - in_stages)
        seconds.append(other if stage == "other" else run.stages_s.get(stage, 0.0))
    return median(seconds)


def keep_to_cores(number: int) -> None:
    """Let this process and what it starts use so many cores, as COLMAP and we count them."""
    if not hasattr(os, "sched_setaffinity"):
        raise SystemExit("--num-cores: this system does not bind processes to cores")
    cores = sorted(os.sched_getaffinity(0))[:number]
    os.sched_setaffinity(0, cores)


def check(arguments: Namespace) -> None:
    """Find what would end the runs or lose their results before the first of them begins."""
    if not (arguments.scenes_path and arguments.sets):
        raise SystemExit("give --scenes-path and --sets")
    if arguments.num_rounds < 1:
        raise SystemExit("--num-rounds: give 1 or more")
    for text in arguments.sets:
        check_set(text, arguments.scenes_path)
    for peer in set(arguments.peers) - {SIFT}:
        try:
            load_recipe(peer.removesuffix(ON_WORKERS))
        except OptionError as error:
            raise SystemExit(f"--peers: {error}") from error
    if arguments.diagram_path and not find_spec("matplotlib"):
        raise SystemExit("--diagram-path: needs matplotlib; pip install matplotlib")
    for path in (arguments.output_path, arguments.diagram_path):
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)


def check_set(text: str, scenes_path: Path) -> None:
    """Refuse what is no SCENE or SCENE:STEP."""
    scene, colon, step = text.partition(":")
    if not (scenes_path / scene / "images").is_dir():
        raise SystemExit(f"--sets {text}: no folder {scene}/images in --scenes-path")
    if colon and not (step.isdecimal() and int(step)):
        raise SystemExit(f"--sets {text}: STEP is 1 or more, as in {scene}:2")


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes-path", type=Path, help="folder of the scenes")
    parser.add_argument(
        "--sets", nargs="+", metavar="SCENE[:STEP]", help="every STEP-th photograph"
    )
    parser.add_argument(
        "--peers", nargs="+", default=[SIFT, "default"], metavar="PEER",
        help=f"{SIFT}, a recipe, or RECIPE{ON_WORKERS}; the first is the reference of the ratios",
    )  # fmt: skip
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument("--num-cores", type=int, help="for every peer; by default all")
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    parser.add_argument("--diagram-path", type=Path, help="PNG file, by matplotlib")
    parser.add_argument(
        "--sift-only", type=Path, metavar="IMAGES",
        help=f"run {SIFT} once into the folder --output-path, and time nothing",
    )  # fmt: skip
    return parser.parse_args()


def main() -> None:
    """Run the peers in turn and print the table."""
    arguments = parsed_arguments()
    if arguments.sift_only:
        run_sift(arguments.sift_only, arguments.output_path)
        return
    check(arguments)
    if arguments.num_cores:
        keep_to_cores(arguments.num_cores)
    sets = [read_set(text, arguments.scenes_path) for text in arguments.sets]
    results: dict[str, Any] = {
        "machine": describe_machine(),
        "num_cores": available_cores(),
    }
    runs = list[Run]()
    for number in range(arguments.num_rounds):
        for chosen in sets:
            for peer in arguments.peers:
                runs.append(measure(chosen, peer, number))
                results["runs"] = [asdict(run) for run in runs]
                arguments.output_path.write_text(json.dumps(results, indent=1) + "\n")
    if arguments.diagram_path:
        draw(runs, arguments.diagram_path)
    print(f"{results['machine']}\n\n{table(HEADER, rows_of(runs))}")


if __name__ == "__main__":
    main()
