"""More points than memory holds: read block by block, anew for every sweep, with progress and checkpoints.

`fcm` and `nfcv` take what `blocks` makes in place of points. The iteration is the same one: a sweep's sums are added up over the
blocks instead of over an array, so the fixed point is the same to rounding.
"""

import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, as_float
from jaxfuzzy.files import read_arrays, read_bytes, write_atomic

Progress = Callable[[int, float], None]
Outcome = TypeVar("Outcome")


@dataclass(frozen=True, eq=False)
class Blocks:
    """Points that come block by block; made by `blocks`. Iterating gives arrays (rows, D), the last one shorter.

    Attributes:
        source: An array, a function that makes an iterator of arrays, or an iterable of them.
        rows: Points a block.
        progress: Called after every sweep.
        checkpoint: Where to keep what is needed to go on.
    """

    source: Any
    rows: int
    progress: Progress | None = None
    checkpoint: Path | None = None

    def __iter__(self) -> Iterator[np.ndarray]:
        if hasattr(self.source, "shape"):
            for at in range(0, self.source.shape[0], self.rows):
                yield np.asarray(self.source[at : at + self.rows])
            return
        held: list[np.ndarray] = []
        count = 0
        for piece in self.source() if callable(self.source) else self.source:
            piece = np.asarray(piece)
            if piece.ndim != 2:
                raise ValueError(f"blocks must have two axes (rows, D), got shape {piece.shape}")
            while len(piece):
                taken, piece = piece[: self.rows - count], piece[self.rows - count :]
                held.append(taken)
                count += len(taken)
                if count == self.rows:
                    yield np.concatenate(held)
                    held, count = [], 0
        if held:
            yield np.concatenate(held)

    def weighted(self, weights: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Blocks with their weights, 1 where None is given."""
        at = 0
        for block in self:
            own = np.ones(len(block)) if weights is None else np.asarray(weights[at : at + len(block)])
            at += len(block)
            yield block, own

    def survey(self, weights: Any) -> "Survey":
        """Looks at every block once: is it sound, and where do the points lie?

        Raises:
            ValueError: Points or weights that are not finite, negative weights, lengths that do not agree, no points.
            TypeError: Blocks that are not real numbers.
        """
        if weights is not None and np.ndim(weights) != 1:
            raise ValueError(f"weights must have shape (N,), one a point, got {np.shape(weights)}")
        total = Total()
        count, present, dims, dtype = 0, 0, 0, None
        for block, own in self.weighted(weights):
            array = checks.points(block, f"block at point {count}", dims=dims or None)
            if own.shape != (len(block),):
                raise ValueError(f"weights must have one a point, got {np.shape(weights)[0]} for more points than that")
            if own.dtype.kind not in "fiub" or not (np.isfinite(own).all() and (own >= 0).all()):
                raise ValueError(f"weights must be finite and not negative, got others from point {count} on")
            total.add(np.asarray(array, np.float64), own.astype(np.float64))
            count += len(block)
            present += int((own > 0).sum())
            dims, dtype = block.shape[1], array.dtype if dtype is None else jnp.promote_types(dtype, array.dtype)
        if not count:
            raise ValueError("blocks must hold at least one point, got none")
        if weights is not None and len(weights) != count:
            raise ValueError(f"weights must have shape ({count},), one a point, got {np.shape(weights)}")
        if not present:
            raise ValueError("weights must not all be zero")
        return Survey(count, present, dims, dtype, total)

    def each(self, weights: Any, dtype: Any, do: Callable[[Array, Array], Outcome]) -> list[Outcome]:
        """Does something with every block and its weights, the last one filled up with points of weight 0.

        While one block is computed the next is read; no more than two are held.
        """
        out: list[Outcome] = []
        for block, own in self.weighted(weights):
            short = self.rows - len(block) if out else 0
            points = np.pad(np.asarray(block, dtype), ((0, short), (0, 0)))
            if out:
                jax.block_until_ready(out[-1])
            out.append(do(jnp.asarray(points), jnp.asarray(np.pad(own, (0, short)), dtype)))
        return out

    def resume(self, task: str) -> dict[str, np.ndarray] | None:
        """What was kept of this task; None where nothing was.

        Raises:
            ValueError: The checkpoint is damaged or of another task.
        """
        if self.checkpoint is None or not self.checkpoint.exists():
            return None
        try:
            saved = read_arrays(read_bytes(self.checkpoint, "checkpoint"))
        except ValueError as error:
            raise ValueError(f"checkpoint {self.checkpoint} {error}") from None
        if str(saved.pop("task", "")) != task:
            raise ValueError(
                f"checkpoint {self.checkpoint} was written for other points or settings: remove it, or give another name"
            )
        return saved

    def keep(self, task: str, state: Mapping[str, Any]) -> None:
        """Notes how far a task has come."""
        if self.checkpoint is not None:
            file = io.BytesIO()
            np.savez(file, task=np.array(task), **state)
            write_atomic(self.checkpoint, file.getvalue())
        if self.progress is not None:
            self.progress(int(state["steps"]), float(state["change"]))


class Total:
    """Weighted mean and squared distances from it, added up block by block in double precision (Chan, Golub and LeVeque, 1979)."""

    def __init__(self) -> None:
        self.weight, self.mean, self.squares = 0.0, np.zeros(()), 0.0

    def add(self, values: np.ndarray, weights: np.ndarray) -> None:
        """Adds values (n, Q) with weights (n,)."""
        weight = float(weights.sum())
        if weight <= 0:
            return
        values = np.where((weights > 0)[:, None], values, 0)
        own = weights @ values / weight
        squares = float(weights @ np.square(np.where((weights > 0)[:, None], values - own, 0)).sum(axis=1))
        move = own - self.mean
        whole = self.weight + weight
        self.squares += squares + float(move @ move) * self.weight / whole * weight
        self.mean = self.mean + move * (weight / whole)
        self.weight = whole

    @property
    def spread(self) -> float:
        """RMS distance from the mean."""
        return float(np.sqrt(self.squares / self.weight))


@dataclass(frozen=True, eq=False)
class Survey:
    """What a first look at all blocks tells.

    Attributes:
        count: Number of points N.
        present: How many have weight.
        dims: Dimension D.
        dtype: Float type they will have.
        total: Their mean and spread.
    """

    count: int
    present: int
    dims: int
    dtype: Any
    total: Total


def blocks(
    source: str | os.PathLike[str] | np.ndarray | Iterable[Any] | Callable[[], Iterator[Any]],
    *,
    rows: int = 1_000_000,
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Blocks:
    """Points that need not fit into memory, to be given to `fcm` or `nfcv` in place of an array.

    Args:
        source: The path of an NPY file (N, D), which is mapped, not read; an array or memory-mapped array; a list or other iterable
            of arrays (n, D) that can be gone through again and again; or a function that gives a new iterator of them.
        rows: Points to hold at a time. At most two such blocks are in memory.
        progress: Called after every sweep over all points with the number of sweeps done and the largest change of a prototype.
        checkpoint: An NPZ file in which the iteration is kept after every sweep, whole or not at all. Where it exists a fit of
            the same points with the same settings goes on from it; a larger `max_steps` or a smaller `tol` may be asked for.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no array (N, D) of numbers, or `rows` is below 1.
        TypeError: An iterator, which is used up after one sweep.
    """
    checks.integer(rows, "rows", at_least=1)
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if not path.is_file():
            raise FileNotFoundError(f"points not found: {path}")
        try:
            source = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError, SyntaxError) as error:
            raise ValueError(
                f"points {path} must be an NPY file of numbers ({' '.join(str(error).split())[:200]})"
            ) from None
    if isinstance(source, Iterator):
        raise TypeError("source is used up after one sweep: give a list, or a function that makes a new iterator")
    shaped: Any = source
    if hasattr(source, "shape"):
        if len(shaped.shape) != 2 or np.dtype(shaped.dtype).kind not in "fiub":
            raise ValueError(
                f"source must hold real numbers of shape (N, D), got {shaped.dtype} of shape {shaped.shape}"
            )
    elif not callable(source) and not isinstance(source, Iterable):
        raise TypeError(
            f"source must be a path, an array, an iterable of arrays or a function, got {type(source).__name__}"
        )
    return Blocks(source, rows, progress, None if checkpoint is None else Path(checkpoint))


def fingerprint(*parts: Any) -> str:
    """A short name for a task: two tasks have the same only where all they are made of is the same."""
    digest = hashlib.sha256()
    for part in parts:
        value = np.asarray(part if isinstance(part, str | int | float) or part is None else as_float(part))
        digest.update(
            f"{value.dtype.str}{value.shape}".encode() + (repr(part).encode() if part is None else value.tobytes())
        )
    return digest.hexdigest()
