"""Fit how likely matching a pair again is to bring something, for each kind of level.

Matches up to 21 pairs of each subset of the scenes that are not strong at every level of the recipe
``default`` (of the last ones eight: they take a minute each). A pair is right where the rotation
that its inliers give with the true intrinsics is within 10 degrees of the true one; without ground
truth it needs 50 inliers. From each pair come six rows, which differ in the levels that were tried
in vain before and in the other pairs of which the outcome is known. Usage:

    python tests/benchmarks/fit_expected_gain.py --scenes-path ../shared/scenes \
        --work-path out/gain --output-path colmap_affrect/escalation/expected_gain.json

A subset whose name begins with "aged" is looked for below --aged-path, a folder like --scenes-path
of the same photographs made to look old. What is found in --work-path is used again.
"""

from __future__ import annotations

import json
import random
import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from machine import parser_of
from numpy.typing import NDArray
from registration import SUBSETS

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_verification import PairVerifier
from colmap_affrect.escalation.escalate import Escalation
from colmap_affrect.escalation.expected_gain import PairState, kind_of, terms
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import EscalateOptions, load_recipe
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import match, matched_at_level
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

NUM_PAIRS = 21
NUM_SLOW_PAIRS = 8
NUM_ROWS = 6
STRONG = 100
ENOUGH = 50
MAX_ERROR_DEG = 10.0
PRIOR = {
    "constant": -1.5,
    "consistent": 0.5,
    "inliers": 0.3,
    "tried": -0.5,
    "success_ratio": 0.3,
}
RIDGE = {
    "constant": 0.9,
    "consistent": 6.0,
    "inliers": 6.0,
    "tried": 6.0,
    "success_ratio": 6.0,
}

Array = NDArray[np.float64]
Row = dict[str, Any]
Truth = dict[str, tuple[Array, Array, tuple[int, int]]]


def truth_of(scene_path: Path) -> Truth:
    """Return (3, 4) cam_from_world, (3, 3) intrinsics and size in px by stem of the image."""
    for folder in ("ground_truth", "pseudo_ground_truth"):
        if (scene_path / folder).exists():
            model = pycolmap.Reconstruction(str(scene_path / folder))
            cameras = model.cameras
            return {
                Path(image.name).stem: (
                    image.cam_from_world().matrix(),
                    cameras[image.camera_id].calibration_matrix(),
                    (cameras[image.camera_id].width, cameras[image.camera_id].height),
                )
                for image in model.images.values()
            }
    return {}


