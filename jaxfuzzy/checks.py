"""Eager validators at the door of every public function: they name the argument, what is allowed and what came.

Values are looked at only where they are known; while JAX traces, shapes and types alone are checked.
"""

from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy.arrays import Array, as_float, extents, is_concrete

# Of scenes, in the unit of the points: from a tenth of a nanometre to beyond the moon, were it metres.
SMALLEST, FARTHEST = 1e-10, 1e9
# Steps of the points' own precision, as a share of their extent, from which on shapes are lost in them. Of a rendered table 1.6 m
# wide, 3.6e-4 (5 km away) change no kind, with 7.3e-4 (10 km) a cone is a plane.
COARSEST = 2e-4


class DataError(ValueError):
    """The data themselves rule out a result, however they are asked for: too few matches, nothing left to fit."""


def points(value: Any, name: str = "points", *, dims: int | None = None) -> Array:
    """Points as a float array (N, D): 2-D, real, at least one row, finite where known."""
    if value is None or isinstance(value, str | bytes):
        raise TypeError(f"{name} must be an array of shape (N, D), got {type(value).__name__}")
    array = real(value, name)
    if array.ndim != 2:
        raise ValueError(f"{name} must have two axes (N, D), got shape {tuple(array.shape)}")
    if array.shape[0] < 1 or array.shape[1] < 1:
        raise ValueError(f"{name} must hold at least one point, got shape {tuple(array.shape)}")
    if dims is not None and array.shape[1] != dims:
        raise ValueError(f"{name} must have shape (N, {dims}), got {tuple(array.shape)}")
    return _finite(as_float(array), name)


def places(value: Any, name: str = "points", *, whole: bool = False) -> Array:
    """Points (N, 3) of a scene, in lengths whose squares and fourth powers single precision can hold.

    Of a `whole` scene it is asked too whether their own precision tells them apart; a part may be small beside its distance.
    """
    array = points(value, name, dims=3)
    if is_concrete(array):
        known = np.asarray(array)
        largest, extent = float(np.abs(known).max()), float(extents(known).max())
        if largest > FARTHEST or 0 < extent < SMALLEST:
            raise ValueError(
                f"{name} must lie within {FARTHEST:g} of the origin and extend over at least {SMALLEST:g}, got {largest:g} and"
                f" {extent:g}: give them in another unit"
            )
        spacing = largest * float(np.finfo(known.dtype).eps)
        if whole and spacing > COARSEST * extent > 0:
            raise ValueError(
                f"{name} lie up to {largest:g} from the origin and extend over {extent:g}, and {known.dtype} tells them apart by"
                f" {spacing:.2g}, which is too little: subtract an offset from them, or compute in double precision"
                " (JAX_ENABLE_X64=1)"
            )
    return array


def weights(value: Any, count: int, name: str = "weights") -> Array | None:
    """Weights as a float array (N,): non-negative, finite, not all zero; None stays None (every weight 1)."""
    if value is None:
        return None
    array = as_float(real(value, name))
    if array.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), one a point, got {tuple(array.shape)}")
    _finite(array, name)
    if is_concrete(array):
        if np.any(np.asarray(array) < 0):
            raise ValueError(f"{name} must not be negative, got a smallest value of {float(array.min())}")
        if not np.any(np.asarray(array) > 0):
            raise ValueError(f"{name} must not all be zero")
    return array


def memberships(value: Any, count: int, name: str = "memberships") -> Array:
    """Memberships as a float array (N, C): not negative, finite, no column all zero."""
    array = points(value, name)
    if array.shape[0] != count:
        raise ValueError(f"{name} must have shape ({count}, C), one row a point, got {tuple(array.shape)}")
    if is_concrete(array):
        known = np.asarray(array)
        if np.any(known < 0):
            raise ValueError(f"{name} must not be negative, got a smallest value of {float(known.min())}")
        if not np.all(known.max(axis=0) > 0):
            empty = int(np.argmin(known.max(axis=0) > 0))
            raise ValueError(f"{name} must leave no column all zero, got column {empty} so")
    return array


def fuzzifier(value: Any, name: str = "m") -> Any:
    """The fuzzifier: a finite number above 1, in single precision too, which points may have."""
    number(value, name, above=1.0)
    if is_concrete(value):
        with np.errstate(over="ignore"):
            known = np.asarray(value).astype(np.float32)
        if not 1 < known < np.inf:
            raise ValueError(f"{name} must be a finite number above 1.0 in single precision, got {float(value)}")
    return value


