"""Status bits: every reason why a result should be read with care, each with a sentence and what to try next.

A result carries the sum of its bits in `status`; 0 means nothing to report. Bits accumulate from stage to stage.
"""

import enum
from typing import Any

import numpy as np


class Status(enum.IntFlag):
    """Reasons, one bit each. `describe` turns them into sentences."""

    NOT_CONVERGED = 1 << 0
    NOT_FINITE = 1 << 1
    COLLAPSED = 1 << 2
    MERGED = 1 << 3
    DYING = 1 << 4
    SPIKE = 1 << 5
    ALL_NOISE = 1 << 6
    TOO_FEW_POINTS = 1 << 7
    DEGENERATE = 1 << 8
    UNDER_DETERMINED = 1 << 9
    AT_BOUND = 1 << 10
    SKIPPED_ONE = 1 << 11
    PAPER_TIE = 1 << 12
    PAPER_DISAGREES = 1 << 13
    MAY_BE_BOX = 1 << 14
    LOWER_BOUND = 1 << 15
    NO_GROUND = 1 << 16
    GROUND_SLAB = 1 << 17
    ARBITRARY_UNITS = 1 << 18
    MISALIGNED = 1 << 19
    FEW_MATCHES = 1 << 20
    REFUSED = 1 << 21
    LOW_MARGIN = 1 << 22
    UNSTABLE = 1 << 23
    FLAT_LOSS = 1 << 24
    STALLED = 1 << 25
    RAN_AWAY = 1 << 26
    SCATTERED = 1 << 27
    SEEN_THROUGH = 1 << 28
    PIECE = 1 << 29
    EMPTY = 1 << 30


SENTENCES: dict[Status, str] = {
    Status.NOT_CONVERGED: "Stopped at max_steps before the change fell below tol: raise Solver(max_steps=...), loosen tol,"
    " or start from other seeds; in `tune`, raise steps.",
    Status.NOT_FINITE: "A result is not finite: look for NaN or infinite points, or rescale extreme values.",
    Status.COLLAPSED: "All centers sit at the mean, which is a local minimum for this fuzzifier: lower m.",
    Status.MERGED: "Two or more centers coincide, so their memberships are shared: ask for fewer clusters or lower m.",
    Status.DYING: "A cluster's size is going to zero: ask for fewer clusters, or set sizes=False.",
    Status.EMPTY: "A cluster has no share of any point that rounding leaves, and its center stays where it was put: give other"
    " seeds, ask for fewer clusters, or take m nearer to 2.",
    Status.SPIKE: "A center sits on an isolated point and its size shrinks at no cost: give a noise_distance.",
    Status.ALL_NOISE: "No point belongs to a cluster or surface more than to noise: raise noise_distance, or lower it where it is"
    " as large as what it is to tell apart.",
    Status.TOO_FEW_POINTS: "Too few points with weight for what was asked: give more points or ask for less.",
    Status.DEGENERATE: "The points do not span the space (all equal, on one line or in one plane).",
    Status.UNDER_DETERMINED: "The points do not determine this surface: its two smallest eigenvalues are too close; use a"
    " simpler embedding.",
    Status.AT_BOUND: "The number of objects reached the largest one allowed: raise the upper end of ks.",
    Status.SKIPPED_ONE: "The variance ratio cannot score one cluster, so k = 1 was left out: use rule='robust' or another index.",
    Status.PAPER_TIE: "Most-points rule: two embeddings hold the same number of points; the simpler one was taken.",
    Status.PAPER_DISAGREES: "The paper's most-points rule names another kind than the distance to the surface does.",
    Status.MAY_BE_BOX: "A single flat face: it may be one side of a box whose other sides were not seen.",
    Status.LOWER_BOUND: "An extent was not seen to its end: the size given is a lower bound.",
    Status.NO_GROUND: "No supporting plane was found: the vertical that was given was used, or that objects agree on, or the"
    " camera's own frame; give up=(x, y, z) if you know it, within 8 degrees of the plane's normal.",
    Status.GROUND_SLAB: "The supporting plane's residual is larger than the depth noise: it may be a slab through clutter.",
    Status.ARBITRARY_UNITS: "The rig has no known baseline or offset: lengths are in arbitrary units.",
    Status.MISALIGNED: "Rows of the two images do not match: rectify the pair or check the calibration.",
    Status.FEW_MATCHES: "Few pixels were matched: check the disparity range, texture and that the images are not swapped.",
    Status.REFUSED: "None of the known kinds fits: named 'quadric' or 'unknown' rather than guessed.",
    Status.LOW_MARGIN: "The best kind is barely better than the next: look at the scores.",
    Status.UNSTABLE: "Two centers coincide only because their seeds did and would part if nudged: start from other seeds.",
    Status.FLAT_LOSS: "The loss changes at the start with nothing that is tuned: it does not read the values, jumps between"
    " plateaus, has lost all clusters, or is least there already; start elsewhere to tell.",
    Status.STALLED: "No shorter step lowered the loss though its gradient is not zero: it jumps or bends here (labels flip,"
    " clusters merge, a maximum is taken), or its fits are too coarse: use a smooth loss, tighten Solver(tol=...), or start"
    " elsewhere.",
    Status.RAN_AWAY: "Tuning drove a value far from its start, where the loss still falls: it has no minimum in a useful range;"
    " bound the value, or use another loss.",
    Status.SCATTERED: "Points scatter more than twice as much as noise_distance says, even within small windows: raise it if it is"
    " too small.",
    Status.SEEN_THROUGH: "The best surface would hide things that are seen behind it, or the camera itself: the object has another"
    " outline, or holes, or is several; see the guards for the kind.",
    Status.PIECE: "A piece of something larger: much of its border in the picture is no step in depth, so its surface goes on; see"
    " the guards for the kind.",
}


def describe(status: Any) -> str:
    """Says in sentences what a status means and what to try next.

    Args:
        status: The `status` of a result: one integer, or an array of them (one line an item is given back).

    Returns:
        Every reason that is set, in a sentence each; "Nothing to report." where none is.
    """
    bits = np.asarray(status)
    if bits.ndim:
        return "\n".join(f"[{i}] {describe(item)}" for i, item in enumerate(bits.ravel()))
    reasons = [sentence for bit, sentence in SENTENCES.items() if int(bits) & bit]
    return " ".join(reasons) if reasons else "Nothing to report."
