"""The scripts beside the recipes and the notebook do what their pages in docs/ say."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_scene import FOCAL_PX, IMAGE_SIZE, NAMES, write_photographs

from colmap_affrect.images.masks import read_mask

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"

FAKE_CLUSTER = """
class Cluster:
    scheduler_address = "tcp://there:8786"
    def __init__(self, **options): pass
    def __enter__(self): return self
    def __exit__(self, *error): pass
    def scale(self, jobs): pass
    def wait_for_workers(self, count): pass

SLURMCluster = KubeCluster = Cluster

def make_cluster_spec(**options):
    return {"spec": {part: {"spec": {"containers": [{}]}} for part in ("scheduler", "worker")}}
"""


def run_script(*arguments: object, **options: object) -> str:
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.long
def test_script_with_the_features_replaced_registers_the_scene(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos")
    script = RECIPES / "replace-sift" / "reconstruct.py"
    printed = run_script(script, tmp_path / "photos", tmp_path / "out")
    assert printed.startswith("model 0: 4 images, ")


def test_masks_leave_out_borders_and_captions(tmp_path: Path) -> None:
    names = write_photographs(tmp_path / "photos", 2)
    script = RECIPES / "historical-photographs" / "border_masks.py"
    folders = tmp_path / "photos", tmp_path / "masks"
    run_script(script, *folders, "--border", "0.05", "--caption", "0.2")
    expected = np.zeros(IMAGE_SIZE[::-1], bool)
    expected[12 : 240 - 48, 12 : 320 - 12] = True
    for name in names:
        np.testing.assert_array_equal(
            read_mask(tmp_path / "masks" / f"{name}.png"), expected
        )


@pytest.mark.parametrize(
    ("script", "options"),
    [("on_slurm", []), ("on_kubernetes", ["--image=i", "--claim=c"])],
)
def test_cluster_is_started_and_its_address_handed_on(
    tmp_path: Path, script: str, options: list[str]
) -> None:
    # Stand-ins for what cannot run here: two packages and the command line itself.
    (tmp_path / "dask_jobqueue.py").write_text(FAKE_CLUSTER)
    (tmp_path / "dask_kubernetes").mkdir()
    (tmp_path / "dask_kubernetes" / "operator.py").write_text(FAKE_CLUSTER)
    command = tmp_path / "colmap-affrect"
    command.write_text('#!/bin/sh\necho "$@"\n')
    command.chmod(0o755)
    environment = {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "PYTHONPATH": str(tmp_path),
    }
    given = [*options, "--", "--image-path", "p", "--output-path", "o"]
    printed = run_script(RECIPES / "cluster" / f"{script}.py", *given, env=environment)
    assert (
        printed == "run --image-path p --output-path o --scheduler tcp://there:8786\n"
    )


@pytest.mark.long
def test_cells_of_the_notebook_run_in_order_and_register_all_photographs(
    tmp_path: Path,
) -> None:
    notebook = ROOT / "docs" / "first_run.ipynb"
    cells = [
        c for c in json.loads(notebook.read_text())["cells"] if c["cell_type"] == "code"
    ]
    assert not any(cell["outputs"] for cell in cells)
    code = "\n".join("".join(cell["source"]) for cell in cells)
    environment = {
        "PATH": "/usr/bin:/bin",
        "TMPDIR": str(tmp_path),
        "HOME": str(tmp_path),
    }
    environment |= {"MPLBACKEND": "agg"}
    assert "9 of 9 photographs" in run_script(
        "-c", code, cwd=notebook.parent, env=environment
    )


@pytest.mark.long
def test_page_on_python_does_what_it_shows(photos: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    code = "\n".join(block for block in blocks if "cluster" not in block)
    shutil.copytree(photos, tmp_path / "photos")
    for name, new in ((NAMES[0], "left.jpg"), (NAMES[1], "right.jpg")):
        (tmp_path / "photos" / name).rename(tmp_path / "photos" / new)
    code = code.replace("1440.0", str(FOCAL_PX))
    printed = run_script("-c", code, cwd=tmp_path)
    assert "registered  4 of 4 images" in printed
    assert "no problems found" in printed
    assert (tmp_path / "for-others" / "points3D.ply").is_file()
    assert (tmp_path / "metric" / "images.bin").is_file()
