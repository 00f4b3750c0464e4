"""Forecasts of whole runs against the truth: at a tenth, a quarter and half of each run.

Each set is run once, in a process of its own, and what the forecast is told meanwhile is recorded:
another forecast can be tried on the same records later, without running anything. Usage:

    python tests/benchmarks/forecasts.py --scenes-path ../shared/scenes \
        --sets saharov32:4 nadar kermit --output-path out/forecasts.json
    python tests/benchmarks/forecasts.py --output-path out/forecasts.json

A set is a folder below --scenes-path, or SCENE:STEP for every STEP-th photograph of it. Prints a
table of forecasts over truth: 1 is right, 0.5 and 2 are the factor of two. Where it is open what
follows the first model, two are told, the least and the most.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from machine import describe_machine, parser_of, table
from whole_run import check_set, linked_photographs, read_set

import colmap_affrect
from colmap_affrect.escalation import policy
from colmap_affrect.forecast import FACTOR, Forecast

SHARES = (0.1, 0.25, 0.5)  # of a run, after which it is forecast
HEADER = (
    "set",
    "photographs",
    "seconds",
    "first forecast after",
    *(f"at {share:.0%}" for share in SHARES),
)


@dataclass
class Record:
    """What the forecast of a run was told, and when.

    Attributes:
        set: name of the photographs.
        num_images: photographs of the run.
        num_pairs: pairs that were expected.
        more: what else the forecast was made with, by name.
        events: time and processor time from the beginning of the run, the method of the
            forecast (``made``: there it was made) and its arguments.
        wall_s: how long the run took.
        processor_s: how much processor time.
    """

    set: str
    num_images: int = 0
    num_pairs: int = 0
    more: dict[str, float] = field(default_factory=dict)
    events: list[tuple[float, float, str, list[str | float]]] = field(
        default_factory=list
    )
    wall_s: float = 0.0
    processor_s: float = 0.0


def record_run(name: str, image_path: Path, output_path: Path) -> Record:
    """Run a set, and return what its forecast was told."""
    record = Record(name)
    start_s = time.monotonic()
    start_processor_s = time.process_time()

    class Recorded(Forecast):
        """A forecast that notes what it is told."""

        def __init__(self, num_images: int, num_pairs: int, **more: float) -> None:
            super().__init__(num_images, num_pairs, **more)
            record.num_images = num_images
            record.num_pairs = num_pairs
            record.more = more
            self._note("made")

        def begin(self, name: str, total: int, part: str = "") -> None:
            self._note("begin", name, total, part)
            super().begin(name, total, part)

        def advance(self, num_done: int) -> None:
            self._note("advance", num_done)
            super().advance(num_done)

        def expect(self, seconds: float) -> None:
            self._note("expect", seconds)
            super().expect(seconds)

        def _note(self, method: str, *arguments: str | float) -> None:
            passed_s = round(time.monotonic() - start_s, 3)
            processor_s = round(time.process_time() - start_processor_s, 3)
            record.events.append((passed_s, processor_s, method, list(arguments)))

    policy.Forecast = Recorded  # type: ignore[misc]
    colmap_affrect.run(image_path, output_path, progress=True)
    record.wall_s = time.monotonic() - start_s
    record.processor_s = time.process_time() - start_processor_s
    return record


Ends = tuple[float, float]
"""The least and the most seconds of a forecast."""


class TurnedClock:
    """A clock that is turned to the times of a record."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def forecasts_of(record: Record, times_s: Sequence[float]) -> dict[float, float | None]:
    """Return the seconds that the forecast says are left at some times of a recorded run.

    Its clock is that of the processor: a load that others change meanwhile does not count.
    """
    clock = TurnedClock()
    forecast = None
    events = list(record.events)
    found: dict[float, Ends | None] = {}
    for time_s in sorted(times_s):
        while events and events[0][1] <= time_s:
            _, clock.now_s, method, arguments = events.pop(0)
            if method == "made":
                # By the clock of the processor one core works
                more = {**record.more, "num_cores": 1}
                forecast = Forecast(record.num_images, record.num_pairs, clock, **more)
            elif method == "expect":
                # It is told in seconds of all cores
                seconds = float(arguments[0]) * record.more["num_cores"]
                forecast.expect(seconds)
            else:
                getattr(forecast, method)(*arguments)
        clock.now_s = time_s
        found[time_s] = forecast.least_and_most_s() if forecast else None
    return found


