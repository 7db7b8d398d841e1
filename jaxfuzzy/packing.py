"""Many small arrays as one: each that goes to a compiled program, or comes back, costs as much time as thousands of numbers."""

import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy.arrays import Array

Tree = TypeVar("Tree")


def leaf(*shape: int, dtype: Any = None) -> Any:
    """What one array of a layout is; without a dtype it keeps that of the packed one."""
    return jax.ShapeDtypeStruct(shape, np.float64 if dtype is None else dtype)


def packed(tree: Any, dtype: Any, xp: Any = jnp) -> Any:
    """All numbers of a tree of arrays in a row, traced or by NumPy; whole numbers and truth values as floats."""
    return xp.concatenate([xp.ravel(xp.asarray(a, dtype)) for a in jax.tree.leaves(tree)])


def unpacked(values: np.ndarray | Array, layout: Tree) -> Tree:
    """The tree again.

    Args:
        values: What `packed` gave, traced or not.
        layout: The same tree with a `leaf` for each array.

    Raises:
        ValueError: There are more or fewer numbers than the layout has.
    """
    leaves, tree = jax.tree.flatten(layout)
    sizes = [math.prod(of.shape) for of in leaves]
    if sum(sizes) != len(values):
        raise ValueError(f"values must have {sum(sizes)} numbers, as the layout has, got {len(values)}")
    found, start = [], 0
    for of, size in zip(leaves, sizes, strict=True):
        own = values[start : start + size].reshape(of.shape)
        found.append(own if of.dtype == np.float64 else own.astype(of.dtype))
        start += size
    return jax.tree.unflatten(tree, found)
