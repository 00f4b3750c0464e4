"""What every depth source promises; one of another package can inherit this too."""

from __future__ import annotations

import numpy as np
from contracts.rectifier_contract import IMAGES, photograph_of
from numpy.testing import assert_array_equal

from colmap_affrect.data import Photograph
from colmap_affrect.images.depth import DepthSource


class DepthContract:
    """Inherit, implement :meth:`make`, and change :meth:`photograph` if a file is needed."""

    def make(self) -> DepthSource:
        """Return the source under test; it knows the depth of :meth:`photograph`."""
        raise NotImplementedError

    def photograph(self) -> Photograph:
        """Return a photograph that the source can tell the depth of."""
        return photograph_of(IMAGES["textured"])

    def test_map_is_positive_or_unknown_and_has_the_shape_of_the_image(self) -> None:
        photograph = self.photograph()
        depth = self.make().depth(photograph)
        assert depth.dtype == np.float32
        assert depth.ndim == 2
        known = np.isfinite(depth)
        assert known.any()
        assert (depth[known] > 0).all()
        assert np.isnan(depth[~known]).all()
        width, height = photograph.size
        rows, columns = depth.shape
        assert abs(columns / rows / (width / height) - 1.0) < 0.1

    def test_map_is_the_same_every_time(self) -> None:
        photograph = self.photograph()
        assert_array_equal(self.make().depth(photograph), self.make().depth(photograph))