def ratios(ends: Ends | None, truth_s: float) -> str:
    """Format a forecast over the truth, as it is shown: one number where one will do."""
    if ends is None:
        return "-"
    least, most = (end / truth_s for end in ends)
    if most <= FACTOR * least:
        return f"{math.sqrt(least * most):.2f}"
    return f"{least:.2f} to {most:.2f}"


def row_of(record: Record) -> list[str]:
    """Return the cells of a recorded run."""
    whole_s = record.processor_s
    seconds = list(range(1, int(whole_s)))
    by_second = forecasts_of(record, seconds)
    first_s = next((s for s in seconds if by_second[s] is not None), None)
    cells = [record.set, str(record.num_images), f"{whole_s:.0f}"]
    cells.append("-" if first_s is None else f"{first_s / whole_s:.0%}")
    by_share = forecasts_of(record, [share * whole_s for share in SHARES])
    for time_s, ends in by_share.items():
        cells.append(ratios(ends, whole_s - time_s))
    return cells


def record_in_process(text: str, scenes_path: Path) -> Record:
    """Record the run of a set in a process of its own."""
    chosen = read_set(text, scenes_path)
    with (
        linked_photographs(chosen) as image_path,
        tempfile.TemporaryDirectory() as scratch,
    ):
        path = Path(scratch) / "record.json"
        command = [sys.executable, str(Path(__file__).resolve())]
        command += ["--run-only", str(image_path), "--output-path", str(path)]
        subprocess.run(command, check=True)
        record = read_records(path)[0]
    record.set = text
    return record


def read_records(path: Path) -> list[Record]:
    """Return the records of a file, none where it is missing."""
    if not path.exists():
        return []
    records = json.loads(path.read_text(encoding="utf-8"))["records"]
    return [Record(**values) for values in records]


def write_records(records: Sequence[Record], path: Path) -> None:
    """Write records, and the machine of the runs."""
    values = {
        "machine": describe_machine(),
        "records": [asdict(record) for record in records],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values) + "\n", encoding="utf-8")


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--scenes-path", type=Path, help="folder of the scenes")
    parser.add_argument(
        "--sets", nargs="+", metavar="SCENE[:STEP]", default=[], help="sets to be run"
    )
    parser.add_argument(
        "--output-path", type=Path, required=True,
        help="JSON file of the records, which is added to",
    )  # fmt: skip
    parser.add_argument(
        "--run-only", type=Path, metavar="IMAGES",
        help="record one run of these photographs in this process",
    )  # fmt: skip
    return parser.parse_args()


def main() -> None:
    """Record the runs that are asked for, and print the table of all that are on record."""
    arguments = parsed_arguments()
    path = arguments.output_path
    if arguments.run_only:
        with tempfile.TemporaryDirectory() as scratch:
            record = record_run("", arguments.run_only, Path(scratch) / "out")
        write_records([record], path)
        return
    if arguments.sets and not arguments.scenes_path:
        raise SystemExit("--sets: give --scenes-path, too")
    for text in arguments.sets:
        check_set(text, arguments.scenes_path)
    records = read_records(path)
    for text in arguments.sets:
        records.append(record_in_process(text, arguments.scenes_path))
        write_records(records, path)
    rows = [row_of(record) for record in records]
    print(table(HEADER, rows))


if __name__ == "__main__":
    main()
