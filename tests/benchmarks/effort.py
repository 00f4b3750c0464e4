"""How many photographs are right after how long: what `--effort` is chosen by.

Runs the recipe `default` with `--effort high` on subsets of the scenes, and looks at each model
that it makes on the way: photographs that are right, and the processor time until then. Usage:

    python tests/benchmarks/effort.py --scenes-path ../shared/scenes --work-path out/effort \
        --output-path out/effort.json

A subset whose name begins with "aged" is looked for below --aged-path, a folder like --scenes-path
of the same photographs made to look old. Subsets that are in the JSON file are not run again.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from machine import parser_of, table
from registration import SUBSETS, Subset

from colmap_affrect.colmap.model_files import read_poses
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.comparison.results import pose_scores
from colmap_affrect.escalation import map_and_rematch as rematching
from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.escalation.policy import EFFORTS
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import Mapper
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.options import EFFORT_NAMES, EffortName
from colmap_affrect.pipeline import run
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.recipes import Recipe
from colmap_affrect.session.context import Context
from colmap_affrect.session.run_options import RunOptions

Row = dict[str, Any]


def camera_options(scene_path: Path, subset: Subset) -> CameraOptions:
    """Return the true intrinsics of a subset that is run with them."""
    if not subset.calibrated:
        return CameraOptions()
    lines = (scene_path / "ground_truth" / "cameras.txt").read_text().splitlines()
    _, model, _, _, *parameters = next(line for line in lines if line[0] != "#").split()
    return CameraOptions(mode="single", model=model, params=",".join(parameters))


def looked_at(scene_path: Path, names: Sequence[str], sparse_path: Path) -> Row:
    """Return how good the largest model is that is there now."""
    models = read_summaries(sparse_path)
    largest = models[0] if models else ModelSummary((), 0, 0.0, 0.0)
    found: Row = {
        "registered": len(largest.registered_names),
        "sure": len(largest.sure),
        "expected": round(sum(largest.probabilities.values()), 2),
    }
    truths = [scene_path / folder for folder in ("ground_truth", "pseudo_ground_truth")]
    truth = next((path for path in truths if path.exists()), None)
    if truth:
        poses = read_poses(sparse_path / "0") if models else {}
        scores = pose_scores(poses, read_poses(truth), names)
        found["right"] = len(scores.correct_names)
        found["sure_and_wrong"] = len(set(largest.sure) & set(scores.wrong_names))
    return found


def curve(
    scene_path: Path,
    subset: Subset,
    work_path: Path,
    effort: EffortName,
    seed: int,
    max_minutes: float,
) -> list[Row]:
    """Run a subset; return a row for each model on the way, the first one first."""
    shutil.rmtree(work_path, ignore_errors=True)
    work_path.mkdir(parents=True)
    names = sorted(path.name for path in (scene_path / "images").iterdir())
    names = names[subset.first :: subset.step]
    list_path = work_path / "names.txt"
    list_path.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    options = RunOptions(
        image_list_path=list_path,
        cameras=camera_options(scene_path, subset),
        effort=effort,
        max_minutes=max_minutes,
        verification=VerificationOptions(random_seed=seed),
        mapping=SparseOptions(random_seed=seed),
    )
    rows = list[Row]()
    begun_s = time.process_time()
    wall_s = time.monotonic()
    map_once = rematching.map_images
    choose_once = rematching.choose_learned

    def add_row(context: Context) -> None:
        row = looked_at(scene_path, names, context.workspace.sparse)
        row["cpu_s"] = round(time.process_time() - begun_s, 1)
        row["wall_s"] = round(time.monotonic() - wall_s, 1)
        row |= spent(context)
        rows.append(row)
        print(work_path.name, json.dumps(row), flush=True)

    def map_images(
        context: Context, mapper: Mapper, **how: Any
    ) -> tuple[StageReport, Any]:
        report, models = map_once(context, mapper, **how)
        if report.num_done or not rows:
            add_row(context)
        return report, models

    def choose_learned(escalation: Escalation, *, at_once: bool) -> bool:
        is_chosen = choose_once(escalation, at_once=at_once)
        if is_chosen or at_once:  # learned matching has taken its time
            add_row(escalation.context)
        return is_chosen

    rematching.map_images = map_images
    rematching.choose_learned = choose_learned
    try:
        run(scene_path / "images", work_path / "out", options, page=False)
    finally:
        rematching.map_images = map_once
        rematching.choose_learned = choose_once
    end = looked_at(scene_path, names, work_path / "out" / "sparse")
    end["cpu_s"] = round(time.process_time() - begun_s, 1)
    end["wall_s"] = round(time.monotonic() - wall_s, 1)
    return [*rows, end]


def spent(context: Context) -> Row:
    """Return what escalation has taken so far, in nominal seconds, and what it was."""
    escalation = Escalation(context, Recipe().escalate)
    models = escalation.image_set.models()
    situation = escalation.image_set.situation(
        escalation.image_set.weights(models), models
    )
    names = [level.name for level in situation.levels]
    learned_models = context.matches.state.learned_models
    return {
        "first_model_s": round(situation.first_model_s, 1),
        "spent_s": round(situation.seconds_spent(), 1),
        "pairs": {
            name: sum(state.tried >> number & 1 for state in situation.states.values())
            for number, name in enumerate(names)
            if number
        },
        "hope": round(
            max(
                situation.best_step(k, math.inf).all_photographs
                for k in situation.usable
            ),
            3,
        ),
        "scores": vars(learned_models) if learned_models else None,
    }


def right_at(rows: Sequence[Row], seconds: float) -> int:
    """Return the photographs that are right so many seconds of one core after the first model."""
    there = [row for row in rows if row["cpu_s"] - rows[0]["cpu_s"] <= seconds]
    return int(there[-1]["right"])


def last_row_of(rows: Sequence[Row], effort: str) -> Row:
    """Return the model that an effort ends with; time is counted after learned matching.

    The last row has none: it is the model of the whole run.
    """
    budget = EFFORTS[effort].budget_s(rows[0]["first_model_s"], has_model=True)
    return [row for row in rows if row.get("spent_s", math.inf) <= budget][-1]


def draw(found: dict[str, list[Row]], path: Path) -> None:
    """Draw the photographs that are right in all subsets against the seconds spent on each."""
    import matplotlib.pyplot as plt

    known = [rows for rows in found.values() if "right" in rows[0]]
    seconds = sorted(
        {row["cpu_s"] - rows[0]["cpu_s"] for rows in known for row in rows}
    )
    right = [sum(right_at(rows, limit) for rows in known) for limit in seconds]
    figure, axes = plt.subplots(figsize=(7, 3.5))
    axes.step([max(1.0, limit) for limit in seconds], right, where="post")
    for name in EFFORTS:
        last = [last_row_of(rows, name) for rows in known]
        spent = [
            row["cpu_s"] - rows[0]["cpu_s"]
            for row, rows in zip(last, known, strict=True)
        ]
        mean_s = sum(spent) / len(spent)
        num_right = sum(row["right"] for row in last)
        axes.plot(
            mean_s,
            num_right,
            "o",
            label=f"--effort {name}: {num_right} in {mean_s:.0f} s",
        )
    axes.legend(loc="lower right")
    axes.set_xscale("log")
    axes.set_xlabel("seconds of one core spent on each set after its first model")
    axes.set_ylabel(f"photographs right, {len(known)} sets")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run all subsets."""
    root = Path(__file__).resolve().parents[2]
    aged = [f"aged {name}" for name in SUBSETS if "all" not in name and "(" not in name]
    parser = parser_of(__doc__)
    parser.add_argument(
        "--subsets", nargs="+", default=[*SUBSETS, *aged], metavar="NAME"
    )
    parser.add_argument(
        "--scenes-path", type=Path, default=root.parent / "shared" / "scenes"
    )
    parser.add_argument("--aged-path", type=Path, help="the same scenes, aged")
    parser.add_argument("--effort", choices=EFFORT_NAMES, default="high")
    parser.add_argument(
        "--max-time", type=float, default=math.inf, help="minutes of a run"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot-path", type=Path, help="PNG file of the curve")
    parser.add_argument(
        "--work-path", type=Path, required=True, help="folder of the runs"
    )
    parser.add_argument(
        "--output-path", type=Path, required=True, help="JSON file of the rows"
    )
    arguments = parser.parse_args()
    output_path = arguments.output_path
    found = json.loads(output_path.read_text()) if output_path.exists() else {}
    for name in arguments.subsets:
        if name in found:
            continue
        is_aged = name.startswith("aged ")
        subset = SUBSETS[name.removeprefix("aged ")]
        scenes_path = arguments.aged_path if is_aged else arguments.scenes_path
        if is_aged:
            subset = subset._replace(calibrated=False)
        work_path = arguments.work_path / re.sub(r"\W+", "_", name)
        scene_path = scenes_path / subset.scene
        found[name] = curve(
            scene_path,
            subset,
            work_path,
            arguments.effort,
            arguments.seed,
            arguments.max_time,
        )
        output_path.write_text(json.dumps(found, indent=1) + "\n")
    if arguments.plot_path:
        draw(found, arguments.plot_path)
    keys = (
        "right",
        "registered",
        "sure",
        "sure_and_wrong",
        "expected",
        "spent_s",
        "cpu_s",
    )
    lines = [
        [name, *(str(row.get(key, "")) for key in keys)]
        for name, rows in found.items()
        for row in rows
    ]
    print(table(["subset", *keys], lines))


if __name__ == "__main__":
    main()
