"""How many photographs of hard real scenes register, and register correctly.

Every method (COLMAP SIFT, COLMAP SIFT with affine shapes and domain-size pooling, recipes of
colmap_affrect, with changed options as ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``) computes features and
raw matches of a subset once; a recipe that escalates climbs by the verification with seed 0.
Verification and mapping run once per seed, with the sparse preset of colmap_affrect for all
methods. Usage:

    python tests/benchmarks/registration.py --methods sift default --work-path out/cache \
        --output-path out/registration.json

Prints two Markdown tables of everything in the JSON file; rows of methods and subsets that are not
run this time are kept. Features and raw matches below --work-path are reused as long as the
options of the recipe are the same: after a change of code remove that folder.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tempfile
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

from registration_report import Row, detail_table, merge, summary_table

from colmap_affrect import stages
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import import_images, open_database
from colmap_affrect.colmap.mapping import map_database
from colmap_affrect.colmap.verification import verify
from colmap_affrect.comparison.methods import SIFT, Method, parse_method
from colmap_affrect.comparison.metrics import Poses, model_poses, pose_scores, read_poses
from colmap_affrect.comparison.sift import extract_sift, match_sift
from colmap_affrect.escalation import escalate
from colmap_affrect.extraction import Resources
from colmap_affrect.matching.pairs import exhaustive_pairs
from colmap_affrect.options import (
    CameraOptions,
    MappingOptions,
    MaskOptions,
    VerificationOptions,
)
from colmap_affrect.photographs import list_images
from colmap_affrect.recipes import Recipe
from colmap_affrect.workspace import Workspace


@dataclass(frozen=True)
class Subset:
    """Some images of one scene.

    Attributes:
        name: name in the table.
        scene: folder of the scene.
        step: every step-th image in sorted order is taken.
        calibrated: whether the runs are given the true intrinsics.
    """

    name: str
    scene: str
    step: int
    calibrated: bool

    def image_paths(self, scenes_path: Path) -> list[Path]:
        """List the images of the subset in sorted order."""
        return sorted((scenes_path / self.scene / "images").iterdir())[:: self.step]


SUBSETS = [
    Subset("fountain 0,5,10", "strecha_fountain_p11", 5, True),
    Subset("herz 0,8,16,24", "strecha_herz_jesus_p25", 8, True),
    Subset("kermit /2", "kermit", 2, False),
    Subset("sacre_coeur /2", "sacre_coeur", 2, False),
    Subset("saharov /4", "saharov32", 4, True),
    Subset("temple /2", "temple_sparse_ring", 2, True),
    Subset("temple all", "temple_sparse_ring", 1, True),
    Subset("nadar all", "nadar", 1, False),
    Subset("sceaux all", "sceaux", 1, False),
    Subset("herz all", "strecha_herz_jesus_p25", 1, True),
]


def camera_options(subset: Subset, scenes_path: Path) -> CameraOptions:
    """Return one camera of known intrinsics, or COLMAP's automatic choice."""
    if not subset.calibrated:
        return CameraOptions()
    text = (scenes_path / subset.scene / "ground_truth" / "cameras.txt").read_text()
    fields = next(line.split() for line in text.splitlines() if not line.startswith("#"))
    return CameraOptions(mode="single", model=fields[1], params=",".join(fields[4:]))


def link_images(paths: list[Path], image_path: Path) -> None:
    """Fill a folder with links to images."""
    image_path.mkdir(parents=True, exist_ok=True)
    for path in paths:
        link = image_path / path.name
        link.unlink(missing_ok=True)
        link.symlink_to(path.resolve())


def compute_sift(
    database_path: Path, image_path: Path, cameras: CameraOptions, affine: bool
) -> dict[str, float]:
    """Write COLMAP SIFT features and raw matches to a database; return seconds per stage."""
    names = list_images(image_path)
    import_images(database_path, image_path, names, cameras)
    start = time.perf_counter()
    extract_sift(database_path, image_path, names, MaskOptions(), affine=affine)
    middle = time.perf_counter()
    match_sift(database_path, exhaustive_pairs(names), database_path.with_suffix(".pairs.txt"))
    return {"extraction": middle - start, "matching": time.perf_counter() - middle}


def match_recipe(
    folder: Path,
    image_path: Path,
    cameras: CameraOptions,
    recipe: Recipe,
    resources: Resources | None = None,
) -> dict[str, float]:
    """Write our features and raw matches to folder/database.db; return seconds per stage."""
    workspace = Workspace(folder)
    extraction = stages.extract(
        workspace, image_path, recipe, cameras, resources=resources, overwrite=True
    )
    stages.choose_pairs(workspace)
    matching = stages.match(workspace, recipe.matching)
    seconds = {"extraction": extraction.wall_s, "matching": matching.wall_s}
    if recipe.extraction.escalation:
        stages.verify_matches(workspace, VerificationOptions(), 0)
        seconds["escalation"] = escalate(workspace, resources=resources).wall_s
    return seconds


