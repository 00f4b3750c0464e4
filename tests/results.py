"""What a run left in its output folder, in a form that can be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.workspace import Workspace


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
    """Keypoints by image, matches and inlier matches by pair."""
    names = {image_id: name for name, image_id in image_ids(path).items()}
    with open_database(path) as database:
        pair_ids, geometries = database.read_two_view_geometries()
        return {
            "keypoints": {names[i]: database.read_keypoints(i).tobytes() for i in names},
            "raw matches": {
                tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id)): len(rows)
                for pair_id, rows in zip(*database.read_all_matches(), strict=True)
            },
            "inliers": {
                tuple(names[i] for i in pycolmap.pair_id_to_image_pair(pair_id)): (
                    geometry.inlier_matches.tolist()
                )
                for pair_id, geometry in zip(pair_ids, geometries, strict=True)
            },
        }


def model_names(workspace: Workspace) -> list[list[str]]:
    """Names of the registered images of every model in sparse/."""
    models = [pycolmap.Reconstruction(path) for path in sorted(workspace.sparse.glob("[0-9]*"))]
    return [
        sorted(model.images[image_id].name for image_id in model.reg_image_ids())
        for model in models
    ]
