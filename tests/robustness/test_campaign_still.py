"""Campaign (tests/campaign.py): what never moves is left out, and what is true is kept.

A box turns before a still camera and a still background; or a camera goes round it, which looks the
same but for the background.
"""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from campaign import CAMPAIGN, PLAIN, Words
from command import Call
from numpy.typing import NDArray
from results import hdf5_content
from synthetic import texture, write_image

from colmap_affrect.colmap.model_files import read_poses
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.match_store import MatchStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.stationary import StationaryFilter

pytestmark = CAMPAIGN

SIZE = (480, 360)
FOCAL_PX = 700.0
DISTANCE = 4.0
TEXTURE_PX = 240
HALF = np.array([0.65, 0.8, 0.65])  # of the box, along its axes
STEP_DEG = 12.0
NUM_VIEWS = 4
CAMERA = [
    "--camera-mode", "single", "--camera-model", "PINHOLE",
    "--camera-params", f"{FOCAL_PX},{FOCAL_PX},{SIZE[0] / 2},{SIZE[1] / 2}",
]  # fmt: skip
KEEP_ALL = ["--set", "matching.filter_stationary_matches=false"]


def turn(degrees: float) -> NDArray[np.float64]:
    """Return the rotation about the upright axis."""
    cosine = np.cos(np.deg2rad(degrees))
    sine = np.sin(np.deg2rad(degrees))
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def photograph(
    degrees: float, behind: NDArray[np.uint8], number: int
) -> NDArray[np.uint8]:
    """Render the box, turned, before a background, with noise of its own."""
    image = behind.copy()
    for side in range(4):
        rotation = turn(degrees + 90.0 * side)
        square = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]]) * HALF
        corners = square @ rotation.T + (0.0, 0.0, DISTANCE)
        if rotation[:, 2] @ corners[0] <= 0.0:  # seen from behind
            continue
        projected = (
            FOCAL_PX * corners[:, :2] / corners[:, 2:] + np.array(SIZE) / 2 - 0.5
        )
        ends = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (TEXTURE_PX - 1)
        mapping = cv2.getPerspectiveTransform(np.float32(ends), np.float32(projected))
        drawn = texture((TEXTURE_PX, TEXTURE_PX), 50 + side)
        cv2.warpPerspective(
            drawn, mapping, SIZE, dst=image, borderMode=cv2.BORDER_TRANSPARENT
        )
    noise = np.random.default_rng(number).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def write_views(folder: Path, behind: NDArray[np.uint8]) -> Words:
    """Write photographs of the box; return the arguments of a run."""
    folder.mkdir()
    for number in range(NUM_VIEWS):
        degrees = 45.0 + STEP_DEG * (number - 1.5)
        write_image(folder / f"{number}.png", photograph(degrees, behind, number))
    return ["run", "--image-path", folder, *PLAIN, *CAMERA, "--no-page"]


def test_box_before_a_still_camera_is_registered_by_what_turns(
    tmp_path: Path, call: Call
) -> None:
    words = write_views(tmp_path / "photos", texture(SIZE, 7))
    out = tmp_path / "out"
    done = call(*words, "--output-path", out, "--json", "-q")
    assert done.code == 0, done
    assert len(done.report["registered_names"]) == NUM_VIEWS
    log = Workspace(out).log.read_text(encoding="utf-8")
    assert (
        "pairs never move (a caption, a frame, a watermark, or the background of some"
        in log
    )
    poses = read_poses(out / "sparse" / "0")
    for first, second in pairwise(sorted(poses)):
        between = poses[second][0] @ poses[first][0].T
        found_deg = np.rad2deg(np.arccos((np.trace(between) - 1.0) / 2.0))
        assert found_deg == pytest.approx(STEP_DEG, abs=1.0)


def test_camera_that_goes_round_a_box_loses_no_match(
    tmp_path: Path, call: Call
) -> None:
    plain = np.full(SIZE[::-1], 128, np.uint8)
    words = write_views(tmp_path / "photos", plain)
    workspace = Workspace(tmp_path / "out")
    done = call(*words, *KEEP_ALL, "--output-path", workspace.path, "--json", "-q")
    assert done.code == 0, done
    assert len(done.report["registered_names"]) == NUM_VIEWS
    matches = MatchStore(workspace.matches)
    before = hdf5_content(workspace.matches)
    pairs = list(combinations(done.report["registered_names"], 2))
    assert (
        StationaryFilter(FeatureStore(workspace.features), matches).learn(pairs) == []
    )
    assert hdf5_content(workspace.matches) == before
