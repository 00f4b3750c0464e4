"""The scripts beside the recipes do what their pages in docs/ say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_scene import write_photographs

from colmap_affrect.images.masks import read_mask

RECIPES = Path(__file__).parents[1] / "recipes"

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


def run_script(*arguments: object) -> str:
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.long
def test_script_with_the_features_replaced_registers_the_scene(tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos")
    script = RECIPES / "replace-sift" / "reconstruct.py"
    printed = run_script(script, tmp_path / "photos", tmp_path / "out")
    assert printed.startswith("model 0: 4 images, ")


def test_masks_leave_out_borders_and_captions(tmp_path: Path) -> None:
    names = write_photographs(tmp_path / "photos")  # 320 x 240 px
    script = RECIPES / "historical-photographs" / "border_masks.py"
    run_script(
        script, tmp_path / "photos", tmp_path / "masks", "--border", "0.05", "--caption", "0.2"
    )
    expected = np.zeros((240, 320), bool)
    expected[12 : 240 - 48, 12 : 320 - 12] = True
    for name in names:
        np.testing.assert_array_equal(read_mask(tmp_path / "masks" / f"{name}.png"), expected)


@pytest.mark.parametrize(
    ("script", "options"), [("on_slurm", []), ("on_kubernetes", ["--image=i", "--claim=c"])]
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
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(tmp_path)}
    path = RECIPES / "cluster" / f"{script}.py"
    done = subprocess.run(
        [sys.executable, str(path), *options, "--", "--image-path", "p", "--output-path", "o"],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    assert done.stdout == "run --image-path p --output-path o --scheduler tcp://there:8786\n"
