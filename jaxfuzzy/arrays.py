"""Array aliases with axis names, and the immutable record that every result is.

Axis letters mean one thing everywhere: N points, K clusters, C varieties, D space, Q embedding coordinates,
E embeddings, M candidates for the number of clusters.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike as JaxArrayLike
from jaxtyping import Array, Bool, Float, Int

__all__ = [
    "Array",
    "ArrayLike",
    "Bool",
    "Float",
    "Int",
    "Scalar",
    "all_on_device",
    "as_float",
    "is_concrete",
    "on_device",
    "on_host",
    "product",
    "record",
    "static",
]

ArrayLike = JaxArrayLike | Sequence[Any]
Scalar = float | Float[Array, ""]

T = TypeVar("T")
# Multiplications from which on OpenBLAS shares out a product: half of what was measured.
SHARED_OUT = 2**18
# Compiler's options: processors that have wide vectors are up to a quarter faster with them; it takes halves by default.
WIDE = {"xla_cpu_prefer_vector_width": 512}


def on_device(value: Any, dtype: Any = None) -> Array:
    """An array that is put on the device as it is; `jnp.asarray` would compile a small program for every shape and type.

    Args:
        value: What NumPy makes an array of.
        dtype: Its type; NumPy's own, in the precision of JAX, by default.
    """
    return jax.device_put(np.asarray(value, dtype))


def on_host(value: Any, dtype: Any = None) -> Array:
    """A NumPy array for a record that is still worked on; `all_on_device` makes it what it is declared as."""
    array: Any = np.asarray(value, dtype)
    return array


def all_on_device(tree: T) -> T:
    """A record, or several, whose NumPy arrays are put on the device, all at once; plain numbers stay what they are."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = iter(jax.device_put([leaf for leaf in leaves if isinstance(leaf, np.ndarray)]))
    return jax.tree.unflatten(structure, [next(arrays) if isinstance(leaf, np.ndarray) else leaf for leaf in leaves])


def static(**kwargs: Any) -> Any:
    """A record field that fixes a shape or a name and is therefore part of the compilation key."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


def _short_repr(self: Any) -> str:
    return eqx.tree_pformat(self, short_arrays=True)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(dataclasses.field, static))
def record(cls: type[T]) -> type[T]:
    """Makes a class an immutable dataclass that JAX treats as a pytree; fields made by `static` are not traced."""
    cls = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    if "__repr__" not in vars(cls):
        cls.__repr__ = _short_repr  # type: ignore[method-assign]
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    return jax.tree_util.register_dataclass(
        cls,
        data_fields=[f.name for f in fields if not f.metadata.get("static")],
        meta_fields=[f.name for f in fields if f.metadata.get("static")],
    )


def is_concrete(value: Any) -> bool:
    """Whether a value is known now, so that it may be looked at (False while JAX traces it)."""
    return not isinstance(value, jax.core.Tracer)


def as_float(value: Any) -> Array:
    """A JAX array of the default float type, or of the value's own float type where it has one that JAX keeps.

    Integers, booleans and float16 become the default float type; float64 stays float64 only where `jax_enable_x64` is set.
    """
    if not isinstance(value, jax.Array):
        value = np.asarray(value)
    own = jnp.issubdtype(value.dtype, jnp.floating) and jnp.finfo(value.dtype).bits >= 32
    dtype = jax.dtypes.canonicalize_dtype(value.dtype) if own else jnp.result_type(float)
    if isinstance(value, jax.Array):
        return value.astype(dtype)
    # `jnp.asarray` would compile a program for every new number of points; JAX may keep what it is given here, hence the copy.
    return jax.device_put(np.array(value, dtype))


def lengths(rows: np.ndarray) -> np.ndarray:
    """Lengths of the rows of an array (N, D) on the host, an eighth of the time NumPy's norm takes over short rows."""
    return np.sqrt(np.einsum("ij,ij->i", rows, rows))


def product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The matrix product (N, K) of left (N, D) and right (D, K) on the host, by one thread.

    A large one NumPy's BLAS shares out among threads, which then wait for more in a busy loop for a tenth of a second; beside
    compiled work on few processors that costs several times what it saves.
    """
    rows = max(1, SHARED_OUT // max(right.size, 1))
    if len(left) <= rows:
        return np.asarray(left @ right)
    found = np.empty((len(left), right.shape[1]), np.result_type(left, right))
    for start in range(0, len(left), rows):
        np.matmul(left[start : start + rows], right, out=found[start : start + rows])
    return found


def nth_smallest(values: np.ndarray, n: int) -> np.ndarray:
    """The value in each row (R, N) that n others come before, n below N.

    It lies in one of the n + 1 blocks whose least values are least, which is three times as fast as looking at all.
    """
    rows, count = values.shape
    size = int(np.sqrt(count))
    if count <= (n + 2) ** 2:  # no more blocks than that
        return np.asarray(np.partition(values, n, axis=1)[:, n])
    blocks = np.pad(values, ((0, 0), (0, -count % size)), constant_values=np.inf).reshape(rows, -1, size)
    near = np.argpartition(blocks.min(axis=2), n, axis=1)[:, : n + 1]
    return np.asarray(np.partition(np.take_along_axis(blocks, near[:, :, None], 1).reshape(rows, -1), n, axis=1)[:, n])


def extents(rows: np.ndarray) -> np.ndarray:
    """How far each column of an array (N, D) extends; over all columns at once NumPy takes ten times as long to find least ones."""
    return np.array([np.ptp(column) for column in rows.T])
