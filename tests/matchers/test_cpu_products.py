"""Products of floats on a CPU are those of torch, to rounding."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from colmap_affrect.matchers import cpu_products
from colmap_affrect.matchers.cpu_products import (
    NUM_QUERIES,
    ROW_MULTIPLE,
    fast_attention,
    has_fast_products,
    with_fast_products,
)

needs_products = pytest.mark.skipif(
    not hasattr(torch.ops.mkldnn, "_linear_pointwise"), reason="torch without oneDNN"
)


@pytest.fixture
def asked_anew() -> Any:
    """Whether products are fast is asked once; here again, and after the test."""
    has_fast_products.cache_clear()
    yield
    has_fast_products.cache_clear()


@needs_products
@pytest.mark.parametrize(
    ("num_queries", "num_keys"),
    [(1, 1), (ROW_MULTIPLE, 3), (NUM_QUERIES + 5, ROW_MULTIPLE + 1), (7, 0), (0, 7)],
)
def test_attention_is_that_of_torch(num_queries: int, num_keys: int) -> None:
    torch.manual_seed(num_queries)
    queries = torch.randn(2, 3, num_queries, 16)
    keys = torch.randn(2, 3, num_keys, 16)
    values = torch.randn(2, 3, num_keys, 24)
    found = fast_attention(queries, keys, values)
    if num_keys:
        expected = scaled_dot_product_attention(queries, keys, values)
    else:
        expected = torch.zeros(2, 3, num_queries, 24)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@needs_products
@pytest.mark.parametrize("has_bias", [False, True])
def test_linear_layers_are_those_of_torch(*, has_bias: bool) -> None:
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Linear(20, 30, bias=has_bias),
        torch.nn.ReLU(),
        torch.nn.Sequential(torch.nn.Linear(30, 4, bias=has_bias)),
    ).requires_grad_(False)
    for shape in ((ROW_MULTIPLE + 2, 20), (2, 5, 20), (0, 20)):
        given = torch.randn(shape)
        expected = network(given)
        with_fast_products(network)
        assert "forward" in vars(network[2][0])
        found = network(given)
        for layer in (network[0], network[2][0]):
            del layer.forward
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.usefixtures("asked_anew")
def test_products_that_are_missing_or_wrong_are_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As of another torch."""
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")

    def missing(*_: Any) -> torch.Tensor:
        raise AttributeError

    def wrong(rows: torch.Tensor, weight: torch.Tensor, bias: Any) -> torch.Tensor:
        return (1 + 3e-5) * (rows @ weight.T + bias)

    def right(rows: torch.Tensor, weight: torch.Tensor, bias: Any) -> torch.Tensor:
        return (1 + 3e-6) * (rows @ weight.T + bias)

    for product, expected in ((missing, False), (wrong, False), (right, True)):
        monkeypatch.setattr(cpu_products, "_product", product)
        has_fast_products.cache_clear()
        assert has_fast_products() == expected


@pytest.mark.usefixtures("asked_anew")
def test_products_are_not_changed_where_that_was_not_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    assert not has_fast_products()
