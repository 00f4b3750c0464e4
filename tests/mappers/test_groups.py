"""Groups of photographs that match only each other: each becomes a model."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.mapping import map_database

FIRST = {1, 2, 3, 4, 5}
SECOND = {6, 7, 8}


def keep_groups(path: Path, *groups: set[int]) -> None:
    """Delete the pairs between groups; of all but the first one each second inlier stays."""
    with open_database(path) as database:
        for ids in combinations(sorted(set.union(*groups)), 2):
            group = next((one for one in groups if one >= {*ids}), set())
            geometry = database.read_two_view_geometry(*ids)
            database.delete_two_view_geometry(*ids)
            if group == groups[0]:
                database.write_two_view_geometry(*ids, geometry)
            elif group:
                geometry.inlier_matches = geometry.inlier_matches[::2]
                database.write_two_view_geometry(*ids, geometry)


def sizes_of_models(path: Path) -> list[int]:
    models = map_database(
        mapper_of("sparse"),
        task_with_given_cameras(path),
        path.parent / "sparse",
        lambda _: None,
    )
    return [len(model.registered_names) for model in models]


def test_a_weaker_group_of_three_is_a_model_too(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=8, num_points3D=100)
    keep_groups(path, FIRST, SECOND)
    assert sizes_of_models(path) == [5, 3]
