"""What advice brings: each advice of a run is followed in a copy of its folder, and judged.

Runs ``colmap-affrect run`` on sets in which something is missing or doubtful, reads the advice of
``report.json``, and gives its commands in a copy of the folder. Usage:

    python tests/benchmarks/advice.py --scenes-path ../shared/scenes --sets kitchen:2 nadar \
        --variants "--recipe rectified" "--effort low" --work-path out/advice \
        --output-path out/advice.json

A set is SCENE, SCENE:STEP or SCENE:STEP:FIRST. A variant is what a run is given beside its
photographs; with --finished it begins with copies of output folders, one for each set, and goes on
there. Of what a person does, three things are imitated: more photographs are those between the ones
of the set, what is known of a lens is the true focal length, and tie points are points of --marked,
a model of all photographs for each set, clicked with an error of a pixel. What is painted or looked
at is not tried. Photographs are right as in registration.py; of a set that got more photographs
those that it had before count. Prints a table and writes every trial as JSON; trials that are in
the JSON file are not done again.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from machine import parser_of, table
from numpy.typing import NDArray
from whole_run import TRUTHS

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_poses
from colmap_affrect.comparison.results import pose_scores

Row = dict[str, Any]
PROGRAM = "colmap-affrect"
FILM_WIDTH_MM = 36.0
NUM_MARKED = 12  # tie points of a lost photograph
CLICK_ERROR_PX = 1.0
COUNTED = ("right", "registered", "sure", "sure_and_wrong")
HEADER = ("set", "variant", "advice", "before", "after", "seconds")


class Chosen(NamedTuple):
    """Photographs of a scene."""

    scene_path: Path
    step: int = 1
    first: int = 0

    def names(self, step: int) -> list[str]:
        """Return every step-th name, from the first one of the set on."""
        images = sorted(path.name for path in (self.scene_path / "images").iterdir())
        return images[self.first % step :: step]

    @property
    def truth_path(self) -> Path | None:
        """The folder of the true poses, if they are known."""
        paths = [self.scene_path / name for name in TRUTHS]
        return next((path for path in paths if path.exists()), None)


def read_set(text: str, scenes_path: Path) -> Chosen:
    """Return the photographs that SCENE:STEP:FIRST names."""
    scene, *numbers = text.split(":")
    return Chosen(scenes_path / scene, *map(int, numbers))


def run_command(words: Sequence[str], folder: Path) -> tuple[float, int]:
    """Give a command in a folder; return its seconds and its exit code."""
    begun_s = time.monotonic()
    program = [sys.executable, "-m", "colmap_affrect"]
    ended = subprocess.run(
        [*program, *words[1:]], cwd=folder, check=False, capture_output=True, text=True
    )
    if ended.returncode not in (0, 3):  # 3: no model, or a doubtful one
        print(f"{shlex.join(words)}: {ended.returncode}\n{ended.stderr[-500:]}")
    return time.monotonic() - begun_s, ended.returncode


def output_of(words: Sequence[str], folder: Path) -> Path:
    """Return the output folder that a command names."""
    return folder / words[words.index("--output-path") + 1]


def judged(chosen: Chosen, output_path: Path) -> Row:
    """Count photographs of a set in the largest model of a run."""
    report = json.loads((output_path / "report.json").read_text(encoding="utf-8"))
    counted = set(chosen.names(chosen.step))
    registered = counted.intersection(report["registered_names"])
    photographs = report["photographs"]
    sure = {name for name in registered if photographs[name]["quality"] == "sure"}
    found: Row = {"registered": len(registered), "sure": len(sure)}
    if chosen.truth_path:
        model_path = output_path / "sparse" / "0"
        poses = read_poses(model_path) if model_path.exists() else {}
        # Photographs beside those of the set tell better which of two is wrong
        scores = pose_scores(
            poses,
            read_poses(chosen.truth_path),
            report["photographs"].keys(),
        )
        found["right"] = len(counted.intersection(scores.correct_names))
        found["sure_and_wrong"] = len(sure.intersection(scores.wrong_names))
    return found


def write_names(chosen: Chosen, step: int, folder: Path) -> None:
    """Write the list of the photographs that a run is about."""
    text = "".join(f"{name}\n" for name in chosen.names(step))
    (folder / "names.txt").write_text(text, encoding="utf-8")


def true_lens(chosen: Chosen) -> list[str]:
    """Return what a person who knows the lens gives; nothing where no truth tells it."""
    cameras_path = chosen.scene_path / "ground_truth"
    if not cameras_path.exists():
        return []
    cameras = pycolmap.Reconstruction(cameras_path).cameras.values()
    focals_mm = [
        FILM_WIDTH_MM * camera.mean_focal_length() / max(camera.width, camera.height)
        for camera in cameras
    ]
    focal_mm = sorted(focals_mm)[len(focals_mm) // 2]
    return ["--focal-mm", f"{focal_mm:.2f}", "--film-width-mm", f"{FILM_WIDTH_MM:g}"]


def points_seen(model_path: Path) -> dict[int, dict[str, NDArray[np.float64]]]:
    """Return where each point of a model is seen, in px, by photograph."""
    model = pycolmap.Reconstruction(model_path)
    found = {}
    for number, point in sorted(model.points3D.items()):
        seen = {}
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen[image.name] = image.points2D[element.point2D_idx].xy
        found[number] = seen
    return found


def write_marks(model_path: Path, report: Row, folder: Path) -> None:
    """Mark points of a model of all photographs in lost ones and in two or more that are placed.

    Where not even two are placed and not doubtful, points in any three photographs are marked.

    Args:
        model_path: of that model.
        report: of the run.
        folder: for ``tie-points.csv``.
    """
    random = np.random.default_rng(0)
    placed = set(report["registered_names"])
    wanted = dict.fromkeys(report["unregistered"], NUM_MARKED)
    likely = placed - report["doubtful"].keys()
    needed, num_needed = (placed, 2) if len(likely) > 1 else ({*placed, *wanted}, 3)
    rows = []
    for number, seen in points_seen(model_path).items():
        lost = [name for name in seen if wanted.get(name, 0) > 0]
        shown = {name: xy for name, xy in seen.items() if name in {*placed, *lost}}
        if not lost or len(needed & shown.keys()) < num_needed:
            continue
        for name, xy in shown.items():
            wanted[name] = wanted.get(name, 0) - 1
            x, y = xy + random.normal(0.0, CLICK_ERROR_PX, 2)
            rows.append(f"{number},{name},{x:.1f},{y:.1f}\n")
    (folder / "tie-points.csv").write_text(
        "point,photograph,x,y\n" + "".join(rows),
        encoding="utf-8",
    )


def follow(
    chosen: Chosen, advised: Row, base: Sequence[str], folder: Path
) -> list[str]:
    """Return the words of the command that an advice comes to; none where it is done by hand.

    Args:
        chosen: the set.
        advised: of ``report.json``.
        base: words of the command of the run.
        folder: a copy of that of the run, whose list of photographs may be changed.
    """
    code = advised["code"]
    if code == "photographs":
        if chosen.step == 1:
            return []
        write_names(chosen, max(1, chosen.step // 2), folder)
        return list(base)
    if code == "lens":
        lens = true_lens(chosen)
        return [*base[:-1], "with-lens", *lens] if lens else []
    is_marked = (folder / "tie-points.csv").exists()
    if code in ("masks", "weights") or (code == "tie_points" and not is_marked):
        return []
    return shlex.split(advised["command"])


def trials(
    chosen: Chosen,
    variant: str,
    folder: Path,
    finished_path: Path | None,
    marked_path: Path | None,
    codes: Sequence[str],
) -> list[Row]:
    """Run a set, and again as each advice says.

    Args:
        chosen: the set.
        variant: options of the run.
        folder: for all results.
        finished_path: output folder to begin with a copy of; None to begin with nothing.
        marked_path: model of all photographs, whose points are marked; None to mark none.
        codes: kinds of advice to follow; all if empty.

    Returns:
        A row for the run itself, and one for each advice.
    """
    shutil.rmtree(folder, ignore_errors=True)
    base_path = folder / "base"
    base_path.mkdir(parents=True)
    write_names(chosen, chosen.step, base_path)
    if finished_path:
        shutil.copytree(finished_path, base_path / "out")
    base = [
        PROGRAM,
        "run",
        "--image-path",
        str((chosen.scene_path / "images").resolve()),
        "--image-list-path",
        "names.txt",
        *shlex.split(variant),
        "--quiet",
        "--output-path",
        "out",
    ]
    seconds, code = run_command(base, base_path)
    output_path = base_path / "out"
    report_path = output_path / "report.json"
    if not report_path.exists():
        return [{"code": "run", "exit": code}]
    rows = [{"code": "run", "seconds": seconds, **judged(chosen, output_path)}]
    report = json.loads(report_path.read_text(encoding="utf-8"))
    if marked_path:
        write_marks(marked_path, report, base_path)
    for number, advised in enumerate(report["advice"]):
        row = {key: advised[key] for key in ("code", "why", "command")}
        rows.append(row)
        if codes and advised["code"] not in codes:
            continue
        copy = folder / f"advice-{number}"
        shutil.copytree(base_path, copy)
        words = follow(chosen, advised, base, copy)
        if words:
            row["seconds"], row["exit"] = run_command(words, copy)
            if row["exit"] in (0, 3):
                row |= judged(chosen, output_of(words, copy))
        print(folder.name, json.dumps(row), flush=True)
    return rows


def counts(row: Row) -> str:
    """Say how many photographs are right, registered and sure."""
    words = [f"{row[key]} {key}" for key in COUNTED if row.get(key) is not None]
    return ", ".join(word.replace("_", " ") for word in words if word[0] != "0")


def table_of(found: dict[str, list[Row]]) -> str:
    """Format all trials as a Markdown table."""
    lines = []
    for name, rows in found.items():
        before, *after = rows
        for row in after:
            told = counts(row) or "none"
            if "seconds" not in row:
                told = "not tried"
            elif row["exit"] not in (0, 3):
                told = f"exit code {row['exit']}"
            took = f"{row['seconds']:.0f}" if "seconds" in row else "-"
            chosen, _, variant = name.partition(" ")
            lines.append(
                [
                    chosen,
                    variant,
                    row["code"],
                    counts(before) or "none",
                    told,
                    took,
                ]
            )
    return table(HEADER, lines)


def main() -> None:
    """Follow the advice for all sets and variants."""
    root = Path(__file__).resolve().parents[2]
    parser = parser_of(__doc__)
    parser.add_argument("--sets", nargs="+", required=True, metavar="SCENE:STEP:FIRST")
    parser.add_argument("--variants", nargs="+", default=[""], metavar="OPTIONS")
    parser.add_argument(
        "--codes", nargs="+", default=[], help="advice to follow (default: all)"
    )
    parser.add_argument("--finished", nargs="+", type=Path, default=[])
    parser.add_argument("--marked", nargs="+", type=Path, default=[])
    parser.add_argument(
        "--scenes-path", type=Path, default=root.parent / "shared" / "scenes"
    )
    parser.add_argument(
        "--work-path", type=Path, required=True, help="folder of the runs"
    )
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    arguments = parser.parse_args()
    output_path = arguments.output_path
    found = json.loads(output_path.read_text()) if output_path.exists() else {}
    none = [None] * len(arguments.sets)
    finished = arguments.finished or none
    marked = arguments.marked or none
    for text, finished_path, marked_path in zip(
        arguments.sets, finished, marked, strict=True
    ):
        for variant in arguments.variants:
            name = f"{text} {variant}"
            if name in found:
                continue
            folder = arguments.work_path.resolve() / re.sub(r"\W+", "_", name)
            chosen = read_set(text, arguments.scenes_path)
            found[name] = trials(
                chosen, variant, folder, finished_path, marked_path, arguments.codes
            )
            output_path.write_text(json.dumps(found, indent=1) + "\n")
    print(table_of(found))


if __name__ == "__main__":
    main()
