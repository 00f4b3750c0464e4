"""The protocol of matchers, their common options, and their registry.

A matcher finds which features of two images may show the same point. Matchers of other packages
are entry points of the group ``colmap_affrect.matchers``. Several threads may call one object.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Protocol, Self

import numpy as np

from colmap_affrect.data import LocalFeatures
from colmap_affrect.features.base import NetworkContext, NetworkOptions
from colmap_affrect.geometry.arrays import Indices, Singles
from colmap_affrect.options import Registry, within

# Rounding error of a float32 cosine of unit rows of 128 values. Distances below its root count as
# equal, so that the ratio of two copies of one descriptor is 1 (numeric).
COSINE_ROUNDING = np.float32(1e-6)


class MatcherOptions(NetworkOptions):
    """Base of the options of all matchers."""

    filter_stationary_matches: bool = True
    """Leave out matches that do not move where those of other pairs do not either, and those from
    one such place to another: captions, frames of scans, watermarks, backgrounds of turntables."""
    max_num_first: Annotated[int, within(0, 1_000_000)] = 0
    """Features of the largest responses that are matched first; 0: all at once. All follow for the
    pairs of images that these do not tie well."""

    def require_extractor(self, extractor: str) -> None:
        """Raise OptionError for a kind of features that cannot be matched; an empty one passes."""

    def load_meanwhile(self, num_pairs: int) -> None:
        """Begin to load, in another thread, libraries that matching that many pairs will need."""


@dataclass(frozen=True)
class MatcherContext(NetworkContext):
    """What a matcher works with, beside its options."""

    device: str = "auto"  # as given by the user
    # About how many pairs of features will be compared in all
    num_comparisons: float = 0.0
    # Pairs may be given up that some of their features show to have nothing in common
    may_give_up: bool = False


@dataclass(frozen=True)
class ImageFeatures:
    """The features of one image, as matchers get them."""

    features: LocalFeatures  # those of warps too (``rectification_ids``)
    image_size: tuple[int, int]  # (width, height) of the stored image in px
    extractor: str  # kind of the features, usually the name of their extractor


@dataclass(frozen=True)
class Matches:
    """Matches of two images before geometric verification, one to one."""

    # (M, 2) int64 features of image 1 and 2. Column 0 is strictly rising, and column 1 has no
    # feature twice: verification and tracks rely on it.
    indices: Indices
    scores: Singles  # (M,) float32 in [0, 1], larger is better

    @classmethod
    def none(cls) -> Self:
        """Return the matches of images that have nothing in common."""
        return cls(np.zeros((0, 2), np.int64), np.zeros(0, np.float32))

    def fault(self, num_first: int, num_second: int) -> str:
        """Say what is wrong for images with so many features; empty if nothing is."""
        indices = np.asarray(self.indices)
        scores = np.asarray(self.scores)
        if not np.issubdtype(indices.dtype, np.integer):
            return "indices that are no integers"
        if indices.shape != (len(scores), 2) or scores.ndim != 1:
            return (
                f"indices of shape {indices.shape} and scores of shape {scores.shape}"
            )
        if (indices < 0).any() or (indices >= (num_first, num_second)).any():
            return "indices of features that there are not"
        rows, columns = indices.T
        if (np.diff(rows) <= 0).any() or len(np.unique(columns)) < len(columns):
            return "features that are matched twice, or not in order"
        return (
            ""
            if ((scores >= 0.0) & (scores <= 1.0)).all()
            else "scores that are not in [0, 1]"
        )


class Matcher(Protocol):
    """Matches pairs of images; called with its ``Options`` and a :class:`MatcherContext`."""

    def prepare(self, image: ImageFeatures) -> Any:
        """Return what :meth:`match` needs of an image, with its memory as attribute ``nbytes``."""

    def match(self, first: Any, second: Any) -> Matches:
        """Match two prepared images.

        Args:
            first: prepared image 1.
            second: prepared image 2; either may have no features.

        Returns:
            Matches, one to one.
        """


MATCHERS: Registry[Matcher] = Registry(
    kind="matcher",
    group="colmap_affrect.matchers",
    built_in={
        "nearest": "colmap_affrect.matchers.nearest:NearestNeighbors",
        "lightglue": "colmap_affrect.matchers.lightglue:LightGlue",
    },
    default="nearest",
    protocol=Matcher,
    options_base=MatcherOptions,
)


def distance_ratios(nearest_cosines: Singles, second_cosines: Singles) -> Singles:
    """Return the (N,) ratios of the distances of unit rows to two neighbours.

    Both arguments are (N,) cosines: with the nearest neighbour, and with the second nearest.
    """
    nearest_squares = np.maximum(1.0 - nearest_cosines, COSINE_ROUNDING)
    second_squares = np.maximum(1.0 - second_cosines, COSINE_ROUNDING)
    return np.asarray(np.sqrt(nearest_squares / second_squares))
