"""Named embeddings: the enlarged data spaces in which surfaces become hyperplanes (paper section III-C).

Every embedding is a table that adds up the nine monomials of x, y, z into its own Q coordinates:

| name | coordinates | what a hyperplane in it is |
|---|---|---|
| 3d | x, y, z | plane (paper) |
| 4d | x², z², x, z | upright elliptic cylinder (paper, eq. 22) |
| 6d | x², y², z², x, y, z | axis-aligned quadric (paper, eq. 23) |
| cylinder | x²+z², x, z | upright circular cylinder |
| sphere | x²+y²+z², x, y, z | sphere |
| cone | x²+z², y², x, y, z | upright quadric of revolution, a cone among them |
| 9d | all nine | any quadric |
| linear | the coordinates themselves, of any number | linear variety (paper, eq. 12) |
"""

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Float

# Monomials in the order of a quadric's coefficients; these are the factors of the six quadratic ones.
MONOMIALS = ("xx", "yy", "zz", "xy", "yz", "zx", "x", "y", "z")
LEFT, RIGHT = np.array([0, 1, 2, 0, 1, 2]), np.array([0, 1, 2, 1, 2, 0])

COORDINATES: dict[str, tuple[str, ...]] = {
    "3d": ("x", "y", "z"),
    "4d": ("xx", "zz", "x", "z"),
    "6d": ("xx", "yy", "zz", "x", "y", "z"),
    "cylinder": ("xx+zz", "x", "z"),
    "sphere": ("xx+yy+zz", "x", "y", "z"),
    "cone": ("xx+zz", "yy", "x", "y", "z"),
    "9d": MONOMIALS,
}
NAMES = (*COORDINATES, "linear")


def table(name: str, dims: int = 3) -> np.ndarray:
    """How much of each monomial every coordinate holds: (Q, 9), or for points that are not 3D (D, D).

    Raises:
        ValueError: an unknown name, or an embedding of 3D points for points that are not.
    """
    checks.choice(name, "embedding", NAMES)
    if dims != 3:
        if name != "linear":
            raise ValueError(f"embedding must be 'linear' for points of {dims} coordinates, got {name!r}")
        return np.eye(dims)
    coordinates = COORDINATES["3d" if name == "linear" else name]
    return np.array([[float(monomial in c.split("+")) for monomial in MONOMIALS] for c in coordinates])


def size(name: str, dims: int = 3) -> int:
    """Number of coordinates Q."""
    return table(name, dims).shape[0]


def padded_tables(names: tuple[str, ...], dims: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Tables of several embeddings, (E, Q, 9) with zero rows up to the largest Q, and which rows are real, (E, Q)."""
    tables = [table(name, dims) for name in names]
    most = max(len(t) for t in tables)
    padded = np.stack([np.pad(t, ((0, most - len(t)), (0, 0))) for t in tables])
    return padded, np.stack([np.arange(most) < len(t) for t in tables])


def features(points: Float[ArrayLike, "N D"], name: str) -> Float[Array, "N Q"]:
    """The points in an embedding.

    Args:
        points: Points; D must be 3 but for the embedding "linear".
        name: Name of the embedding.
    """
    p = checks.points(points)
    return monomials(p) @ table(name, p.shape[1]).T.astype(p.dtype)


def gradients(points: Float[ArrayLike, "N D"], name: str) -> Float[Array, "N Q D"]:
    """Derivatives of the embedding's coordinates with respect to the point's."""
    p = checks.points(points)
    return jnp.einsum("qm,nmd->nqd", table(name, p.shape[1]).astype(p.dtype), monomial_gradients(p))


def monomials(points: Float[Array, "N D"]) -> Float[Array, "N M"]:
    """The nine monomials of 3D points; other points as they are."""
    if points.shape[1] != 3:
        return points
    return jnp.concatenate([points[:, LEFT] * points[:, RIGHT], points], axis=1)


def monomial_gradients(points: Float[Array, "N D"]) -> Float[Array, "N M D"]:
    """Derivatives of `monomials`."""
    unit = jnp.eye(points.shape[1], dtype=points.dtype)
    linear = jnp.broadcast_to(unit, (points.shape[0], *unit.shape))
    if points.shape[1] != 3:
        return linear
    quadratic = points[:, LEFT, None] * unit[RIGHT] + points[:, RIGHT, None] * unit[LEFT]
    return jnp.concatenate([quadratic, linear], axis=1)


def monomials_of_affine(
    factor: Float[Array, ""], shift: Float[Array, " D"]
) -> tuple[Float[Array, "M M"], Float[Array, " M"]]:
    """How monomials change with the frame: those of `factor` · p + `shift` are matrix · (those of p) + constant."""
    unit = jnp.eye(shift.size, dtype=shift.dtype)
    if shift.size != 3:
        return factor * unit, shift
    mixed = factor * (shift[RIGHT, None] * unit[LEFT] + shift[LEFT, None] * unit[RIGHT])
    upper = jnp.concatenate([factor**2 * jnp.eye(6, dtype=shift.dtype), mixed], axis=1)
    lower = jnp.concatenate([jnp.zeros((3, 6), shift.dtype), factor * unit], axis=1)
    return jnp.concatenate([upper, lower]), jnp.concatenate([shift[LEFT] * shift[RIGHT], shift])


def unmixed(tables: Float[Array, "Q M"]) -> Float[Array, "Q M"]:
    """The transposed pseudo-inverse of a table: each row holds a monomial in one coordinate at most, so rows are orthogonal."""
    length = (tables**2).sum(axis=1, keepdims=True)
    return tables / jnp.where(length > 0, length, 1)
