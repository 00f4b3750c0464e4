"""Groups of photographs that match only each other: each becomes a model."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mapping_tasks import mapper_of, synthesize, task_with_given_cameras

from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.groups import with_other_groups
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


@pytest.mark.parametrize("is_strong", [False, True])
def test_a_group_is_mapped_by_pairs_inside_of_it_alone(*, is_strong: bool) -> None:
    """Images 1 to 3 have a model; a pair ties 3 and 4, perhaps among the strongest."""
    inside = [SimpleNamespace(ids=ids) for ids in ((4, 5), (4, 6), (5, 6))]
    others = [SimpleNamespace(ids=ids) for ids in ((1, 2), (2, 3))]
    across = SimpleNamespace(ids=(3, 4))
    left_out = list[list[tuple[int, int]]]()
    graph = SimpleNamespace(
        pairs=[*inside, *others, *([across] if is_strong else [])],
        verified=[*inside, *others, across],
        without=left_out.append,
    )
    search: Any = SimpleNamespace(graph=graph, best=lambda _: [])
    known: Any = SimpleNamespace(
        reconstruction=SimpleNamespace(reg_image_ids=lambda: [1, 2, 3])
    )
    assert with_other_groups(search, [known]) == [known]
    assert left_out == [[(1, 2), (2, 3), (3, 4)]]
