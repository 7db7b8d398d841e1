"""From looks to bounded primitives: which points lie on each surface, where it ends, and the primitive with its covariance."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfuzzy import bounds
from jaxfuzzy.fitting import Judged, assemble_batch, judged
from jaxfuzzy.looks import Look, Settings, side_by_side
from jaxfuzzy.objects import BATCH, DEVIATIONS, Frame, batches
from jaxfuzzy.primitives import KINDS, Primitive


class Bounded(NamedTuple):
    """A look's primitive, the covariance of its parameters, and which points lie on it, in the order of the search."""

    primitive: Primitive
    covariance: np.ndarray
    on: np.ndarray


def bounded(looks: Mapping[int, Look], settings: Settings) -> dict[int, Bounded]:
    """The primitives of looks that were not refused; those of one kind are made together."""
    good = {i: look for i, look in looks.items() if not look.reason}
    seen = {i: judged(look.item, look.fitted, settings.along_ray) for i, look in good.items()}
    on = {i: _on(look, seen[i]) for i, look in good.items()}
    same = {kind: [i for i, o in good.items() if KINDS[o.fitted.kind] == kind] for kind in KINDS}
    parts = [(kind, part) for kind, own in same.items() if own for part in batches(own)]
    surfaces = [(kind, *_surfaces([(good[i], seen[i], on[i]) for i in part], settings)) for kind, part in parts]
    made: dict[int, Bounded] = {}
    # For the sake of the first call, which compiles every kind.
    assembled = side_by_side(lambda s: jax.device_get(assemble_batch(*s)), surfaces)
    for (_, part), found in zip(parts, assembled, strict=True):
        for j, i in enumerate(part):
            primitive, covariance = jax.tree.map(lambda a, j=j: np.asarray(a[j]), found)
            made[i] = Bounded(primitive, covariance, on[i])
    return made


def _on(look: Look, seen: Judged) -> np.ndarray:
    """Which points lie on the surface: those whose noise membership is not the larger."""
    scale = 1.0 if look.item.given else float(look.fitted.polished.scale)
    return np.asarray((seen.square <= (DEVIATIONS * scale) ** 2) & (look.item.weight > 0))


def _ends(look: Look, seen: Judged, on: np.ndarray) -> np.ndarray:
    item, polished = look.item, look.fitted.polished
    hits = (item.points + seen.depth[:, None] * item.rays) @ polished.turn.T
    kind, theta, turn = KINDS[look.fitted.kind], np.asarray(polished.theta), np.asarray(polished.turn)
    return bounds.ends_of(kind, theta, hits, seen.part, on, look.fitted.detail, turn)


def _surfaces(looks: Sequence[tuple[Look, Judged, np.ndarray]], settings: Settings) -> tuple[Any, ...]:
    """What primitives of one kind are made of, padded by repetition to one compiled size."""
    ends = [_ends(*look) for look in looks]
    own = [look for look, *_ in looks]
    rows = [*range(len(own)), *[0] * (BATCH - len(own))]
    stack = lambda of: np.stack([np.asarray(of(i), settings.dtype) for i in rows])
    frame = Frame(*(stack(lambda i, f=f: getattr(own[i].item.frame, f)) for f in Frame._fields))
    polished = lambda name: stack(lambda i: getattr(own[i].fitted.polished, name))
    detail = stack(lambda i: own[i].fitted.detail)
    return polished("theta"), polished("covariance"), polished("turn"), detail, stack(lambda i: ends[i]), frame