def compute_matches(
    method: Method,
    cameras: CameraOptions,
    image_path: Path,
    folder: Path,
    resources: Resources,
) -> dict[str, float]:
    """Compute the features and raw matches of a folder of images unless they are there already.

    Args:
        method: a recipe, or COLMAP's SIFT.
        cameras: how images share cameras.
        image_path: folder of the images.
        folder: gets database.db and seconds.json.
        resources: weights of networks.

    Returns:
        Seconds per stage.
    """
    seconds_path = folder / "seconds.json"
    if not seconds_path.exists():
        if method.recipe is None:
            database_path = folder / "database.db"
            database_path.unlink(missing_ok=True)
            seconds = compute_sift(database_path, image_path, cameras, method.label != SIFT)
        else:
            seconds = match_recipe(folder, image_path, cameras, method.recipe, resources)
        seconds_path.write_text(json.dumps(seconds))
    return dict(json.loads(seconds_path.read_text()))


def work_folder(method: Method, parent: Path) -> Path:
    """Return the folder of a method; that of a recipe depends on its options."""
    name = method.label
    if method.recipe is not None:
        options = zlib.crc32(repr(method.recipe).encode())
        name = f"{method.recipe.name}-{options:08x}"
    (parent / name).mkdir(parents=True, exist_ok=True)
    return parent / name


def run_seed(
    folder: Path, image_path: Path, cameras: CameraOptions, truth: Poses | None, seed: int
) -> Row:
    """Verify and map a copy of folder/database.db and measure the largest model."""
    with tempfile.TemporaryDirectory() as scratch:
        database_path = Path(shutil.copy(folder / "database.db", scratch))
        with open_database(database_path) as database:
            database.clear_two_view_geometries()
        sparse_path = Path(scratch) / "sparse"
        start = time.perf_counter()
        verify(database_path, VerificationOptions(), seed)
        middle = time.perf_counter()
        models = map_database(
            database_path,
            image_path,
            sparse_path,
            MappingOptions(),
            seed,
            intrinsics_given=bool(cameras.params),
            next_image=lambda _: None,
        )
        seconds = {"verification": middle - start, "mapping": time.perf_counter() - middle}
        row: Row = {"seed": seed, "registered": 0, "correct": 0, "points": 0}
        if models:
            row |= model_metrics(pycolmap.Reconstruction(sparse_path / "0"), truth or {})
    return {**row, "correct": None if truth is None else row["correct"], "seconds": seconds}


def model_metrics(model: pycolmap.Reconstruction, truth: Poses) -> Row:
    """Measure one model."""
    estimated = model_poses(model)
    scores = pose_scores(estimated, truth, list(estimated))
    return {
        "registered": len(estimated),
        "correct": len(scores.correct_names),
        "rotation_error_deg": scores.median_rotation_error_deg,
        "points": model.num_points3D(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error": model.compute_mean_reprojection_error(),
    }


def read_true_poses(scene_path: Path) -> Poses | None:
    """Read (pseudo) ground truth; None where there is none."""
    folders = [scene_path / name for name in ("ground_truth", "pseudo_ground_truth")]
    return next((read_poses(folder) for folder in folders if folder.exists()), None)


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    root = Path(__file__).resolve().parents[2]
    names = [subset.name for subset in SUBSETS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="+", default=["sift", "sift-affine-dsp", "default"])
    parser.add_argument("--subsets", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--seeds", type=int, default=5, help="run the seeds 0 to SEEDS - 1")
    parser.add_argument("--scenes-path", type=Path, default=root.parent / "shared" / "scenes")
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument("--work-path", type=Path, required=True, help="cache of raw matches")
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    return parser.parse_args()


def main() -> None:
    """Run all methods on all subsets."""
    arguments = parse_arguments()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    output_path, scenes_path = arguments.output_path, arguments.scenes_path
    results = json.loads(output_path.read_text()) if output_path.exists() else []
    for subset in (subset for subset in SUBSETS if subset.name in arguments.subsets):
        parent = arguments.work_path / re.sub(r"\W+", "_", subset.name)
        image_path = parent / "images"
        paths = subset.image_paths(scenes_path)
        link_images(paths, image_path)
        truth = read_true_poses(scenes_path / subset.scene)
        for text in arguments.methods:
            method = parse_method(text)
            folder = work_folder(method, parent)
            cameras = camera_options(subset, scenes_path)
            result = {
                "subset": subset.name,
                "method": method.label,
                "num_images": len(paths),
                "seconds": compute_matches(
                    method, cameras, image_path, folder, Resources(arguments.weights)
                ),
                "runs": [
                    run_seed(folder, image_path, cameras, truth, seed)
                    for seed in range(arguments.seeds)
                ],
            }
            print(detail_table([result]).splitlines()[-1], file=sys.stderr)
            results = merge(results, result, [subset.name for subset in SUBSETS])
            output_path.write_text(json.dumps(results, indent=1) + "\n")
    print(summary_table(results))
    print(detail_table(results))


if __name__ == "__main__":
    main()
