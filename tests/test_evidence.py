"""What pixels that err alike leave of scores and covariances, worked by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.choice import PLANE_BONUS
from jaxfuzzy.evidence import FEWEST_PIXELS, HOLDS, NARROW, TELLS, TELLS_OF_ROUND, in_independent_points, told_apart
from jaxfuzzy.objects import PIXELS_PER_POINT
from jaxfuzzy.primitives import Box, Cylinder, Plane
from jaxfuzzy.shapes import GUARDS
from jaxfuzzy.status import Status
from synthetic import fitted_shape

BODY = Cylinder(jnp.zeros(3), jnp.array([0, 1.0, 0]), jnp.asarray(0.1), jnp.asarray(0.3))
UP = np.array([0.0, 1.0, 0.0])
FLAT = Plane(jnp.zeros(3), jnp.array([0, 0, -1.0]), jnp.zeros((4, 3)))
FITTED_TO, SCORED = 2048, 512
PIXELS = 10 * FITTED_TO
# Each point fitted to stands for ten pixels, each one that scores are counted from for forty.
WORTH, SCORE_WORTH = PIXELS_PER_POINT / 10, PIXELS_PER_POINT / 40


def told(scores, body=BODY, pixels=PIXELS, guards=()):
    """A shape with these scores, in nats of independent points, as it comes back."""
    worth = max(1, PIXELS_PER_POINT * min(pixels, SCORED) / pixels)
    passed = sorted(s for k, s in scores.items() if not any(g.startswith(k) for g in guards))
    shape = dataclasses.replace(
        fitted_shape(body, np.ones(pixels, bool), 0.01),
        scores={k: s * worth for k, s in scores.items()},
        margin=(passed[1] - passed[0]) * worth,
        covariance=jnp.eye(2),
        guards=guards,
    )
    return told_apart(in_independent_points([shape], FITTED_TO), UP)[0]


def test_scores_margin_and_covariance_are_those_of_independent_points():
    scores = {"plane": 30.0, "cylinder": 0.0, "sphere": 12.0}
    shape = told(scores)
    assert shape.kind == "cylinder"
    assert int(shape.status) == 0
    assert shape.scores == pytest.approx(scores)
    assert shape.margin == pytest.approx(12)
    np.testing.assert_allclose(shape.covariance, WORTH * np.eye(2), rtol=1e-6)
    # Pixels beyond those that err alike cost nothing.
    np.testing.assert_allclose(told(scores, pixels=PIXELS_PER_POINT * FITTED_TO).covariance, np.eye(2))


def test_a_narrow_margin_within_a_family_is_told():
    scores = {"cylinder": 0.0, "cone": NARROW / 2, "sphere": 12.0}
    shape = told(scores)
    assert shape.kind == "cylinder"
    assert int(shape.status) == Status.LOW_MARGIN
    assert int(told(scores | {"cone": 2 * NARROW}).status) == 0


def test_another_family_that_is_as_likely_refuses():
    scores = {"cylinder": 0.0, "sphere": TELLS / 2, "box": -5.0}
    guards = (f"box: {GUARDS['box']}",)
    shape = told(scores, guards=guards)
    assert shape.kind == "unknown"
    assert shape.primitive is None
    assert int(shape.status) == Status.REFUSED | Status.LOW_MARGIN
    assert shape.guards == (*guards, "cylinder: another kind is as likely")
    # A kind that a guard spoke against is no rival, nor is a cone one of a cylinder.
    assert told(scores | {"sphere": 2 * TELLS, "cone": TELLS / 2}, guards=guards).kind == "cylinder"


def test_what_is_as_likely_a_cone_as_a_cylinder_is_neither():
    shape = told({"cylinder": 0.0, "cone": TELLS_OF_ROUND / 2, "sphere": 12.0})
    assert shape.kind == "unknown"
    assert shape.guards == ("cylinder: another kind is as likely",)
    # A plane may well be a face of a box.
    assert told({"plane": 0.0, "box": TELLS_OF_ROUND / 2, "sphere": 12.0}, body=FLAT).kind == "plane"


def test_the_bonus_of_planes_is_no_evidence():
    bonus = PLANE_BONUS / SCORE_WORTH
    assert told({"plane": TELLS / 2 - bonus, "cylinder": 0.0}).kind == "unknown"
    assert told({"plane": 2 * TELLS - bonus, "cylinder": 0.0}).kind == "cylinder"
    assert told({"plane": 0.0, "cylinder": bonus + TELLS / 2}, body=FLAT).kind == "unknown"
    assert told({"plane": 0.0, "cylinder": bonus + 2 * TELLS}, body=FLAT).kind == "plane"


def test_too_few_independent_points_refuse():
    scores = {"plane": 30.0, "cylinder": 0.0}
    shape = told(scores, pixels=FEWEST_PIXELS - 1)
    assert shape.kind == "unknown"
    assert int(shape.status) == Status.REFUSED | Status.TOO_FEW_POINTS
    assert told(scores, pixels=FEWEST_PIXELS).kind == "cylinder"


def test_a_surface_that_holds_few_of_its_points_is_refused():
    for share, kind in ((HOLDS - 0.01, "unknown"), (HOLDS + 0.01, "cylinder")):
        shape = fitted_shape(BODY, np.arange(PIXELS) < share * PIXELS, 0.01)
        shape = dataclasses.replace(shape, scores={"plane": 1e3, "cylinder": 0.0}, margin=1e3)
        assert told_apart([shape], UP)[0].kind == kind


def test_what_has_no_name_keeps_none():
    shape = fitted_shape(None, np.zeros(50, bool), 0.01)
    same = told_apart(in_independent_points([shape], FITTED_TO), UP)[0]
    assert same.kind == "unknown"
    assert int(same.status) == 0
    assert same.guards == ()


@pytest.mark.parametrize(("lean", "allowed"), [(0.0, 0.0), (0.6, 0.0), (0.7, 1.0), (np.pi / 2, 1.0)])
def test_a_body_about_another_vertical_must_lead_by_the_price_of_its_axis(lean, allowed):
    body = dataclasses.replace(BODY, axis=jnp.array([np.sin(lean), np.cos(lean), 0.0]))
    # Two parameters, at half the logarithm of the number of independent points each.
    least = TELLS + allowed * np.log(PIXELS / PIXELS_PER_POINT)
    assert told({"cylinder": 0.0, "sphere": least + 0.1}, body=body).kind == "cylinder"
    assert told({"cylinder": 0.0, "sphere": least - 0.1}, body=body).kind == "unknown"
    # A cone would have the same axis.
    assert told({"cylinder": 0.0, "cone": 0.5, "sphere": least + 0.1}, body=body).kind == "cylinder"


def test_a_turned_box_must_lead_a_plane_too():
    axes = jnp.asarray([[1, 1, 1], [1, -1, 0], [1, 1, -2]] / np.sqrt([[3.0], [2], [6]]))
    turned = Box(jnp.zeros(3), jnp.ones(3), axes, jnp.ones(3, bool))
    upright = dataclasses.replace(turned, axes=jnp.eye(3))
    least = TELLS + np.log(PIXELS / PIXELS_PER_POINT) - PLANE_BONUS / SCORE_WORTH
    scores = {"box": 0.0, "plane": least - 0.1, "sphere": 100.0}
    assert told(scores, body=upright).kind == "box"
    assert told(scores, body=turned).kind == "unknown"
    assert told(scores | {"plane": least + 0.1}, body=turned).kind == "box"
