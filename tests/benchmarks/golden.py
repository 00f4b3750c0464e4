"""Digests of whole runs: did a change of the code change any result?

Runs the command line and the functions with pycolmap's names on the sample scene and, where it is,
on photographs of ``../shared``, and writes one digest for each kind of result: features, raw
matches, list of pairs, verified pairs, poses and points. Digests are those of one machine with one
set of packages: run this before and after a change, and hold the two files against each other:

    python tests/benchmarks/golden.py before.json
    python tests/benchmarks/golden.py after.json --against before.json

It reads results with h5py, sqlite3 and pycolmap only, so that it also runs on other versions of
the package (``PYTHONPATH``).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap

ROOT = Path(__file__).parents[2]
COURTYARD = ROOT / "sample_scenes" / "courtyard"
SHARED = ROOT.parent / "shared"
FOUNTAIN = SHARED / "scenes" / "strecha_fountain_p11" / "images"
KERMIT = SHARED / "scenes" / "kermit" / "images"
AFFNET = ["--recipe", "affnet-shapes", "--set", "features.descriptor=hardtfeat"]
FEWER = [
    "--set", "rectifier.max_num_rectifications=6", "--set", "features.max_num_features=3000",
    "--set", "features.max_num_rectified_features=6000",
]  # fmt: skip

DROP_IN = """
import sys
import colmap_affrect, pycolmap
database, images, pairs, sparse = sys.argv[1:]
colmap_affrect.extract_features(database, images, camera_mode="SINGLE",
    image_names=["court_1.jpg", "court_2.jpg", "court_3.jpg", "court_4.jpg"])
colmap_affrect.match_image_pairs(database, pairing_options={"match_list_path": pairs})
colmap_affrect.match_exhaustive(database)
options = pycolmap.IncrementalPipelineOptions(min_model_size=2, random_seed=0, num_threads=1)
pycolmap.incremental_mapping(database, images, sparse, options=options)
"""


def digest(*parts: Any) -> str:
    """Hash texts and arrays, with shapes and dtypes."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            found.update(f"{part.shape}{part.dtype}".encode())
            found.update(np.ascontiguousarray(part).tobytes())
        else:
            found.update(str(part).encode())
        found.update(b"\0")
    return found.hexdigest()[:16]


def h5_digest(path: Path) -> str:
    """Digest all datasets of a file, and of which level they are."""
    parts: list[Any] = []

    def add(name: str, item: Any) -> None:
        parts.append(name)
        if isinstance(item, h5py.Dataset):
            parts.append(item[()])
        parts.append(str(item.attrs.get("level", "")))

    with h5py.File(path, "r") as file:
        file.visititems(add)
    return digest(*parts)


def database_digests(path: Path) -> dict[str, str]:
    """Digest keypoints, cameras, raw matches and verified pairs."""
    columns = {
        "cameras": "camera_id, model, width, height, params FROM cameras",
        "keypoints": "image_id, rows, cols, data FROM keypoints",
        "descriptors": "image_id, rows, cols, data FROM descriptors",
        "raw": "pair_id, rows, cols, data FROM matches",
        "verified": "pair_id, rows, cols, data, config FROM two_view_geometries",
    }
    with closing(sqlite3.connect(path)) as connection:
        return {
            key: digest(*connection.execute(f"SELECT {text} ORDER BY 1"))
            for key, text in columns.items()
        }


def models_digest(sparse: Path) -> str:
    """Digest poses, cameras and points of all models."""
    parts: list[Any] = []
    for folder in sorted(path for path in sparse.iterdir() if path.name.isdigit()):
        model = pycolmap.Reconstruction(folder)
        for image_id in sorted(model.reg_image_ids()):
            image = model.images[image_id]
            # Copies: what they are views of is gone with the model
            parts += [image.name, np.array(image.cam_from_world().matrix())]
            parts.append(np.array(image.camera.params))
        points = sorted(tuple(point.xyz.tolist()) for point in model.points3D.values())
        parts.append(np.asarray(points))
    return digest(*parts)


def folder_digests(path: Path) -> dict[str, str]:
    """Digest an output folder."""
    return {
        "features": h5_digest(path / "features.h5"),
        "matches": h5_digest(path / "matches.h5"),
        "pairs": digest((path / "pairs.txt").read_text(encoding="utf-8")),
        **database_digests(path / "database.db"),
        "models": models_digest(path / "sparse"),
    }


def python(*arguments: object) -> None:
    """Run Python, mostly the command line."""
    environment = {**os.environ, "COLMAP_AFFRECT_WEIGHTS": str(SHARED / "weights")}
    line = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        line, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(
            f"{' '.join(line)}: exit code {done.returncode}\n{done.stderr[-2000:]}"
        )


