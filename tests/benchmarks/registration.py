"""How many photographs of hard real scenes register, and register correctly.

Runs ``colmap-affrect compare`` on subsets of the scenes: every method (COLMAP's SIFT, recipes,
with changed options as ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``) computes features and raw matches
once, verification and mapping run once per seed. Usage:

    python tests/benchmarks/registration.py --methods sift rectified --work-path out/cache \
        --output-path out/registration.json

Prints a Markdown table of everything in the JSON file, which has a row for each method and seed;
methods and subsets that are not run this time are kept there. What is found in --work-path is used
again as long as the options are the same: after a change of code remove that folder.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from machine import parser_of, span, table


class Subset(NamedTuple):
    """Every step-th image of a scene in sorted order, perhaps with the true intrinsics."""

    scene: str
    step: int
    calibrated: bool
    first: int = 0


FOUNTAIN = "strecha_fountain_p11"
HERZ = "strecha_herz_jesus_p25"
TEMPLE = "temple_sparse_ring"
SUBSETS = {
    "fountain 0,5,10": Subset(FOUNTAIN, 5, True),
    "herz 0,8,16,24": Subset(HERZ, 8, True),
    "kermit /2": Subset("kermit", 2, False),
    "sacre_coeur /2": Subset("sacre_coeur", 2, False),
    "saharov /4": Subset("saharov32", 4, True),
    "temple /2": Subset(TEMPLE, 2, True),
    "temple all": Subset(TEMPLE, 1, True),
    "temple 1/2": Subset(TEMPLE, 2, True, 1),
    "saharov 1/5": Subset("saharov32", 5, True, 1),
    "kermit /3": Subset("kermit", 3, False),
    "sacre_coeur /3": Subset("sacre_coeur", 3, False),
    "fountain 1,5,9": Subset(FOUNTAIN, 4, True, 1),
    "herz /6": Subset(HERZ, 6, True),
    "kitchen /2": Subset("kitchen", 2, False),
    "kitchen all": Subset("kitchen", 1, False),
    "et /2": Subset("et", 2, False),
    "et 1/2": Subset("et", 2, False, 1),
    "dunes /2": Subset("copr_kap", 2, False),
    "dunes 1/3": Subset("copr_kap", 3, False, 1),
    "nadar all": Subset("nadar", 1, False),
    "sceaux all": Subset("sceaux", 1, False),
    "herz all": Subset(HERZ, 1, True),
}
calibrated = {name: subset for name, subset in SUBSETS.items() if subset.calibrated}
SUBSETS |= {
    f"{name} (unknown)": s._replace(calibrated=False) for name, s in calibrated.items()
}


def compare(
    image_path: Path,
    names: Iterable[str],
    work_path: Path,
    methods: Sequence[str],
    num_seeds: int,
    *options: object,
) -> dict[str, Any]:
    """Compare methods on some images of a folder; return the content of comparison.json."""
    work_path.mkdir(parents=True, exist_ok=True)
    list_path = work_path / "names.txt"
    list_path.write_text("\n".join(names) + "\n", encoding="utf-8")
    command = [
        *(sys.executable, "-m", "colmap_affrect", "compare", "--quiet", "--json"),
        *("--image-path", image_path, "--image-list-path", list_path),
        *("--output-path", work_path / "compare", "--methods", *methods),
        *("--seeds", ",".join(map(str, range(num_seeds))), *options),
    ]
    ended = subprocess.run(
        list(map(str, command)), check=True, stdout=subprocess.PIPE, text=True
    )
    comparison: dict[str, Any] = json.loads(ended.stdout)
    return comparison


def compare_subset(
    name: str,
    scenes_path: Path,
    work_path: Path,
    methods: Sequence[str],
    num_seeds: int,
    *options: object,
) -> dict[str, Any]:
    """Compare methods on a subset; return a mapping as :func:`compare` does."""
    subset = SUBSETS[name]
    scene_path = scenes_path / subset.scene
    names = sorted(path.name for path in (scene_path / "images").iterdir())
    names = names[subset.first :: subset.step]
    given = list(options)
    truths = [scene_path / folder for folder in ("ground_truth", "pseudo_ground_truth")]
    for truth in (path for path in truths if path.exists()):
        given += ["--ground-truth-path", truth]
    if subset.calibrated:
        lines = (scene_path / "ground_truth" / "cameras.txt").read_text().splitlines()
        _, model, _, _, *parameters = next(
            line for line in lines if line[0] != "#"
        ).split()
        given += ["--camera-mode", "single", "--camera-model", model]
        given += ["--camera-params", ",".join(parameters)]
    folder = work_path / re.sub(r"\W+", "_", name)
    return compare(scene_path / "images", names, folder, methods, num_seeds, *given)


def rows_of(name: str, comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each method and seed of a comparison.

    ``seconds`` are those of a whole run, with the mean of the seeds where each took its own.
    """
    rows = []
    for method, result in comparison["methods"].items():
        for seed in result.get("seeds", ()):
            scores = seed["scores"] or {}
            wrong_names = set(scores.get("wrong_names", ()))
            rows.append(
                {
                    "subset": name,
                    "num_images": comparison["images_total"],
                    "method": method,
                    "seed": seed["seed"],
                    "registered": seed["registered"],
                    "correct": len(scores["correct_names"]) if scores else None,
                    "rotation_error_deg": scores.get("median_rotation_error_deg"),
                    "points": seed["points3D"],
                    "sure": len(seed["sure"]),
                    "sure_and_wrong": len(wrong_names.intersection(seed["sure"])),
                    "seconds": result["total_s"],
                }
            )
    return rows


