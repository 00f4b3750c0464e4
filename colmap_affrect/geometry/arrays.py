"""Names of the types of arrays; what shapes and units they have, docstrings say."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Floats = NDArray[np.floating]  # of any width
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def rows_in(rows: Indices, others: Indices) -> Bools:
    """Return (N,) whether (N, 2) rows are among others, (M, 2)."""
    numbers = np.unique(np.concatenate([rows, others]), return_inverse=True)[1].reshape(-1, 2)
    keys = numbers[:, 0] * (numbers.max(initial=0) + 1) + numbers[:, 1]
    return np.isin(keys[: len(rows)], keys[len(rows) :])