def run_digests(
    work: Path, images: Path, names: list[str], options: list[str]
) -> dict[str, str]:
    """Run on some images of a folder and digest the results."""
    work.mkdir(parents=True)
    listed = work / "names.txt"
    listed.write_text("\n".join(names), encoding="utf-8")
    given = [
        "--image-path",
        images,
        "--image-list-path",
        listed,
        "--output-path",
        work / "out",
    ]
    python("-m", "colmap_affrect", "run", "--quiet", *given, *options)
    return folder_digests(work / "out")


def drop_in_digests(work: Path) -> dict[str, str]:
    """Run the functions with pycolmap's names on four photographs of the courtyard."""
    (work / "sparse").mkdir(parents=True)
    pairs = work / "pairs.txt"
    pairs.write_text("court_1.jpg court_2.jpg\n", encoding="utf-8")
    python("-c", DROP_IN, work / "x.db", COURTYARD / "images", pairs, work / "sparse")
    return {**database_digests(work / "x.db"), "models": models_digest(work / "sparse")}


def interop_digests(work: Path, run: Path) -> dict[str, str]:
    """Export the database of an output folder to hloc's files, and import the folder's own."""
    work.mkdir(parents=True)
    made, own = (
        [
            "--features-path",
            folder / "features.h5",
            "--matches-path",
            folder / "matches.h5",
        ]
        for folder in (work, run)
    )
    command = ("-m", "colmap_affrect")
    python(*command, "export-h5", "-q", "--database-path", run / "database.db", *made)
    given = [
        "--image-path",
        COURTYARD / "images",
        *own,
        "--database-path",
        work / "imported.db",
    ]
    python(*command, "import-h5", "-q", *given)
    exported = {
        f"{kind}-hloc": h5_digest(work / f"{kind}.h5")
        for kind in ("features", "matches")
    }
    return exported | database_digests(work / "imported.db")


Job = tuple[Path, list[str], list[str]]


def jobs() -> dict[str, Job]:
    """Return photographs, names and options of runs by what they are called."""
    court = sorted(path.name for path in COURTYARD.glob("images/*"))
    images = COURTYARD / "images"
    depth = ["--depth-path", str(COURTYARD / "depth")]
    preset = ["--mapper", "incremental", "--database-descriptors", "--preset", "colmap"]
    few = ["--pairs", "retrieval,sequence", "--num-neighbors", "2"]
    rectified = ["--recipe", "rectified"]
    demand = ["--recipe", "on-demand"]
    with_depth = "depth-affnet-recommended"
    found: dict[str, Job] = {
        "courtyard rectified": (images, court, rectified),
        "courtyard on-demand": (images, court, demand),
        f"courtyard {with_depth}": (images, court[:5], ["--recipe", with_depth, *depth]),
        "courtyard depth-planes, incremental mapper, descriptors": (
            images, court, ["--recipe", "depth-planes-recommended", *depth, *preset]
        ),
        "courtyard retrieval, sequence": (images, court, [*few, *rectified]),
    }  # fmt: skip
    if SHARED.is_dir():
        fountain = ["0000.jpg", "0005.jpg", "0010.jpg"]
        kermit = sorted(path.name for path in KERMIT.iterdir())
        found["courtyard affnet-shapes"] = (images, court[:3], AFFNET)
        for name, of in (
            ("fountain", (FOUNTAIN, fountain)),
            ("kermit", (KERMIT, kermit)),
        ):
            found[f"{name} rectified"] = (*of, rectified)
            found[f"{name} on-demand"] = (*of, demand)
            found[f"{name} affnet-shapes"] = (of[0], of[1][:5], [*AFFNET, *FEWER])
    return found


def scenarios(work: Path) -> dict[str, dict[str, str]]:
    """Run everything and return the digests by name."""
    found = {}
    for number, (name, job) in enumerate(jobs().items()):
        start = time.perf_counter()
        found[name] = run_digests(work / str(number), *job)
        sys.stderr.write(f"{name}: {time.perf_counter() - start:.1f} s\n")
    found["drop-in functions"] = drop_in_digests(work / "drop-in")
    found["export and import"] = interop_digests(work / "interop", work / "0" / "out")
    return found


def main() -> int:
    """Write the digests, and tell which of them differ from others."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path, help="file to write")
    parser.add_argument(
        "--against", type=Path, help="file of another version to compare with"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        found = scenarios(Path(work))
    options.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if not options.against:
        return 0
    expected = json.loads(options.against.read_text(encoding="utf-8"))
    different = [
        f"{name}: {kind}"
        for name, digests in expected.items()
        for kind, value in digests.items()
        if found.get(name, {}).get(kind) != value
    ]
    print(
        "\n".join(f"differs: {line}" for line in different)
        or f"{len(expected)} runs: the same"
    )
    return bool(different)


if __name__ == "__main__":
    sys.exit(main())