def rotation_error_deg(
    truth: Truth,
    names: Sequence[str],
    points: Sequence[Array],
    sizes: Sequence[tuple[int, int]],
) -> float | None:
    """Return how far the rotation of matched points is from the true one, None if unknown.

    Points are (N, 2) pixel-centre px of images of ``sizes``, which may be shrunk.
    """
    known = [truth.get(Path(name).stem) for name in names]
    if None in known or len(points[0]) < 8:
        return None
    rays = []
    for (_, matrix, full), places, size in zip(known, points, sizes, strict=True):
        px = (places + 0.5) * np.divide(full, size)
        rays.append((px - matrix[:2, 2]) / matrix.diagonal()[:2])
    limit = 3.0 / known[0][1][0, 0]
    found, mask = cv2.findEssentialMat(*rays, np.eye(3), cv2.USAC_MAGSAC, 0.999, limit)
    if found is None:
        return 180.0
    _, rotation, _, _ = cv2.recoverPose(found[:3], *rays, np.eye(3), mask=mask)
    first, second = (pose[:, :3] for pose, _, _ in known)
    cosine = (np.trace(rotation.T @ second @ first.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def outcomes(images: Sequence[Path], truth: Truth, work_path: Path) -> list[Row]:
    """Match pairs of a set at all levels; return what is known of each, and each level brought."""
    shutil.rmtree(work_path, ignore_errors=True)
    (work_path / "images").mkdir(parents=True)
    for path in images:
        shutil.copy(path, work_path / "images")
    context = Context(Workspace(work_path / "out"))
    with context.workspace.locked():
        extract(context, Inputs.of(work_path / "images"), load_recipe("default"))
        choose_pairs(context)
        match(context)
        verify_matches(context)
        context.workspace.record_options("escalate", EscalateOptions().to_mapping())
        escalation = Escalation(context, EscalateOptions())
        states = escalation.image_set.states()
        features = context.features
        weak = [pair for pair, state in states.items() if state.num_inliers < STRONG]
        chosen = sorted(random.Random(0).sample(weak, min(NUM_PAIRS, len(weak))))
        rows: dict[tuple[str, str], Row] = {
            pair: {
                "inliers": states[pair].num_inliers,
                "consistent": states[pair].num_consistent,
                "levels": {},
            }
            for pair in chosen
        }
        for number in range(1, len(context.extraction.levels)):
            pairs = chosen if number < 3 else chosen[:NUM_SLOW_PAIRS]
            level = context.extraction.levels[number]
            names = sorted({name for pair in pairs for name in pair})
            missing = [
                (name, k)
                for name in names
                for k in sorted({level.base, number})
                if k not in features.level_ranges(name)
            ]
            escalation._extend(missing, lambda _: None)
            verifier = PairVerifier(
                context.graph.ids,
                context.graph.cameras,
                context.verification,
                level.max_image_size_px,
            )
            with closing(
                matched_at_level(context, pairs, context.matching, number)
            ) as found_pairs:
                for found in found_pairs:
                    frames = [features.read_frames(name) for name in found.names]
                    inliers = verifier.inliers(
                        found.names, (frames[0], frames[1]), found.indices
                    )
                    points = [
                        f[i, :, 2].astype(float)
                        for f, i in zip(frames, inliers.T, strict=True)
                    ]
                    sizes = [features.image_size(name) for name in found.names]
                    error = rotation_error_deg(truth, found.names, points, sizes)
                    rows[found.names]["levels"][number] = len(inliers), error
    return list(rows.values())


def is_right(row: Row, number: int) -> bool:
    """Tell whether a level brought something right: a pair, or a strong one where there was one."""
    count, error = row["levels"][number]
    right = count >= ENOUGH if error is None else error < MAX_ERROR_DEG
    return bool(count >= (STRONG if row["inliers"] else 1) and right)


def examples(
    rows: Sequence[Row], number: int
) -> Iterator[tuple[dict[str, float], bool]]:
    """Yield terms and outcome of pairs of one set at a level, each several times."""
    drawn = random.Random(0)
    there = [row for row in rows if number in row["levels"]]
    for row in there:
        others = [other for other in there if other is not row]
        for _ in range(NUM_ROWS):
            tried = [k for k in row["levels"] if k != number and drawn.random() < 0.5]
            in_vain = [
                k
                for k in tried
                if row["levels"][k][0] < (STRONG if row["inliers"] else 1)
            ]
            known = drawn.sample(others, drawn.randint(0, len(others)))
            wins = sum(other["levels"][number][0] > 0 for other in known)
            bits = 1 | sum(1 << k for k in in_vain)
            consistent = 0 if row["inliers"] else row["consistent"]
            state = PairState(row["inliers"], consistent, tried=bits)
            yield terms(state, wins, len(known) - wins), is_right(row, number)


def fitted(values: Array, outcome: Array) -> Array:
    """Return the weights of a logistic regression with a normal prior, by Newton's method."""
    prior = np.array(list(PRIOR.values()))
    ridge = np.array(list(RIDGE.values()))
    weights = prior.copy()
    for _ in range(50):
        chance = 1 / (1 + np.exp(-values @ weights))
        gradient = values.T @ (chance - outcome) + ridge * (weights - prior)
        hessian = (values.T * (chance * (1 - chance))) @ values + np.diag(ridge)
        weights -= np.linalg.solve(hessian, gradient)
    return weights


def main() -> None:
    """Observe all subsets, and fit."""
    root = Path(__file__).resolve().parents[2]
    aged = [f"aged {name}" for name in SUBSETS if "all" not in name and "(" not in name]
    plain = [name for name in SUBSETS if "(" not in name]
    parser = parser_of(__doc__)
    parser.add_argument("--subsets", nargs="+", default=[*plain, *aged], metavar="NAME")
    parser.add_argument(
        "--scenes-path", type=Path, default=root.parent / "shared" / "scenes"
    )
    parser.add_argument("--aged-path", type=Path, help="the same scenes, aged")
    parser.add_argument(
        "--work-path", type=Path, required=True, help="folder of what is observed"
    )
    parser.add_argument(
        "--output-path", type=Path, required=True, help="JSON file of the weights"
    )
    arguments = parser.parse_args()
    observed: dict[str, list[Row]] = {}
    for name in arguments.subsets:
        subset = SUBSETS[name.removeprefix("aged ")]
        scenes = (
            arguments.aged_path if name.startswith("aged ") else arguments.scenes_path
        )
        if scenes is None:
            continue
        folder = arguments.work_path / name.replace("/", "_")
        path = folder.with_suffix(".json")
        if not path.exists():
            images = sorted((scenes / subset.scene / "images").iterdir())
            truth = truth_of(scenes / subset.scene)
            rows = outcomes(images[subset.first :: subset.step], truth, folder)
            path.write_text(json.dumps(rows))
        observed[name] = json.loads(path.read_text())
        for row in observed[name]:
            row["levels"] = {
                int(number): found for number, found in row["levels"].items()
            }
    content = json.loads(arguments.output_path.read_text())
    levels = load_recipe("default").levels
    for number in range(1, len(levels)):
        by_set: defaultdict[str, list[tuple[dict[str, float], bool]]] = defaultdict(
            list
        )
        for name, rows in observed.items():
            by_set[name] += examples(rows, number)
        sets = [name for name, found in by_set.items() for _ in found]
        found = [example for part in by_set.values() for example in part]
        values = np.array([[known[term] for term in PRIOR] for known, _ in found])
        outcome = np.array([float(right) for _, right in found])
        which = np.array(sets)
        chance = np.zeros(len(outcome))
        for name in by_set:  # left out of the fit
            out = which == name
            odds = values[out] @ fitted(values[~out], outcome[~out])
            chance[out] = 1 / (1 + np.exp(-odds))
        kind = kind_of(levels[number])
        weights = np.round(fitted(values, outcome), 2).tolist()
        content["levels"][kind]["coefficients"] = dict(zip(PRIOR, weights, strict=True))
        brier = np.mean((chance - outcome) ** 2)
        mean = np.var(outcome)
        print(
            f"{kind}: {len(found) // NUM_ROWS} pairs, Brier {brier:.3f} (mean alone {mean:.3f})"
        )
    content["made"] = (
        f"{datetime.now(UTC):%Y-%m-%d} by tests/benchmarks/fit_expected_gain.py"
    )
    content["data"] = f"{NUM_PAIRS} weak pairs at most of each of {len(observed)} sets"
    arguments.output_path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