def table_of(rows: Sequence[dict[str, Any]]) -> str:
    """Format "correct of registered, rotation error" as a Markdown table of subsets by methods."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = []
    for name in SUBSETS:
        of_subset = [row for row in rows if row["subset"] == name]
        cells = []
        for method in methods if of_subset else ():
            runs = [row for row in of_subset if row["method"] == method]
            correct, registered = (
                span(run[key] for run in runs) for key in ("correct", "registered")
            )
            errors = span((run["rotation_error_deg"] for run in runs), 2)
            cells.append(f"{correct} of {registered}, {errors} degrees")
        if of_subset:
            lines.append([name, str(of_subset[0]["num_images"]), *cells])
    return table(["subset", "images", *methods], lines)


def main() -> None:
    """Run all methods on all subsets."""
    root = Path(__file__).resolve().parents[2]
    parser = parser_of(__doc__)
    parser.add_argument("--methods", nargs="+", default=["sift", "rectified"])
    parser.add_argument(
        "--subsets", nargs="+", choices=SUBSETS, default=SUBSETS, metavar="NAME"
    )
    parser.add_argument(
        "--seeds", type=int, default=5, help="run the seeds 0 to SEEDS - 1"
    )
    parser.add_argument(
        "--scenes-path", type=Path, default=root.parent / "shared" / "scenes"
    )
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument(
        "--work-path", type=Path, required=True, help="folder of the comparisons"
    )
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    arguments = parser.parse_args()
    output_path = arguments.output_path
    rows = json.loads(output_path.read_text()) if output_path.exists() else []
    weights = ["--weights", arguments.weights] if arguments.weights else []
    for name in arguments.subsets:
        folders = arguments.scenes_path, arguments.work_path
        given = arguments.methods, arguments.seeds, *weights
        new = rows_of(name, compare_subset(name, *folders, *given))
        redone = {(row["subset"], row["method"]) for row in new}
        rows = [
            row for row in rows if (row["subset"], row["method"]) not in redone
        ] + new
        output_path.write_text(json.dumps(rows, indent=1) + "\n")
    print(table_of(rows))


if __name__ == "__main__":
    main()
