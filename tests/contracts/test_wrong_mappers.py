"""The contract of mappers finds what it is for: each of these is wrong in one way, and fails."""

from __future__ import annotations

import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from contracts.mapper_contract import MapperContract

from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.base import (
    MAPPERS,
    MappedModel,
    Mapper,
    MapperOptions,
    MappingTask,
)


class Incremental:
    """COLMAP's incremental mapper, for others to change what it does."""

    def __init__(self) -> None:
        self.right = MAPPERS.make(MAPPERS.options("incremental"))
        self.options = self.right.options

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        return self.right.map(task, *others)


class MovesCameras(Incremental):
    """Changes cameras that are given."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        for camera in models[0].reconstruction.cameras.values():
            camera.params = [*camera.params[:-1], camera.params[-1] + 0.01]
        return models


class GivesWorldFromCamera(Incremental):
    """Poses are the wrong way round."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        for frame in models[0].reconstruction.frames.values():
            frame.rig_from_world = frame.rig_from_world.inverse()
        return models


class ChangesTheDatabase(Incremental):
    """Forgets what it has used."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        with open_database(task.database_path) as database:
            database.clear_matches()
        return models


class WithoutTracksOfTwoViews(Incremental):
    """Does not look at an option."""

    def __init__(self) -> None:
        options = MAPPERS.options("incremental").changed(ignore_two_view_tracks=True)
        self.right = MAPPERS.make(options)
        self.options = MAPPERS.options("incremental")


class ForgetsOptions(Incremental):
    """Does not pass options on."""

    def __init__(self, options: MapperOptions) -> None:
        super().__init__()
        values = {key: int(value) for key, value in options.mapper_options.items()}
        self.options = options.changed(mapper_options=values)


class NeverStops(Incremental):
    """Does not look at the token."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        task = replace(task, cancellation=None)
        return super().map(task, *others)


class FailsAsItLikes(Incremental):
    """Does not expect that there may be no model."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        models = super().map(task, *others)
        return [models[0]]


class HandlesSignals(Incremental):
    """Works in the main thread alone."""

    def map(self, task: MappingTask, *others: Any) -> list[MappedModel]:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return super().map(task, *others)


class OneMapper(MapperContract):
    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper

    def options(self) -> MapperOptions:
        return MAPPERS.options("incremental")

    def make(self) -> Mapper:
        return self.mapper


class OneForgetful(OneMapper):
    def make_with(self, options: MapperOptions) -> Mapper:
        return ForgetsOptions(options)


def test_mapper_that_moves_given_cameras_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(MovesCameras())
    with pytest.raises(AssertionError, match="a given camera has changed"):
        contract.test_mapper_registers_tells_of_it_and_keeps_given_cameras(
            task, tmp_path
        )


def test_mapper_whose_poses_are_the_wrong_way_round_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(GivesWorldFromCamera())
    with pytest.raises(AssertionError, match="poses are camera from world"):
        contract.test_mapper_finds_poses_and_points_also_of_two_views(task, tmp_path)


def test_mapper_that_leaves_out_tracks_of_two_views_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(WithoutTracksOfTwoViews())
    with pytest.raises(AssertionError, match="no point of two views"):
        contract.test_mapper_finds_poses_and_points_also_of_two_views(task, tmp_path)


def test_mapper_that_changes_the_database_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    path = tmp_path / "database.db"
    shutil.copy(task.database_path, path)
    contract = OneMapper(ChangesTheDatabase())
    folder = tmp_path / "models"
    folder.mkdir()
    with pytest.raises(AssertionError, match="may not change the database"):
        contract.test_mapper_registers_tells_of_it_and_keeps_given_cameras(
            replace(task, database_path=path, graphs={}), folder
        )


def test_mapper_that_forgets_options_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneForgetful(Incremental())
    with pytest.raises(AssertionError, match="are not passed on to COLMAP"):
        contract.test_mapper_passes_options_on(task, tmp_path)


def test_mapper_that_does_not_stop_is_found(task: MappingTask, tmp_path: Path) -> None:
    contract = OneMapper(NeverStops())
    with pytest.raises(pytest.fail.Exception, match="DID NOT RAISE"):
        contract.test_mapper_that_is_stopped_raises_and_leaves_no_model(task, tmp_path)


def test_mapper_that_fails_by_errors_of_its_own_is_found(
    unmatched_task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(FailsAsItLikes())
    with pytest.raises(IndexError):
        contract.test_mapper_makes_no_model_or_says_why_where_no_pair_is_verified(
            unmatched_task, tmp_path
        )


def test_mapper_for_the_main_thread_alone_is_found(
    task: MappingTask, tmp_path: Path
) -> None:
    contract = OneMapper(HandlesSignals())
    with pytest.raises(ValueError, match="signal only works in main thread"):
        contract.test_mapper_makes_the_same_model_in_two_threads_at_once(task, tmp_path)
