"""The choice by what is seen past the outline: a box before a wall of which a band is missing, and rivals given by hand."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.evidence import TELLS
from jaxfuzzy.objects import PIXELS_PER_POINT
from jaxfuzzy.outline import sight_of
from jaxfuzzy.primitives import Box, Cylinder
from jaxfuzzy.rivals import chosen_by_outline
from synthetic import fitted_shape

FRONT, WALL, OUTLIERS = 1.0, 2.0, 0.1
BOX = Box(jnp.array([0, 0, FRONT + 0.05]), jnp.array([0.4, 0.4, 0.1]), jnp.eye(3), jnp.ones(3, bool))
# Its outline is the right half of that of the box.
HALF = Cylinder(jnp.array([0.1, -0.2, 1.1]), jnp.array([0, 1.0, 0]), jnp.asarray(0.1), jnp.asarray(0.4))
STEPS = 200


def scene(missing):
    """Points of a grid of rays that meet the front of the box, but for a band from its left edge, and a wall elsewhere."""
    x, y = (a.ravel() for a in np.meshgrid(*2 * [(np.arange(2 * STEPS) + 0.5) / STEPS * 0.4 - 0.4]))
    there = (np.abs(x) < 0.2) & (np.abs(y) < 0.2) & (x > -0.2 + missing * 0.4)
    points = np.stack([x, y, np.ones_like(x)], axis=1) * np.where(there, FRONT, WALL)[:, None]
    return points, np.flatnonzero(there)


def shape_of(body, count, scores, guards=()):
    inliers = np.random.default_rng(0).uniform(size=count) >= OUTLIERS
    return dataclasses.replace(fitted_shape(body, inliers, 0.004), scores=scores, margin=0.0, guards=guards)


def chosen(missing, scores, rival=HALF, guards=()):
    """What is chosen in place of the box, and which kinds were fitted again."""
    points, own = scene(missing)
    asked = []

    def again(of, kinds):
        assert of == [0]
        (kind,) = kinds
        asked.append(kind)
        return (shape_of(rival, len(own), {kind: scores[kind]}),)

    sight = sight_of(points, np.isin(np.arange(len(points)), own, invert=True), np.zeros(3), np.array([0, 1.0, 0]))
    shape = chosen_by_outline(points, [own], [shape_of(BOX, len(own), scores, guards)], sight, again)[0]
    return shape, asked


def test_what_is_seen_through_a_surface_costs_it():
    """A tenth of the front is missing, of ten slices of its points eight count, a fiftieth of these is beyond its ends."""
    shape, asked = chosen(0.1, {"box": 10.0, "cylinder": 1000.0})
    cost = -np.log(OUTLIERS) * 0.98 * 0.8 * 0.1 * STEPS**2 / PIXELS_PER_POINT
    assert shape.kind == "box"
    # Outliers are drawn, slices end within rows of the grid, and a fair share of all points is looked at.
    assert shape.scores["box"] == pytest.approx(10 + cost, abs=0.03 * cost)
    assert shape.margin == pytest.approx(1000 - shape.scores["box"])
    assert asked == []


def test_nothing_seen_through_costs_nothing():
    shape, asked = chosen(0.0, {"box": 10.0, "cylinder": 10.0 + 2 * TELLS})
    assert shape.scores == {"box": 10.0, "cylinder": 10.0 + 2 * TELLS}
    assert asked == []


def test_a_rival_that_hides_less_wins_and_knows_both():
    shape, asked = chosen(0.2, {"box": 10.0, "cylinder": 12.0, "sphere": 1000.0})
    assert asked == ["cylinder"]
    assert shape.kind == "cylinder"
    assert shape.scores["cylinder"] == 12.0
    assert shape.scores["box"] > 20.0
    assert shape.margin == pytest.approx(shape.scores["box"] - 12.0)


def test_a_rival_that_is_refused_or_that_a_guard_spoke_against_does_not_win():
    shape, asked = chosen(0.2, {"box": 10.0, "cylinder": 12.0}, rival=None)
    assert asked == ["cylinder"]
    assert shape.kind == "box"
    assert shape.margin < 0
    shape, asked = chosen(0.2, {"box": 10.0, "cylinder": 12.0}, guards=("cylinder: its radius",))
    assert asked == []
    assert shape.kind == "box"
