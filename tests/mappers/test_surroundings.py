"""Whether what ties photographs is of one place: a poster in two places keeps models apart."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import mapper_of, task_with_given_cameras, write_images
from numpy.typing import NDArray
from wall_scene import (
    WIDTH,
    is_inside,
    posed_model,
    project,
    views,
    wall,
    wall_camera,
)

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.groups import with_places_mapped_again
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.reliability import Confidence
from colmap_affrect.mappers.scored_models import no_surer_than_ties
from colmap_affrect.mappers.surroundings import (
    CLUSTER_SIZE,
    Overlap,
    _Expected,
    _merged,
    _Views,
    known_places,
    places_of,
)
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import DOUBTFUL, Bridge, ModelSummary

NUM_POINTS = 3000
HERE = (1, 2, 3)  # images of one place
THERE = (4, 5, 6)

Bools = NDArray[np.bool_]
Points = NDArray[np.float64]
IsShared = Callable[[Points], Bools]


def poster(points: Points) -> Bools:
    """Points of a print that hangs on the wall."""
    return np.asarray((np.abs(points[:, 0] - 3.5) < 1.2) & (np.abs(points[:, 1]) < 1.0))


def everything(points: Points) -> Bools:
    return np.ones(len(points), bool)


def each_tenth(points: Points) -> Bools:
    """Few matches, all over the wall."""
    return np.asarray(np.arange(len(points)) % 10 == 0)


def scene(path: Path, is_shared: IsShared, collage: int = 0) -> pycolmap.Reconstruction:
    """Write a verified database of six images, and return their model.

    Three see the wall of one place and three that of another one; both see what is shared. A
    collage sees one place in its left half, and the other one in its right half.
    """
    random = np.random.default_rng(2)
    points = wall(random, NUM_POINTS)
    shared = is_shared(points)
    of_first = random.random(NUM_POINTS) < 0.5
    poses = views(6)
    keypoints = {}
    rows = {}  # keypoint of each point, by image
    for image_id, name in enumerate(poses, 1):
        pixels = project(points, poses[name])
        own = of_first if image_id in HERE else ~of_first
        if image_id == collage:
            own = np.where(pixels[:, 0] < WIDTH / 2, of_first, ~of_first)
        seen = np.flatnonzero(is_inside(pixels) & (own | shared))
        keypoints[image_id] = pixels[seen]
        rows[image_id] = {int(point): row for row, point in enumerate(seen)}
    with open_database(path) as database:
        write_images(database, wall_camera(), poses)
        for image_id, pixels in keypoints.items():
            database.write_keypoints(image_id, pixels.astype(np.float32))
        for first, second in combinations(rows, 2):
            common = sorted(rows[first].keys() & rows[second].keys())
            matches = [(rows[first][point], rows[second][point]) for point in common]
            if not common:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = np.array(matches, np.uint32)
            database.write_two_view_geometry(first, second, geometry)
    model = posed_model(path, poses)
    for point, position in enumerate(points):
        seen_by = [image_id for image_id in rows if point in rows[image_id]]
        if len(seen_by) > 1:
            track = pycolmap.Track()
            for image_id in seen_by:
                track.add_element(image_id, rows[image_id][point])
            model.add_point3D(position, track)
    return model


@pytest.mark.parametrize(
    ("is_shared", "places"),
    [
        (poster, [{*HERE}, {*THERE}]),
        (everything, [{*HERE, *THERE}]),
        (each_tenth, [{*HERE, *THERE}]),
    ],
)
def test_a_poster_in_two_places_is_told_from_matches_all_over(
    tmp_path: Path, is_shared: IsShared, places: list[set[int]]
) -> None:
    path = tmp_path / "database.db"
    model = scene(path, is_shared)
    assert places_of(model, PairGraph.read(path)).images == places


def map_as_found(path: Path, mapped: MappedModel) -> list[ModelSummary]:
    """Score and write a model as if a mapper had made it."""
    mapper = mapper_of("sparse")

    def as_found(*_: Any) -> list[MappedModel]:
        return [mapped]

    mapper.map = as_found
    task = task_with_given_cameras(path)
    return map_database(mapper, task, path.with_name("sparse"), lambda _: None)


def nothing(points: Points) -> Bools:
    return np.zeros(len(points), bool)


def test_parts_that_a_collage_alone_ties_are_two_places_and_it_is_doubtful(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    model = scene(path, nothing, collage=3)
    places = places_of(model, PairGraph.read(path))
    assert (places.images, places.collages) == ([{3, *THERE}, {1, 2}], {3})
    (first, *_) = map_as_found(path, MappedModel(model))
    assert first.probabilities["2.jpg"] < DOUBTFUL < first.probabilities["3.jpg"]
    assert first.doubtful["2.jpg"][0].code == "two_places"


def test_bridged_photograph_is_no_surer_than_what_it_hangs_on(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    mapped = MappedModel(scene(path, everything), {"5.jpg": Bridge("4.jpg", 9, 9, 0.1)})
    task = task_with_given_cameras(path)
    ties = {f"{number}.jpg": Confidence(0.3, ()) for number in range(5)}
    alone = {**ties, "5.jpg": Confidence(0.95, ())}
    held = {**alone, "3.jpg": Confidence(0.97, ())}
    found = no_surer_than_ties(alone, mapped, task)
    assert found["5.jpg"].probability == 0.3
    assert found["5.jpg"].reasons[0].code == "hangs_on"
    held_up = no_surer_than_ties(held, mapped, task)
    assert held_up["5.jpg"].probability == 0.95
    assert held_up["3.jpg"].probability == 0.95  # alone sure, it would mean nothing


def test_one_photograph_alone_is_no_surer_than_the_surest_that_ties_it(
    tmp_path: Path,
) -> None:
    """What is sure is where two stand to each other."""
    path = tmp_path / "database.db"
    mapped = MappedModel(scene(path, everything))
    given = {f"{number}.jpg": Confidence(0.1 * number, ()) for number in range(6)}
    given["5.jpg"] = Confidence(0.95, (Doubt("few_matches"),))
    found = no_surer_than_ties(given, mapped, task_with_given_cameras(path))
    assert found["5.jpg"].probability == 0.4
    codes = [doubt.code for doubt in found["5.jpg"].reasons]
    assert codes == ["hangs_on", "few_matches"]
    assert found["5.jpg"].reasons[0].values == {"other": "4.jpg", "percent": 40}
    others = {name: one for name, one in given.items() if name != "5.jpg"}
    assert {name: found[name] for name in others} == others


def test_photograph_hangs_on_what_the_one_it_hangs_on_hangs_on(tmp_path: Path) -> None:
    """Two bridged photographs that tie each other hold up neither."""
    path = tmp_path / "database.db"
    bridges = {f"{i}.jpg": Bridge("3.jpg", 9, 9, 0.1) for i in (4, 5)}
    mapped = MappedModel(scene(path, everything), bridges)
    given = {f"{number}.jpg": Confidence(0.3, ()) for number in range(4)}
    given |= {"4.jpg": Confidence(0.9, ()), "5.jpg": Confidence(0.95, ())}
    found = no_surer_than_ties(given, mapped, task_with_given_cameras(path))
    assert [found[name].probability for name in sorted(found)] == [0.3] * 6
    for name in bridges:
        assert found[name].reasons[0].code == "hangs_on"


def test_two_places_with_one_poster_are_two_models_and_each_says_why(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    models = map_as_found(path, MappedModel(scene(path, poster)))
    assert [one.registered_names for one in models] == [
        ("0.jpg", "1.jpg", "2.jpg"),
        ("3.jpg", "4.jpg", "5.jpg"),
    ]
    apart = models[0].taken_out
    assert sorted(apart) == ["3.jpg", "4.jpg", "5.jpg"]
    assert {doubt.code for doubts in apart.values() for doubt in doubts} == {
        "other_surroundings"
    }


def of_some(model: pycolmap.Reconstruction, image_ids: set[int]) -> MappedModel:
    """A copy of a model with some of its images."""
    found = copy.deepcopy(model)
    for image_id in set(found.reg_image_ids()) - image_ids:
        found.deregister_frame(found.images[image_id].frame_id)
    return MappedModel(found)


def test_places_are_mapped_again_each_by_its_own_pairs_and_without_a_collage(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    model = scene(path, nothing, collage=3)
    asked = list[set[int]]()

    def map_again(graph: PairGraph) -> list[MappedModel]:
        asked.append({image_id for pair in graph.verified for image_id in pair.ids})
        return [of_some(model, asked[-1])]

    found = with_places_mapped_again(
        [MappedModel(model)], PairGraph.read(path), map_again
    )
    assert asked == [{*THERE}, {1, 2}]
    images = [set(mapped.reconstruction.reg_image_ids()) for mapped in found]
    assert images == asked
    why_not = {name: doubt.code for name, doubt in found[0].why_apart.items()}
    assert why_not == {
        "0.jpg": "other_surroundings",
        "1.jpg": "other_surroundings",
        "2.jpg": "two_places",
    }


@pytest.mark.parametrize("registered", [set(), {2}])
def test_models_stay_where_a_place_alone_makes_none_of_most_of_its_photographs(
    tmp_path: Path, registered: set[int]
) -> None:
    path = tmp_path / "database.db"
    whole = MappedModel(scene(path, poster))

    def in_vain(_: PairGraph) -> list[MappedModel]:
        return [of_some(whole.reconstruction, registered)] if registered else []

    (found,) = with_places_mapped_again([whole], PairGraph.read(path), in_vain)
    assert found.reconstruction is whole.reconstruction


def test_a_model_of_one_place_is_not_mapped_again(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    whole = MappedModel(scene(path, everything))

    def never(_: PairGraph) -> list[MappedModel]:
        raise AssertionError

    found = with_places_mapped_again([whole], PairGraph.read(path), never)
    assert [mapped.reconstruction for mapped in found] == [whole.reconstruction]


def test_a_model_that_is_known_to_be_of_one_place_is_looked_at_once(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    whole = MappedModel(scene(path, everything))
    graph = PairGraph.read(path)

    def never(_: PairGraph) -> list[MappedModel]:
        raise AssertionError

    (known,) = with_places_mapped_again([whole], graph, never)
    of_places = MappedModel(scene(tmp_path / "other.db", poster))
    assert known_places(known, graph).images == [{*HERE, *THERE}]
    # What is known is not looked at again: by the poster there would be two places.
    taken_for_known = replace(of_places, one_place_by=graph)
    assert len(known_places(taken_for_known, graph).images) == 1
    other_graph = PairGraph.read(tmp_path / "other.db")
    assert len(known_places(taken_for_known, other_graph).images) == 2


class FoundEverywhere:
    """Says of each image that so many of its expected cells are found."""

    def __init__(self, found: float) -> None:
        self.overlap = Overlap(28.0, found)

    def overlap_with(self, *_: Any) -> Overlap:
        return self.overlap


@pytest.mark.parametrize(
    ("found", "unclear"),
    [(28.0, set()), (17.0, {1, 2}), (22.0, set())],
)
def test_of_parts_that_are_rather_two_places_the_smaller_one_is_unclear(
    found: float, unclear: set[int]
) -> None:
    pairs: Any = [(1, 3), (2, 4)]
    views_of_both: Any = FoundEverywhere(found)
    probabilities = dict[int, float]()
    merged = _merged([{1, 2}, {3, 4, 5}], pairs, views_of_both, probabilities)
    assert merged == [{1, 2, 3, 4, 5}]
    assert set(probabilities) == unclear
    assert all(probability < DOUBTFUL for probability in probabilities.values())


def one_sees(is_found_by_pair: list[Any]) -> Any:
    """What image 1 sees of what images 2, 3, ... do, each with 320 other points."""
    views_of_all = _Views(pycolmap.Reconstruction())
    cells = np.repeat(np.arange(64), 5)
    for number, is_found in enumerate(is_found_by_pair):
        ids = 1000 * number + np.arange(len(cells))
        views_of_all._expectations[number + 2, 1] = _Expected(ids, cells, is_found)
    return views_of_all


def test_what_one_pair_misses_others_find_and_beside_a_statue_none_does() -> None:
    random = np.random.default_rng(0)
    cells = np.repeat(np.arange(64), 5)
    all_over = [random.random(len(cells)) < 0.15 for _ in range(4)]
    of_statue = [(cells < 24) & (random.random(len(cells)) < 0.4) for _ in range(4)]
    sources = [2, 3, 4, 5]
    one_place = one_sees(all_over).overlap_with(1, sources)
    statue = one_sees(of_statue).overlap_with(1, sources)
    assert one_place.num_found > 0.95 * one_place.num_expected
    assert one_place.log_ratio > 1.0
    assert statue.num_found == 24.0
    assert statue.log_ratio < -5.0


def test_few_matches_that_come_together_leave_cells_empty() -> None:
    """Of 64 cells 32 matches in 20 are as many as clusters let expect, and too few else."""
    is_found = np.zeros(320, bool)
    is_found[:100:5] = True
    is_found[1:61:5] = True
    few = one_sees([is_found])
    apart_each = few.overlap_with(1, [2])
    in_clusters = few.overlap_with(1, [2], CLUSTER_SIZE)
    assert in_clusters.num_found == apart_each.num_found == 20.0
    assert in_clusters.num_expected < apart_each.num_expected - 2.0
