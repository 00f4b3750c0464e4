"""Where view cameras have their axes, and how far rotations change with free ones."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers import principal_points
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import (
    CameraPrior,
    camera_priors,
    shifted_principal_point,
    usual_principal_point,
)
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.principal_points import (
    _only_up_and_down,
    gains_of_freedom,
    median_turns_deg,
    with_free_principal_points,
)
from colmap_affrect.mappers.search import Search

# Of axes from the middle, px of images of 1024 x 768: right and down
OFFSETS_PX = np.array([[150, -40], [-90, 120], [30, 160], [-160, -60]], float)


def test_view_cameras_shift_up_and_down_as_prints_and_are_in_the_middle_across(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    free = CameraPrior(900.0, 0.3, shifted_principal_point(camera))
    search: Any = SimpleNamespace(
        adjuster=SimpleNamespace(priors={1: free}),
        graph=SimpleNamespace(cameras={7: camera}),
    )
    monkeypatch.setattr(principal_points, "_with_priors", lambda _, priors: priors)
    priors: Any = _only_up_and_down(search, {1})
    point = priors[1].principal_point
    assert point.center_px == (500.0, 350.0)
    across_px, down_px = point.sigmas_px
    assert across_px == usual_principal_point(camera).sigmas_px[0]
    assert down_px == shifted_principal_point(camera).sigmas_px[1]
    assert across_px < down_px
    assert _only_up_and_down(search, set()) == {1: free}


def model_of(turns: dict[int, pycolmap.Rotation3d]) -> pycolmap.Reconstruction:
    """Return a model of images with rotations."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 900.0, 1000, 700)
    model.add_camera_with_trivial_rig(camera)
    for image_id, turn in turns.items():
        image = pycolmap.Image(f"{image_id}.jpg", np.zeros((0, 2)), 1, image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, np.ones(3)))
    return model


def test_an_image_turns_as_the_median_of_its_rotations_to_the_others_does() -> None:
    """The frame of the changed model is another one, and one of four images has turned."""
    turns = {}
    for image_id in range(1, 5):
        axis = np.array([0.3, -0.2, 0.1]) * image_id + np.array([0.0, 0.5, -0.4])
        turns[image_id] = pycolmap.Rotation3d(axis)
    frame = pycolmap.Rotation3d(np.array([0.7, 0.2, -0.9]))
    changed = {image_id: turn * frame for image_id, turn in turns.items()}
    ten_deg = pycolmap.Rotation3d(np.deg2rad([0.0, 6.0, 8.0]))
    changed[4] = ten_deg * changed[4]
    found = median_turns_deg(model_of(turns), model_of(changed))
    expected = {"1.jpg": 0.0, "2.jpg": 0.0, "3.jpg": 0.0, "4.jpg": 10.0}
    assert found == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("share", "contradict"), [(0.15, False), (1.0, True)])
def test_axes_of_whole_photographs_are_not_just_in_the_middle(
    tmp_path: Path, share: float, *, contradict: bool
) -> None:
    """Off by up to two per cent they move points by many deviations, and are usual."""
    path = tmp_path / "database.db"
    truth = synthesize(
        path,
        num_rigs=len(OFFSETS_PX),
        num_points3D=200,
        noise_px=0.4,
        camera_params=[900.0, 512.0, 384.0, 0.0],
    )
    for image in truth.images.values():
        for point in image.points2D:
            point.xy = point.xy + share * OFFSETS_PX[image.image_id - 1]
    unknown = CameraRecord(("a",), "guess", 1200.0, size=(1024, 768))
    records = dict.fromkeys(truth.cameras, unknown)
    graph = PairGraph.read(path)
    native = mapper_of("sparse").native(MappingTask(path, None, cameras=records), 0)
    priors = camera_priors(graph.cameras.values(), records, {})
    adjuster = Adjuster(priors, 0.7, native.get_global_bundle_adjustment())
    constant = Search(adjuster, ModelScorer(graph, priors), native, 6, lambda _: None)
    free = with_free_principal_points(constant, records)
    assert free is not None
    gains = gains_of_freedom(truth, constant, free)
    assert gains.num_freed == len(OFFSETS_PX)
    assert gains.contradict_constant == contradict
