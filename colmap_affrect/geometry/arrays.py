"""Names for types of arrays. Docstrings say which shapes and units the arrays have."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Floats = NDArray[np.floating]  # of any width
Indices = NDArray[np.int64]
Integers = NDArray[np.integer]  # of any width
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def sampling_step(num_items: int, max_num: int) -> int:
    """Return the step with which at most so many items are taken, 1 where there are no more."""
    return max(1, math.ceil(num_items / max_num))


def rows_in(rows: Indices, others: Indices) -> Bools:
    """Return (N,) whether each of (N, 2) rows is among (M, 2) others."""
    both = np.concatenate([rows, others])
    _, numbers = np.unique(both, return_inverse=True)
    numbers = numbers.reshape(-1, 2)
    base = numbers.max(initial=0) + 1
    keys = numbers[:, 0] * base + numbers[:, 1]
    return np.isin(keys[: len(rows)], keys[len(rows) :])
