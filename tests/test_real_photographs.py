"""The claims of the README on real photographs in ../shared, which the project does not hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from registration import (
    SUBSETS,
    camera_options,
    compute_matches,
    link_images,
    read_true_poses,
    run_seed,
)

from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import inlier_matches, verify
from colmap_affrect.comparison.methods import parse_method
from colmap_affrect.extraction import Resources
from colmap_affrect.options import CameraOptions, VerificationOptions

SCENES = Path(__file__).parents[2] / "shared" / "scenes"
SUBSET_BY_NAME = {subset.name: subset for subset in SUBSETS}

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="the photographs of ../shared are not here"),
]


def correct_by_seed(recipe, name, tmp_path, num_seeds):
    subset = SUBSET_BY_NAME[name]
    cameras = camera_options(subset, SCENES)
    images = tmp_path / "images"
    link_images(subset.image_paths(SCENES), images)
    folder = tmp_path / "work"
    folder.mkdir()
    compute_matches(parse_method(recipe), cameras, images, folder, Resources())
    truth = read_true_poses(SCENES / subset.scene)
    return [run_seed(folder, images, cameras, truth, seed) for seed in range(num_seeds)]


@pytest.mark.parametrize(
    ("recipe", "name", "min_correct", "median_error_deg"),
    [
        ("default", "fountain 0,5,10", 3, 0.5),
        ("default", "herz 0,8,16,24", 4, 0.5),
        ("default", "kermit /2", 6, 2.0),
        ("default", "sacre_coeur /2", 5, 2.0),
        ("on-demand", "herz 0,8,16,24", 4, 0.5),
    ],
)
def test_sparse_subset_registers_correctly(recipe, name, min_correct, median_error_deg, tmp_path):
    rows = correct_by_seed(recipe, name, tmp_path, num_seeds=5)
    assert sum(row["correct"] >= min_correct for row in rows) >= 4
    errors = sorted(row["rotation_error_deg"] for row in rows)
    assert errors[2] < median_error_deg


def count_distinct_inliers(database_path):
    """Count matches by their places: of a place with two orientations COLMAP counts both."""
    matches = inlier_matches(database_path, 1)
    with open_database(database_path) as database:
        points = {
            image.image_id: np.asarray(database.read_keypoints(image.image_id))[:, :2]
            for image in database.read_all_images()
        }
    return sum(
        len(np.unique(np.hstack([points[first][rows[:, 0]], points[second][rows[:, 1]]]), axis=0))
        for (first, second), rows in matches.items()
    )


@pytest.mark.parametrize("scene", ["strecha_fountain_p11", "strecha_herz_jesus_p25", "kermit"])
def test_photographs_taken_close_together_match_in_as_many_places_as_with_sift(scene, tmp_path):
    images = tmp_path / "images"
    link_images(sorted((SCENES / scene / "images").iterdir())[:3], images)
    counts = {}
    for label in ("sift", "default"):
        folder = tmp_path / label
        folder.mkdir()
        compute_matches(parse_method(label), CameraOptions(), images, folder, Resources())
        verify(folder / "database.db", VerificationOptions(), 0)
        counts[label] = count_distinct_inliers(folder / "database.db")
    assert counts["default"] >= counts["sift"] > 100


def test_peak_memory_of_extraction_stays_under_1500_mb_on_12_megapixels(tmp_path):
    source = SCENES / "strecha_herz_jesus_p25" / "images" / "0008.jpg"
    image = cv2.resize(cv2.imread(str(source)), (4000, 3000), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "large.jpg"), image)
    script = (
        "import sys; from pathlib import Path\n"
        "from colmap_affrect.executor import peak_memory_bytes\n"
        "from colmap_affrect.extraction import prepare\n"
        "from colmap_affrect.recipes import load_recipe\n"
        "extracted = prepare(load_recipe('default').extraction).extract_file(Path(sys.argv[1]))\n"
        "assert extracted.image_size == (4000, 3000) and len(extracted.features) > 5000\n"
        "print(peak_memory_bytes() // 1024)\n"
    )
    output = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "large.jpg")],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert 200_000 < int(output) < 1_500_000
