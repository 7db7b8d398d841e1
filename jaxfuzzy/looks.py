"""Looks at objects: the first, further ones where the noise or the vertical was not what was thought, and the refusal.

What fits no kind shows in the noise of its best surface: that of a wrong one is larger than small windows of the points, which know
nothing of kinds, say it is.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfuzzy.fitting import Fitted, fit_batch
from jaxfuzzy.objects import DEVIATIONS, Prepared, prepared, stacked
from jaxfuzzy.search import KINDS
from jaxfuzzy.status import Status

FEWEST = 12
# A surface is refused where its noise exceeds so many times that of small windows, and so much of the object's spread: real
# boxes and tins bulge and dent by that.
MISFIT, BULGE = 1.35, 0.042
# Noise over spread of the points from which on there is no surface to speak of.
HOPELESS = 0.35
# Least share of an object's points that must lie on its surface.
LEAST_SHARE = 0.1
OVERRATED, MOST_LOOKS = 0.5, 4
# Second principal spread over first below which points are one line; third over first, one plane to the last digit.
LINE, SHEET = 1e-4, 1e-7


class Settings(NamedTuple):
    """What is the same for all objects of a call."""

    kinds: tuple[str, ...]
    gric: bool
    along_ray: bool
    camera: np.ndarray | None
    dtype: Any


class Look(NamedTuple):
    """One object and the surface found.

    Attributes:
        item: The object in the frame it was searched in.
        fitted: What was found.
        reason: Why it is refused; 0 where it is not.
    """

    item: Prepared
    fitted: Fitted
    reason: Status


def unfit(item: Prepared | None) -> Status:
    """Why an object cannot be searched at all; 0 where it can."""
    if item is None or (item.weight > 0).sum() < FEWEST:
        return Status.TOO_FEW_POINTS
    if item.frame.unit == 0 or item.flatness[0] < LINE or (item.flatness[1] < SHEET and not item.given):
        return Status.DEGENERATE
    return Status(0)


def look_at(items: Sequence[Prepared], settings: Settings) -> list[Look]:
    """Searches all objects, again where that promises more."""
    looks = _search(items, settings)
    # A first guess of the noise that was far too large blurs the search: look again with what was found.
    for _ in range(MOST_LOOKS - 1):
        again = [i for i, o in enumerate(looks) if not items[i].given and o.fitted.polished.scale < OVERRATED]
        sharper = _search([_with_noise_found(looks[i]) for i in again], settings)
        for i, new in zip(again, sharper, strict=True):
            looks[i] = new
    refused = [i for i, o in enumerate(looks) if o.reason]
    turned = [(i, item) for i in refused for item in _turned(looks[i], settings.camera, settings.along_ray)]
    for (i, _), new in zip(turned, _search([item for _, item in turned], settings), strict=True):
        if not new.reason and (looks[i].reason or _best(new) < _best(looks[i])):
            looks[i] = new
    return looks


def _search(items: Sequence[Prepared], settings: Settings) -> list[Look]:
    if not items:
        return []
    allowed = np.array([k in settings.kinds for k in KINDS])
    batch = stacked(list(items), settings.dtype)
    fitted = jax.device_get(fit_batch(batch, allowed, np.asarray(settings.gric), settings.along_ray))
    each = [jax.tree.map(lambda a, i=i: a[i], fitted) for i in range(len(items))]
    return [Look(item, found, _reason(item, found)) for item, found in zip(items, each, strict=True)]


def _reason(item: Prepared, found: Fitted) -> Status:
    """Why the best surface is refused; 0 where it is not."""
    p = found.polished
    noise = p.scale * found.deviation * np.median(1 / item.gain)
    on = item.weight @ (p.square[: len(item.points)] <= (DEVIATIONS * max(1.0, float(p.scale))) ** 2)
    if not found.passed.any() or not np.isfinite(p.theta).all():
        return Status.REFUSED
    if noise > HOPELESS or on < max(FEWEST / 2, LEAST_SHARE * item.weight.sum()):
        return Status.ALL_NOISE | Status.REFUSED
    expected = max(1.0, float(found.local)) * found.deviation * np.median(1 / item.gain)
    return Status.REFUSED if noise > np.hypot(MISFIT * expected, BULGE) else Status(0)


def _best(look: Look) -> float:
    return float(look.fitted.scores[look.fitted.kind])


def _with_noise_found(look: Look) -> Prepared:
    item, found = look.item, look.fitted
    return item._replace(gain=item.gain / (found.deviation * found.polished.scale), given=True)


def _turned(look: Look, camera: np.ndarray | None, along_ray: bool) -> list[Prepared]:
    """The object with other verticals: square to most normals, as the axis of a lying cylinder is, and along most."""
    item, normals = look.item, look.fitted.normals
    axes = np.linalg.eigh(normals.T @ normals)[1].T[[0, 2]] @ item.frame.turn
    p = item.frame.origin + item.frame.unit * item.points @ item.frame.turn
    looks = []
    for axis in axes:
        if abs(axis @ item.frame.turn[1]) < 0.95:
            deviation = item.frame.unit / item.gain * look.fitted.deviation
            new = prepared(p, item.weight, deviation, axis, camera, along_ray)
            looks.append(new._replace(order=item.order[new.order], given=True))
    return looks
