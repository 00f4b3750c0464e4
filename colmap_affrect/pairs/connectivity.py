"""Which images verified pairs tie to others well enough for mapping."""

from collections.abc import Mapping

import numpy as np

from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.base import Pair


def weakly_connected_images(matches: Mapping[Pair, Indices], min_num_features: int) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    A mapper registers an image by features whose matches it has triangulated already. That takes
    two other images, so a strong pair alone ties an image to nothing. ``matches`` has (M, 2)
    features of the first and the second image of each verified pair.
    """
    names = sorted({name for pair in matches for name in pair})
    number = {name: index for index, name in enumerate(names)}
    ends = [
        (number[pair[side]] << 32) + indices[:, side]
        for side in (0, 1)
        for pair, indices in matches.items()
    ]
    features, index, num_matches = np.unique(
        np.concatenate([np.zeros(0, np.int64), *ends]), return_inverse=True, return_counts=True
    )
    first, second = index.reshape(2, -1)
    is_shared = num_matches > 1
    in_track = is_shared.copy()
    in_track[first[is_shared[second]]] = True
    in_track[second[is_shared[first]]] = True
    counts = np.bincount(features[in_track] >> 32, minlength=len(names))
    return {name for name, count in zip(names, counts, strict=True) if count < min_num_features}
