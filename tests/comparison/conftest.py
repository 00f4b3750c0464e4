from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult


@pytest.fixture(scope="session")
def large_page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a comparison on 200 photographs."""
    folder = tmp_path_factory.mktemp("large")
    return write_page(make_large_comparison(folder), folder)


def make_large_comparison(folder: Path) -> Comparison:
    """200 photographs of noise, five methods with 4000 pairs each, and models of 9000 points."""
    count = 200
    names = [f"photograph_{number:03}.jpg" for number in range(count)]
    rng = np.random.default_rng(0)
    write_image(folder / "noise.jpg", rng.integers(0, 256, (240, 320)).astype(np.uint8))
    (folder / "photographs").mkdir()
    for name in names:
        (folder / "photographs" / name).symlink_to(folder / "noise.jpg")
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 700.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(names):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [-number / 20, 0.0, 0.0])
        image = pycolmap.Image(name, [], 1, number + 1)
        model.add_image_with_trivial_frame(image, pose)
    for x, y, z in rng.normal(size=(9000, 3)):
        color = rng.integers(0, 256, 3).astype(np.uint8)
        model.add_point3D([3 * x, y, 5 + z], pycolmap.Track(), color)
    (folder / "model").mkdir()
    model.write(folder / "model")
    everything = [(a, b) for index, a in enumerate(names) for b in names[index + 1 :]]
    chosen = rng.choice(len(everything), 4000, replace=False)
    methods = []
    for number in range(5):
        pairs = {
            everything[i]: int(c) for i, c in zip(chosen, rng.integers(20, 900, 4000), strict=True)
        }
        seed = SeedResult(
            0, (tuple(names),), "model", 9000, 3.0, 50.0, 0.5, {}, pairs, None, {"map": 9.0}
        )
        methods.append(MethodResult(f"method-{number}", seeds=(seed,), folder=f"methods/{number}"))
    return Comparison(
        tuple(names), str(folder / "photographs"), tuple(methods), (0,), len(everything), {}, {}
    )  # fmt: skip
