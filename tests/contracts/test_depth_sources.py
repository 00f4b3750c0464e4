"""Depth maps of files keep the contract, whatever they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from contracts.depth_contract import DepthContract
from contracts.rectifier_contract import IMAGES

from colmap_affrect.images.depth import DepthFiles, DepthFilesOptions, DepthSource


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
class TestDepthFiles(DepthContract):
    @pytest.fixture(autouse=True)
    def _maps(self, tmp_path: Path, kind: str) -> None:
        """One map of half the size of the image, with a hole."""
        height, width = IMAGES["textured"].shape
        depth = np.random.default_rng(3).uniform(0.5, 4.0, (height // 2, width // 2))
        depth[3:9, 5:20] = 0.0
        (tmp_path / "folder").mkdir()
        np.save(tmp_path / "folder" / "name.npy", depth)
        self.folder, self.kind = tmp_path, kind

    def make(self) -> DepthSource:
        return DepthFiles(DepthFilesOptions(path=str(self.folder), kind=self.kind))
