"""What mappers promise: of four photographs whose cameras are given."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from contracts.contracts import Contract
from small_scene import INTRINSICS, NAMES, place_of, world_to_camera

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import (
    Pose,
    model_poses,
    pose_errors,
    relative_pose,
)
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.mappers.base import (
    MAPPERS,
    MappedModel,
    Mapper,
    MapperOptions,
    MappingTask,
)
from colmap_affrect.mappers.mapping import map_database

POSE_DEG = 3.0


class MapperContract(Contract):
    """Of a mapper."""

    def options(self) -> MapperOptions:
        """Return the options of the mapper under test."""
        raise NotImplementedError

    def make(self) -> Mapper:
        return self.make_with(self.options())

    def make_with(self, options: MapperOptions) -> Mapper:
        """Return the mapper under test with other options."""
        return MAPPERS.make(options)

    def test_mapper_registers_tells_of_it_and_keeps_given_cameras(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        shown: list[int] = []
        before = rows_digest(task.database_path)
        models = map_database(self.make(), task, tmp_path / "sparse", shown.append)
        assert [model.registered_names for model in models] == [tuple(sorted(NAMES))]
        assert sum(shown) == len(NAMES), (
            "the mapper has to show how many images its model has so far, all of them in the end"
        )
        assert [path.name for path in tmp_path.iterdir()] == ["sparse"]
        assert rows_digest(task.database_path) == before, (
            "a mapper may not change the database"
        )
        written = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
        (camera,) = written.cameras.values()
        given = [float(value) for value in INTRINSICS.split(",")]
        assert camera.params.tolist() == given, "a given camera has changed"

    def test_mapper_finds_poses_and_points_also_of_two_views(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        (mapped, *_) = self.make().map(task, tmp_path, 0, lambda _: None)
        model = mapped.reconstruction
        poses = model_poses(model)
        for first, second in combinations(NAMES, 2):
            errors = pose_errors(
                relative_pose(poses[first], poses[second]),
                relative_pose(pose_of(first), pose_of(second)),
            )
            assert max(errors) < POSE_DEG, (
                f"{first} and {second} are wrong by {errors} degrees; poses are camera from world"
            )
        if mapped.add_last_points:
            mapped.add_last_points(model)
        lengths = [point.track.length() for point in model.points3D.values()]
        assert lengths, "a model without points"
        assert min(lengths) == 2, (
            "no point of two views: ignore_two_view_tracks, an option of all mappers, is off"
        )

    def test_mapper_passes_options_on(self, task: MappingTask, tmp_path: Path) -> None:
        """No pair has so many matches."""
        given = self.options().changed(mapper_options={"min_num_matches": "100000"})
        mapper = self.make_with(given)
        assert mapper.options.mapper_options == {"min_num_matches": 100_000}, (
            "mapper_options of a mapper have pycolmap's full keys and types"
        )
        found: list[MappedModel] = []
        with suppress(AffrectError):
            found = mapper.map(task, tmp_path, 0, lambda _: None)
        assert found == [], "mapper_options are not passed on to COLMAP"

    def test_mapper_has_presets_and_refuses_unknown_options(self) -> None:
        options = self.options().changed(random_seed=5, mapper_options={})
        colmap = type(options).preset("colmap")
        assert (colmap.preset_name, options.preset_name) == ("colmap", "sparse")
        with pytest.raises(OptionError, match="no such option"):
            self.make_with(options.changed(mapper_options={"nonsense": 1}))

    def test_mapper_makes_no_model_or_says_why_where_no_pair_is_verified(
        self, unmatched_task: MappingTask, tmp_path: Path
    ) -> None:
        found: list[MappedModel] = []
        with suppress(AffrectError):
            found = self.make().map(unmatched_task, tmp_path, 0, lambda _: None)
        assert found == []

    def test_mapper_that_is_stopped_raises_and_leaves_no_model(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        token = pycolmap.CancellationToken()
        token.cancel()
        stopped = replace(task, cancellation=token)
        with pytest.raises(KeyboardInterrupt):
            map_database(self.make(), stopped, tmp_path / "sparse", lambda _: None)
        assert not (tmp_path / "sparse").exists()

    @pytest.mark.long
    def test_mapper_makes_the_same_model_in_two_threads_at_once(
        self, task: MappingTask, tmp_path: Path
    ) -> None:
        """Neither is the main one, which alone may handle signals."""
        mapper = self.make()

        def poses(number: int) -> dict[str, list[float]]:
            folder = tmp_path / str(number)
            folder.mkdir()
            (model, *_) = mapper.map(task, folder, 0, lambda _: None)
            return poses_by_name(model.reconstruction)

        with ThreadPoolExecutor(2) as threads:
            first, second = threads.map(poses, (1, 2))
        assert first.keys() == set(NAMES)
        assert first == second


def pose_of(name: str) -> Pose:
    """Return the true pose of a photograph of the small scene, camera from world."""
    position, yaw_deg = place_of(NAMES.index(name))
    rotation = world_to_camera(yaw_deg)
    return rotation, -rotation @ np.array(position)


def poses_by_name(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    """Return the matrix of each registered image in one row."""
    found = {}
    for image in model.images.values():
        if image.has_pose:
            found[image.name] = image.cam_from_world().matrix().ravel().tolist()
    return found
