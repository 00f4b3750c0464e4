"""Every depth source keeps the contract."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from contracts.depth_contract import DepthContract
from contracts.rectifier_contract import IMAGES

from colmap_affrect.depth import depth_source
from colmap_affrect.interfaces import DepthSource
from colmap_affrect.options import DepthOptions


class TestDepthFiles(DepthContract):
    kind = "z"

    @pytest.fixture(autouse=True)
    def _maps(self, tmp_path: Path) -> None:
        """One map of half the size of the image, with a hole."""
        height, width = IMAGES["textured"].shape
        depth = np.random.default_rng(3).uniform(0.5, 4.0, (height // 2, width // 2))
        depth[3:9, 5:20] = 0.0
        (tmp_path / "folder").mkdir()
        np.save(tmp_path / "folder" / "name.npy", depth)
        self.folder = tmp_path

    def make(self) -> DepthSource:
        source = depth_source(DepthOptions(path=str(self.folder), kind=self.kind), None, "cpu")
        assert source is not None
        return source


class TestRayLengths(TestDepthFiles):
    kind = "ray"


class TestInverseDepth(TestDepthFiles):
    kind = "inverse"
