"""Products of floats on a CPU, by oneDNN instead of by the library that torch was built with.

That is MKL in torch's own packages, which does not use AVX-512 on processors of AMD: oneDNN takes
half the time there. Results are the same to rounding.
"""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor, nn

# Rows are filled up to a multiple of it: oneDNN prepares a program for every size; resource
ROW_MULTIPLE = 128
# Queries that attend at once: what they compare with stays in the processor's cache; resource
NUM_QUERIES = 256
# Of the largest value, that products may differ by from torch's own; numeric
MAX_ERROR = 1e-5


@cache
def has_fast_products() -> bool:
    """Tell whether oneDNN is there, faster than MKL may be, and right."""
    import torch

    if not torch.backends.cpu.get_cpu_capability().startswith("AVX512"):
        return False
    random = torch.Generator().manual_seed(0)
    rows = torch.rand((ROW_MULTIPLE, 64), generator=random)
    weight = torch.rand((48, 64), generator=random)
    bias = torch.rand(48, generator=random)
    try:
        found = _product(rows, weight, bias)
    except (AttributeError, RuntimeError, TypeError):
        # It is another torch, or one built otherwise
        return False
    expected = rows @ weight.T + bias
    return bool((found - expected).abs().max() <= MAX_ERROR * expected.abs().max())


def with_fast_products(network: nn.Module) -> None:
    """Have all linear layers of a network use these products.

    Args:
        network: Changed in place; it stays on the CPU, and is not trained.
    """
    from torch import nn

    layers: list[Any] = [m for m in network.modules() if isinstance(m, nn.Linear)]
    for layer in layers:
        layer.forward = partial(_linear, layer)


def _linear(layer: nn.Linear, given: Tensor) -> Tensor:
    """Do what the forward of a linear layer does."""
    rows = given.reshape(-1, given.shape[-1])
    found = _product(_filled_up(rows), layer.weight, layer.bias)[: len(rows)]
    return found.reshape(*given.shape[:-1], len(layer.weight))


def fast_attention(queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    """Return what torch's ``scaled_dot_product_attention`` does.

    Args:
        queries: (B, H, N, D)
        keys: (B, H, M, D)
        values: (B, H, M, E)

    Returns:
        (B, H, N, E) means of the values, by how similar their keys are to each query.
    """
    import torch

    size, num_heads, num_queries, length = queries.shape
    num_keys = keys.shape[2]
    scaled = queries * length**-0.5
    found = queries.new_zeros((size, num_heads, num_queries, values.shape[3]))
    if not num_keys:
        return found
    for batch in range(size):
        for head in range(num_heads):
            told = _filled_up(keys[batch, head])
            columns = _filled_up(values[batch, head]).T.contiguous()
            for begin in range(0, num_queries, NUM_QUERIES):
                asked = scaled[batch, head, begin : begin + NUM_QUERIES]
                similar = _product(_filled_up(asked), told, None)
                similar[:, num_keys:] = -torch.inf
                weights = torch.softmax(similar, dim=1, out=similar)
                means = _product(weights, columns, None)[: len(asked)]
                found[batch, head, begin : begin + len(asked)] = means
    return found


def _product(rows: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """Return (R, D) rows times the transpose of (N, D) weights, plus (N,) biases."""
    import torch

    product: Any = torch.ops.mkldnn._linear_pointwise
    found: Tensor = product(rows.contiguous(), weight, bias, "none", [], "")
    return found


def _filled_up(rows: Tensor) -> Tensor:
    """Add rows of zeros up to a multiple of ``ROW_MULTIPLE``."""
    from torch.nn.functional import pad

    num_missing = -len(rows) % ROW_MULTIPLE
    return pad(rows, (0, 0, 0, num_missing)) if num_missing else rows.contiguous()