def noise_distance(value: Any, count: int | None = None, name: str = "noise_distance") -> Any:
    """A noise distance: None, a number above 0, or where `count` is given an array (count,) of them."""
    if value is None:
        return None
    array = real(value, name)
    allowed: tuple[tuple[int, ...], ...] = ((),) if count is None else ((), (count,))
    if array.shape not in allowed:
        raise ValueError(f"{name} must have shape {' or '.join(map(str, allowed))}, got {tuple(array.shape)}")
    if is_concrete(array) and not (np.all(np.isfinite(np.asarray(array))) and np.all(np.asarray(array) > 0)):
        raise ValueError(f"{name} must be finite and above 0, got {_shown(array)}")
    return value


def noise_distance_or_auto(value: Any, count: int | None = None) -> Any:
    """A noise distance, for all or for each of so many points; None for "auto", which something else must tell."""
    if isinstance(value, str):
        choice(value, "noise_distance", ("auto",))
        return None
    if value is None:
        raise TypeError("noise_distance must be 'auto' or above 0, got None")
    return noise_distance(value, count)


def number(value: Any, name: str, *, above: float | None = None, at_least: float | None = None) -> Any:
    """One finite real number, above or at least a bound."""
    array = real(value, name)
    if array.shape != ():
        raise ValueError(f"{name} must be one number, got shape {tuple(array.shape)}")
    if is_concrete(array):
        known = float(array)
        bound = f" above {above}" if above is not None else f" of at least {at_least}" if at_least is not None else ""
        low = (above is not None and known <= above) or (at_least is not None and known < at_least)
        if not np.isfinite(known) or low:
            raise ValueError(f"{name} must be a finite number{bound}, got {known}")
    return value


def integer(value: Any, name: str, *, at_least: int, at_most: int | None = None, why: str = "") -> int:
    """One whole number within bounds, known now (it fixes a shape)."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {value!r}")
    if value < at_least or (at_most is not None and value > at_most):
        top = "" if at_most is None else f" and at most {at_most}{why}"
        raise ValueError(f"{name} must be at least {at_least}{top}, got {value}")
    return int(value)


def choice(value: Any, name: str, allowed: Collection[Any]) -> Any:
    """One of a few names."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value


def kind(value: Any, name: str, wanted: type, advice: str = "") -> Any:
    """A record of the library's own; `advice` says where to get one."""
    if not isinstance(value, wanted):
        raise TypeError(f"{name} must be a {wanted.__name__}, got {type(value).__name__}{advice and '; ' + advice}")
    return value


def flag(value: Any, name: str) -> bool:
    """True or False, known now (it chooses what is compiled)."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def direction(value: Any, name: str) -> np.ndarray:
    """A direction (3,): finite, not of length zero; given back with length 1."""
    array = np.asarray(real(value, name), float)
    if array.shape != (3,):
        raise ValueError(f"{name} must have shape (3,), got {tuple(array.shape)}")
    length = float(np.linalg.norm(array))
    if not np.isfinite(length) or length == 0:
        raise ValueError(f"{name} must be finite and not of length zero, got {_shown(array)}")
    return array / length


def position(value: Any, name: str) -> np.ndarray:
    """A place (3,), finite."""
    array = np.asarray(real(value, name), float)
    if array.shape != (3,):
        raise ValueError(f"{name} must have shape (3,), got {tuple(array.shape)}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_shown(array)}")
    return array


def labels(value: Any, count: int, name: str = "labels") -> np.ndarray:
    """Labels (N,): whole numbers, -1 for outliers."""
    array = np.asarray(value)
    if array.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), one a point, got {tuple(array.shape)}")
    if not np.issubdtype(array.dtype, np.integer):
        raise TypeError(f"{name} must be whole numbers, got {array.dtype}")
    if array.size and array.min() < -1:
        raise ValueError(f"{name} must be -1 (outlier) or above, got {int(array.min())}")
    return array


def real(value: Any, name: str) -> Any:
    """Real numbers of any shape."""
    try:
        array = value if isinstance(value, jax.Array | np.ndarray) else np.asarray(value)
    except ValueError:
        raise ValueError(f"{name} must have rows of one length, or be one number") from None
    if array.dtype.kind not in "fiub" and not jax.numpy.issubdtype(array.dtype, jax.numpy.floating):
        raise TypeError(f"{name} must be real numbers, got {array.dtype}")
    return array


def _finite(array: Array, name: str) -> Array:
    if isinstance(array, jax.Array) and is_concrete(array) and not array.is_fully_addressable:
        # Spread over several processes, none of which may look at all of it; every one comes to the same answer.
        if not bool(jnp.isfinite(array).all()):
            raise ValueError(f"{name} must be finite, got non-finite rows")
    elif is_concrete(array):
        bad = ~np.isfinite(np.asarray(array))
        if bad.any():
            rows = np.flatnonzero(bad.reshape(len(array), -1).any(axis=1)) if array.ndim else np.array([0])
            raise ValueError(
                f"{name} must be finite, got {len(rows)} non-finite rows, the first at index {int(rows[0])}"
            )
    return array


def _shown(array: Any) -> str:
    return np.array2string(np.asarray(array), threshold=6)
