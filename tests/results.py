"""What runs leave in folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.project.workspace import Workspace


def results(out: Path) -> dict[str, Any]:
    """Features, matches, geometries and registered images of a finished run.

    Images go by their names: COLMAP's ids follow the order in which they came.
    """
    workspace = Workspace(out)
    report = json.loads(workspace.report.read_text(encoding="utf-8"))
    return {
        "features": hdf5_content(workspace.features),
        "matches": hdf5_content(workspace.matches),
        "pairs": workspace.pairs.read_text(encoding="utf-8"),
        **database_content(workspace.database),
        "registered": report["registered_names"],
        "models": model_names(workspace),
        "points": report["points3D"],
    }


def hdf5_content(path: Path) -> dict[str, tuple[str, bytes]]:
    """Type and bytes of all datasets of a file by key."""
    content = {}

    def collect(key: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            content[key] = (f"{item.dtype}{item.shape}", item[()].tobytes())

    with h5py.File(path, "r") as file:
        file.visititems(collect)
    return content


def database_content(path: Path) -> dict[str, Any]:
    """Keypoints by image, numbers of raw matches and inlier matches by pair."""
    names = {image_id: name for name, image_id in image_ids(path).items()}

    def pair(pair_id: int) -> tuple[str, ...]:
        return tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id))

    with open_database(path) as database:
        raw = zip(*database.read_all_matches(), strict=True)
        geometries = zip(*database.read_two_view_geometries(), strict=True)
        return {
            "keypoints": {
                names[i]: database.read_keypoints(i).tobytes() for i in names
            },
            "raw matches": {pair(key): len(rows) for key, rows in raw},
            "inliers": {
                pair(key): found.inlier_matches.tolist() for key, found in geometries
            },
        }


def model_names(workspace: Workspace) -> list[list[str]]:
    """Names of the registered images of every model in sparse/."""
    models = [
        pycolmap.Reconstruction(path)
        for path in sorted(workspace.sparse.glob("[0-9]*"))
    ]
    return [
        sorted(model.images[i].name for i in model.reg_image_ids()) for model in models
    ]


def tree(
    folder: Path, *without: Path, times: bool = True
) -> dict[str, tuple[object, ...]]:
    """What is in a folder, by its path there: files by digest and time; links are not followed."""
    found: dict[str, tuple[object, ...]] = {}
    for path in folder.rglob("*"):
        if any(path.is_relative_to(other) for other in without):
            continue
        key = str(path.relative_to(folder))
        if path.is_symlink():
            found[key] = ("link", str(path.readlink()))
        elif path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[key] = (digest, path.stat().st_mtime_ns) if times else (digest,)
        else:
            found[key] = ("folder",)
    return found


def differences(before: Mapping[str, object], after: Mapping[str, object]) -> list[str]:
    """What was made, changed or removed between two looks at a folder."""
    said = {(False, True): "made", (True, False): "removed", (True, True): "changed"}
    keys = sorted(before.keys() | after.keys())
    return [
        f"{said[key in before, key in after]} {key!r}"
        for key in keys
        if before.get(key) != after.get(key)
    ]
