"""Tasks of mappers whose cameras are given or not, and databases to map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.camera_priors import camera_priors
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.principal_points import with_free_principal_points
from colmap_affrect.mappers.search import Search
from colmap_affrect.session.view_graph import ViewGraph

SEED = 3

WHOLE = CameraRecord(
    ("a",), "given", 1300.0, size=(1024, 768), given=("focal", "distortion")
)
"""All of a camera is given."""

NOTHING_KNOWN = MappingTask(Path("database.db"), None)
ALL_GIVEN = MappingTask(Path("database.db"), None, cameras={1: WHOLE})


def task_with_given_cameras(database_path: Path, **values: Any) -> MappingTask:
    """Return a task for a database whose cameras are all given."""
    cameras = {
        camera.camera_id: WHOLE for camera in ViewGraph(database_path).cameras.values()
    }
    return MappingTask(database_path, database_path.parent, cameras=cameras, **values)


def mapper_of(name: str, **options: Any) -> Any:
    return MAPPERS.make(MAPPERS.options({"name": name, "random_seed": SEED, **options}))


def synthesize(
    path: Path, *, seed: int = SEED, noise_px: float = 0.0, **options: Any
) -> pycolmap.Reconstruction:
    """Let COLMAP make a verified database, with options of its own; return the truth.

    There is one frame a rig unless another number is asked for.
    """
    given = pycolmap.SyntheticDatasetOptions(**{"num_frames_per_rig": 1, **options})
    pycolmap.set_random_seed(seed)
    with open_database(path) as database:
        truth = pycolmap.synthesize_dataset(given, database)
        if noise_px:
            noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=noise_px)
            pycolmap.synthesize_noise(noise, truth, database)
    return truth


def write_images(
    database: pycolmap.Database, camera: pycolmap.Camera, names: Iterable[str]
) -> None:
    """Write a camera, and images of it with ids from 1 on, each a frame of one rig."""
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig_id = database.write_rig(rig)
    for image_id, name in enumerate(names, 1):
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=image_id)
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame(rig_id=rig_id, frame_id=image_id)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)


def searches_with_axes(
    path: Path, records: Mapping[int, CameraRecord]
) -> tuple[Search, Search]:
    """Return a search with constant principal points, and the same with free ones."""
    task = MappingTask(path, None, cameras=records)
    graph = PairGraph.read(path)
    native = mapper_of("sparse").native(task, 0)
    priors = camera_priors(graph.cameras.values(), task.cameras, {})
    adjuster = Adjuster(priors, 0.7, native.get_global_bundle_adjustment())
    constant = Search(adjuster, ModelScorer(graph, priors), native, 6, lambda _: None)
    free = with_free_principal_points(constant, task.cameras)
    assert free is not None
    return constant, free
