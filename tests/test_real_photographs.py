"""The claims of BENCHMARKS.md on real photographs in ../shared, which the project does not hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from registration import compare_subset

SCENES = Path(__file__).parents[2] / "shared" / "scenes"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="the photographs of ../shared are not here"),
]


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
    result = compare_subset(name, SCENES, tmp_path, [recipe], 5)["methods"][recipe]
    scores = [seed["scores"] for seed in result["seeds"]]
    assert sum(len(score["correct_names"]) >= min_correct for score in scores) >= 4
    errors = sorted(score["median_rotation_error_deg"] for score in scores)
    assert errors[2] < median_error_deg


def test_peak_memory_of_extraction_stays_under_1500_mb_on_12_megapixels(tmp_path):
    source = SCENES / "strecha_herz_jesus_p25" / "images" / "0008.jpg"
    image = cv2.resize(cv2.imread(str(source)), (4000, 3000), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "large.jpg"), image)
    script = (
        "import sys; from pathlib import Path\n"
        "from colmap_affrect.parallel.executor import peak_memory_bytes\n"
        "from colmap_affrect.stages.one_image import prepare\n"
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
