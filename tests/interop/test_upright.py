"""Models of runs stand upright by the lines of their photographs, in exports, pages and align."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from exported_model import NAMES, SIZE, write_model, write_photographs
from line_scenes import turn
from numpy.testing import assert_allclose

from colmap_affrect.colmap import pycolmap
from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.lines import DOWN, FOCALS, SHIFTS, LineLikelihood, Lines
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.interop.align import align
from colmap_affrect.interop.export import export
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.record import ModelInputs
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import upright
from colmap_affrect.report.scene import read_view

UP = (
    turn(2, 5.0) @ turn(0, 10.0) @ np.array([0.0, -1.0, 0.0])
)  # in the frame of the model


def lines_that_say(
    up_in_camera: np.ndarray,
    evidence: float = 20.0,
    down: tuple[float, float] = DOWN,
) -> Lines:
    """Lines of which the second of the three directions is upright, for all focal lengths."""
    first = np.cross(up_in_camera, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    rotation = np.stack([first, up_in_camera, np.cross(first, up_in_camera)])
    grid = (len(FOCALS), len(SHIFTS))
    likelihood = LineLikelihood(
        np.full(grid, evidence), np.tile(rotation, (*grid, 1, 1))
    )
    return Lines(Segments(np.zeros((0, 2)), np.zeros((0, 2))), likelihood, down)


def write_run(
    folder: Path, evidence: float = 20.0, *, wrong: int = 1
) -> pycolmap.Reconstruction:
    """An output folder with a model, and with lines of which the first ones are wrong."""
    workspace = Workspace(folder)
    workspace.begin()
    model = write_model(folder / "sparse" / "0")
    store = FeatureStore(workspace.features)
    features = LocalFeatures.empty(8)
    for number, image in sorted(model.images.items()):
        up = image.cam_from_world().rotation.matrix() @ UP
        if number <= wrong:
            up = turn(2, 25.0) @ up
        store.write(image.name, features, SIZE, lines=lines_that_say(up, evidence))
    return model


def exported(folder: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(folder / "text")


def up_of(
    before: pycolmap.Reconstruction, after: pycolmap.Reconstruction
) -> np.ndarray:
    """Where what was up in one model is in the other."""
    old = before.images[1].cam_from_world().rotation.matrix()
    new = after.images[1].cam_from_world().rotation.matrix()
    return np.asarray(new.T @ old @ UP)


def test_exports_of_a_run_have_z_up_and_say_so(tmp_path: Path) -> None:
    before = write_run(tmp_path / "run")
    said = list[str]()
    export(
        tmp_path / "run" / "sparse" / "0", tmp_path / "out", "text", note=said.append
    )
    after = exported(tmp_path / "out")
    assert_allclose(up_of(before, after), [0.0, 0.0, 1.0], atol=1e-6)
    assert said == ["upright     by the lines of 3 of 4 photographs: z is up"]
    ahead = np.mean(
        [image.viewing_direction() for image in after.images.values()], axis=0
    )
    assert ahead[1] > 0.5
    assert abs(ahead[0]) < 1e-6
    for name, old in before.points3D.items():
        assert np.linalg.norm(old.xyz) == pytest.approx(
            np.linalg.norm(after.points3D[name].xyz)
        )
    kept = pycolmap.Reconstruction(tmp_path / "run" / "sparse" / "0")  # is as it was
    assert_allclose(up_of(before, kept), UP, atol=1e-9)


@pytest.mark.parametrize(
    "case", ["contradiction", "by chance", "extends", "no run", "at work"]
)
def test_nothing_is_turned_where_nobody_knows(tmp_path: Path, case: str) -> None:
    folder = tmp_path / "run"
    before = write_run(folder, evidence=2.0 if case == "by chance" else 20.0,
                       wrong=2 if case == "contradiction" else 0)  # fmt: skip
    if case == "extends":
        Workspace(folder).record_mapping(ModelInputs("verified", extends="another"))
    if case == "no run":
        (folder / "features.h5").unlink()
    said = list[str]()
    at_work = Workspace(folder).locked() if case == "at work" else nullcontext()
    with at_work:
        export(folder / "sparse" / "0", tmp_path / "out", "text", note=said.append)
    assert said == []
    assert_allclose(up_of(before, exported(tmp_path / "out")), UP, atol=1e-6)


def test_photographs_that_are_stored_on_their_side_have_their_own_upright(
    tmp_path: Path,
) -> None:
    """As a telephone that is held upright stores them; their EXIF says so."""
    before = write_run(tmp_path / "run", wrong=0)
    store = FeatureStore(tmp_path / "run" / "features.h5")
    up_in_model = turn(2, 90.0) @ UP  # along the x axes of the cameras
    for image in before.images.values():
        up = image.cam_from_world().rotation.matrix() @ up_in_model
        store.write(
            image.name,
            LocalFeatures.empty(8),
            SIZE,
            lines=lines_that_say(up, down=(-1.0, 0.0)),
        )
    export(tmp_path / "run" / "sparse" / "0", tmp_path / "out", "text")
    after = exported(tmp_path / "out")
    old = before.images[1].cam_from_world().rotation.matrix()
    new = after.images[1].cam_from_world().rotation.matrix()
    assert_allclose(new.T @ old @ up_in_model, [0.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(("most", "num_asked"), [(4, 4), (3, 2), (2, 2)])
def test_so_many_photographs_are_asked_for_their_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, num_asked: int
) -> None:
    """Every second one where all are more."""
    model = write_run(tmp_path / "run", wrong=0)
    monkeypatch.setattr(upright, "MAX_NUM_ASKED", most)
    found = upright.upright_of_run(tmp_path / "run" / "sparse" / "0", model)
    assert (found.num_asked if found else 0) == num_asked


def test_a_damaged_store_of_features_keeps_no_model_from_being_exported(
    tmp_path: Path,
) -> None:
    before = write_run(tmp_path / "run")
    (tmp_path / "run" / "features.h5").write_bytes(b"no store")
    export(tmp_path / "run" / "sparse" / "0", tmp_path / "out", "text")
    assert_allclose(up_of(before, exported(tmp_path / "out")), UP, atol=1e-6)


def test_a_distance_gives_the_scale_and_lines_the_upright(tmp_path: Path) -> None:
    before = write_run(tmp_path / "run", wrong=0)
    done = align(tmp_path / "run" / "sparse" / "0", tmp_path / "metric",
                 distances=[(NAMES[0], NAMES[3], 10.0)])  # fmt: skip
    after = pycolmap.Reconstruction(tmp_path / "metric")
    assert_allclose(up_of(before, after), [0.0, 0.0, 1.0], atol=1e-6)
    centers = {image.name: image.projection_center() for image in after.images.values()}
    assert np.linalg.norm(centers[NAMES[0]] - centers[NAMES[3]]) == pytest.approx(10.0)
    assert "upright     by the lines of 4 of 4 photographs: z is up" in done.summary()


def test_the_page_and_instant_ngp_have_the_same_upright(tmp_path: Path) -> None:
    before = write_run(tmp_path / "run", wrong=0)
    view = read_view(tmp_path / "run" / "sparse" / "0", {})
    drawn = np.array([corners[0] for _, corners in view.cameras])
    centers = np.array(
        [before.images[n].projection_center() for n in sorted(before.images)]
    )
    scale = np.linalg.norm(drawn[3] - drawn[0]) / np.linalg.norm(
        centers[3] - centers[0]
    )
    assert_allclose(
        (drawn - drawn[0])[:, 2] / scale, (centers - centers[0]) @ UP, atol=1e-6
    )
    write_photographs(tmp_path / "photos")
    export(tmp_path / "run" / "sparse" / "0", tmp_path / "out", "nerfstudio",
           image_path=tmp_path / "photos")  # fmt: skip
    content = json.loads((tmp_path / "out" / "dense" / "transforms.json").read_text())
    assert content["up"] == [0.0, 0.0, 1.0]
