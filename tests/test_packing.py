"""Trees of arrays as one array and back, traced and on the host; products by one thread."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.arrays import SHARED_OUT, product
from jaxfuzzy.packing import leaf, packed, unpacked


class Pair(NamedTuple):
    number: Any
    rest: Any


LAYOUT = Pair(leaf(2, 3), (leaf(dtype=np.int32), leaf(4, dtype=bool)))
TREE = Pair(np.arange(6.0).reshape(2, 3) / 7, (np.int32(-3), np.array([True, False, True, True])))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_packed_comes_back(dtype):
    with jax.enable_x64(dtype == np.float64):
        traced = jax.jit(lambda tree: packed(tree, dtype))(TREE)
        assert traced.dtype == dtype
        np.testing.assert_array_equal(traced, packed(TREE, dtype, np))
        for back in (unpacked(np.asarray(traced), LAYOUT), jax.jit(lambda v: unpacked(v, LAYOUT))(traced)):
            np.testing.assert_array_equal(back.number, TREE.number.astype(dtype))
            assert back.number.dtype == dtype
            assert int(back.rest[0]) == -3
            assert back.rest[0].dtype == np.int32
            np.testing.assert_array_equal(back.rest[1], TREE.rest[1])
            assert back.rest[1].dtype == bool


@pytest.mark.parametrize("more", [-1, 1])
def test_another_number_of_values_is_refused(more):
    with pytest.raises(ValueError, match=f"must have 11 numbers, as the layout has, got {11 + more}"):
        unpacked(jnp.zeros(11 + more), LAYOUT)


@pytest.mark.parametrize(("shape", "dtype"), [((SHARED_OUT // 3, 3, 3), np.float64), ((3, SHARED_OUT, 2), np.float32)])
def test_a_large_product_is_that_of_its_blocks(shape, dtype):
    generator = np.random.default_rng(0)
    left, right = generator.normal(size=shape[:2]).astype(dtype), generator.normal(size=shape[1:]).astype(dtype)
    found = product(left, right)
    assert found.dtype == dtype
    # Sums of so many products in another order: their rounding grows with the root of their number.
    close = 10 * np.finfo(dtype).eps * np.sqrt(shape[1])
    np.testing.assert_allclose(found, np.einsum("ij,jk->ik", left, right), atol=close * np.sqrt(shape[1]))


def test_a_product_may_be_empty():
    assert product(np.zeros((0, 3)), np.zeros((3, 2))).shape == (0, 2)
    assert product(np.zeros((5, 3)), np.zeros((3, 0))).shape == (5, 0)
    np.testing.assert_array_equal(product(np.zeros((5, 0)), np.zeros((0, 2))), np.zeros((5, 2)))
