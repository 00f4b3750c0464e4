"""Names for types of arrays. Docstrings say which shapes and units the arrays have."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Floats = NDArray[np.floating]  # of any width
Indices = NDArray[np.int64]
Integers = NDArray[np.integer]  # of any width
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def rows_in(rows: Indices, others: Indices) -> Bools:
    """Return (N,) whether each of (N, 2) rows is among (M, 2) others."""
    both = np.concatenate([rows, others])
    _, numbers = np.unique(both, return_inverse=True)
    numbers = numbers.reshape(-1, 2)
    base = numbers.max(initial=0) + 1
    keys = numbers[:, 0] * base + numbers[:, 1]
    return np.isin(keys[: len(rows)], keys[len(rows) :])
