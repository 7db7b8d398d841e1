"""Tuning by gradient: does it beat rules, does it find what a grid finds, what does a gradient cost, where is it useless.

    python benchmarks/tuning.py

(a) Fuzzifier and noise distance tuned on the objects of 50 rendered stereo scenes, judged on 50 fresh ones, beside Davé's rule,
    three times the MAD, and 2.5 deviations of the stereo noise model. (b) The same minimum by a fine grid. (c) Time and memory of
    one gradient by the implicit function theorem and through the steps. (d) Losses whose gradient says nothing.
"""

import time
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from common import RESULTS, provenance, table, timings, write
from jax import lax

import jaxfuzzy as jf
from jaxfuzzy import losses
from jaxfuzzy.alternation import smooth_powers, step
from jaxfuzzy.render import RIG, render_pair, table_scene
from jaxfuzzy.tiles import tile_points

matplotlib.use("Agg")
from matplotlib import pyplot as plt

SCENES = 50
POINTS = 400
GROWN_PX = 5
SMALL = RIG.scaled(0.5)
EFFORT = jf.Solver(max_steps=150, tol=1e-7)
# An object off by a tenth of its radius counts half of one that is lost, so that no lost one decides the mean.
HALF_LOST = 0.01


def scene_object(seed):
    """Points in and around the cylinder of a rendered scene, upright, with their deviations; the truth; the share of outliers."""
    pair = render_pair(table_scene(seed, count=1, kinds=("cylinder",), rig=SMALL), SMALL, seed=seed)
    cloud = jf.reconstruct(pair.left, pair.right, pair.rig)
    columns, rows = np.round(np.asarray(cloud.pixels_px)).astype(int).T
    up = np.asarray(pair.ground.normal)
    upright = np.stack([[1.0, 0.0, 0.0], up, np.cross([1.0, 0.0, 0.0], up)])
    grown = cv2.dilate((pair.labels == 0).astype(np.uint8), np.ones((2 * GROWN_PX + 1,) * 2)) > 0
    own = np.random.default_rng(seed).permutation(np.flatnonzero(grown[rows, columns]))[:POINTS]
    (body,) = pair.objects
    axis = np.array([0.0, 1.0, 0.0])
    truth = jf.Cylinder(upright @ body.base, axis, np.asarray(body.radius), np.asarray(body.height))
    points = np.asarray(cloud.points, float)[own] @ upright.T
    return points, np.asarray(cloud.depth_std, float)[own], truth, np.mean(pair.labels[rows[own], columns[own]] != 0)


@jax.jit
def coarse(points):
    """Memberships to start from without the truth: the points nearest to the middle, then noise distances falling to 7 mm."""
    away = jnp.linalg.norm(points - jnp.median(points, axis=0), axis=1)
    u = jnp.where(away < jnp.quantile(away, 0.4), 1.0, 1e-3)[:, None]
    one = lambda u, noise: (
        jf.nfcv(points, u, embedding="cylinder", noise_distance=noise, solver=EFFORT).memberships,
        None,
    )
    return lax.scan(one, u, jnp.array([0.014, 0.01, 0.007]))[0]


def objects(seeds):
    """The objects of many scenes: points, deviations, truths, starts, stacked; and the mean share of outliers."""
    found = [scene_object(seed) for seed in seeds]
    full = [item for item in found if len(item[0]) == POINTS]
    points, deviations, truths, _ = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *full
    )
    print(f"{len(full)} of {len(found)} objects have {POINTS} points")
    return (points, deviations, truths, jax.vmap(coarse)(points)), float(np.mean([item[3] for item in full]))


@jax.jit
def errors(scenes, noise, m):
    """shape_error and the radius' relative error of every object; noise distances for every point (objects, points)."""
    points, _, truths, starts = scenes

    def one(points, truth, start, noise):
        fit = jf.nfcv(points, start, embedding="cylinder", noise_distance=noise, m=m, solver=EFFORT)
        found = jf.recover(fit, "cylinder")
        return losses.shape_error(found, truth), jnp.abs(found.radius / truth.radius - 1)

    return jax.vmap(one)(points, truths, starts, noise)


def bounded(square):
    return jnp.mean(square / (square + HALF_LOST))


def loss_of(scenes, unit, hyper):
    """The loss where the noise distance counts in units of `unit`: metres, or the deviation of each point."""
    return bounded(errors(scenes, hyper.noise_distance * unit, hyper.m)[0])


@jax.jit
def residuals(scenes):
    """Squared distances of a fit without a noise cluster (objects, points)."""
    fit = lambda p: jf.nfcv(p, jnp.ones((POINTS, 1)), embedding="cylinder", solver=EFFORT).squared_distances[:, 0]
    return jax.vmap(fit)(scenes[0])


def rules_and_grid():
    """Experiments (a) and (b)."""
    begin = time.perf_counter()
    (train, share), (fresh, _) = objects(range(SCENES)), objects(range(1000, 1000 + SCENES))
    print(f"{2 * SCENES} scenes rendered and matched in {time.perf_counter() - begin:.0f} s; {share:.0%} outliers")
    metre = jnp.ones_like(train[1])
    units = {"metres": (metre, jf.Hyper(2.0, 0.02)), "deviations": (train[1], jf.Hyper(2.0, 1.0))}
    tuned = {
        name: jf.tune(jax.tree_util.Partial(loss_of, train, unit), start, steps=80)
        for name, (unit, start) in units.items()
    }
    one, many = (tuned[name].hyper for name in ("metres", "deviations"))
    square, everywhere, deviation = residuals(fresh), jnp.ones_like(fresh[1]), fresh[1]
    ways = {
        "Davé's rule, lambda 0.1": (jnp.sqrt(0.1 * square.mean(axis=1, keepdims=True)) * everywhere, 2.0),
        "3 MAD": (3 * 1.4826 * jnp.median(jnp.sqrt(square), axis=1, keepdims=True) * everywhere, 2.0),
        "stereo noise model, 2.5 deviations": (2.5 * deviation, 2.0),
        "tuned, one noise distance": (one.noise_distance * everywhere, one.m),
        "tuned, deviations": (many.noise_distance * deviation, many.m),
    }
    result = {}
    for name, (noise, m) in ways.items():
        square, radius = (np.asarray(e) for e in errors(fresh, noise, m))
        result[name] = {
            "noise_distance_median": float(jnp.median(noise)),
            "loss": float(bounded(square)),
            "radius_median": float(np.median(radius)),
            "radius_90": float(np.quantile(radius, 0.9)),
        }
    head = ("noise distance by", "its median, mm", "loss", "median radius error, %", "9 in 10 below, %")
    columns = ((1e3, "noise_distance_median"), (1, "loss"), (100, "radius_median"), (100, "radius_90"))
    rows = [(n, *(factor * r[field] for factor, field in columns)) for n, r in result.items()]
    table(f"(a) On {SCENES} fresh scenes", head, rows)
    for name, t in tuned.items():
        print(name, "m", float(t.hyper.m), "noise", float(t.hyper.noise_distance), jf.describe(t.status))

    ms, noises = 1 + np.geomspace(0.2, 4, 15), np.geomspace(0.001, 0.012, 15)
    loss = lambda m, d: loss_of(train, metre, jf.Hyper(m, d))
    begin = time.perf_counter()
    grid = np.array([[float(loss(m, d)) for d in noises] for m in ms])
    grid_seconds = time.perf_counter() - begin
    best = np.unravel_index(grid.argmin(), grid.shape)
    # Once more with everything compiled, as the grid is.
    begin = time.perf_counter()
    again = jf.tune(jax.tree_util.Partial(loss_of, train, metre), jf.Hyper(2.0, 0.02), steps=80)
    tune_seconds = time.perf_counter() - begin
    compare = {
        "grid": {"loss": float(grid.min()), "m": ms[best[0]], "noise_distance": noises[best[1]], "losses": grid.size},
        "tune": {
            "loss": float(again.losses[-1]),
            "m": float(again.hyper.m),
            "noise_distance": float(again.hyper.noise_distance),
            "losses": again.evaluations,
        },
    }
    compare["grid"]["seconds"], compare["tune"]["seconds"] = grid_seconds, tune_seconds
    for found in compare.values():
        found["fresh"] = float(loss_of(fresh, everywhere, jf.Hyper(found["m"], found["noise_distance"])))
    table(
        "(b) The same minimum",
        ("", "loss", "on fresh scenes", "m", "noise distance, mm", "losses computed", "seconds"),
        [
            (n, c["loss"], c["fresh"], c["m"], 1e3 * c["noise_distance"], c["losses"], c["seconds"])
            for n, c in compare.items()
        ],
    )
    outcome = {
        "scenes": SCENES,
        "outliers": share,
        "rules": result,
        "tuned": {
            name: {
                "m": float(t.hyper.m),
                "noise_distance": float(t.hyper.noise_distance),
                "losses": np.asarray(t.losses).tolist(),
                "evaluations": t.evaluations,
                "status": int(t.status),
            }
            for name, t in tuned.items()
        },
        "grid": compare,
    }
    return outcome, (ms, noises, grid, again)


def cost():
    """Experiment (c): fuzzy c-means of 20,000 points, 8 clusters."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-4, 4, (8, 3))
    points = jnp.asarray(places[rng.integers(8, size=20_000)] + rng.normal(size=(20_000, 3)))
    seeds = jnp.asarray(places)

    def implicit(m):
        return jnp.sum(jnp.sin(jf.fcm(points, seeds, m=m, memberships=False, solver=jf.Solver(2000, 1e-12)).centers))

    def unrolled(m, steps):
        tiles = tile_points(points, None, 8)
        start = {"centers": (seeds - tiles.mean) / tiles.scale}
        body = lambda theta, _: (
            step(theta, (tiles, m, None, None), sizes=False, powers=smooth_powers, exact=True)[0],
            None,
        )
        theta = lax.scan(body, start, None, length=steps)[0]
        return jnp.sum(jnp.sin(tiles.mean + tiles.scale * theta["centers"]))

    def measured(loss):
        compiled = jax.jit(jax.grad(loss)).lower(jnp.asarray(2.0)).compile()
        seconds = timings(lambda: compiled(jnp.asarray(2.0)).block_until_ready(), 5)
        memory = compiled.memory_analysis().temp_size_in_bytes / 2**20
        return {"gradient": float(compiled(jnp.asarray(2.0))), "seconds": seconds["median"], "mebibytes": memory}

    fitted = jf.fcm(points, seeds, m=2.0, memberships=False, solver=jf.Solver(2000, 1e-12))
    result = {"implicit": measured(implicit) | {"steps": int(fitted.steps)}}
    for steps in (5, 20, 80, 160):
        result[f"unrolled {steps}"] = measured(partial(unrolled, steps=steps)) | {"steps": steps}
    exact = result["implicit"]["gradient"]
    for item in result.values():
        item["error"] = abs(item["gradient"] / exact - 1)
    table(
        "(c) One gradient with respect to m",
        ("", "steps", "ms", "MiB beside the points", "relative difference"),
        [(n, r["steps"], 1e3 * r["seconds"], r["mebibytes"], r["error"]) for n, r in result.items()],
    )
    return result


def useless():
    """Experiment (d): two clusters that merge as m grows; counted labels."""
    # In six dimensions all distances are much alike: beyond some fuzzifier both centers belong at the mean.
    rng = np.random.default_rng(3)
    shift = 3.2 * np.eye(6)[0]
    points = jnp.asarray(np.concatenate([rng.normal(size=(80, 6)), rng.normal(size=(80, 6)) + shift]))
    truth, seeds = np.repeat([0, 1], 80), jnp.asarray(np.stack([np.zeros(6), shift]))
    solver = jf.Solver(20_000, 1e-13)
    centers = lambda m: jf.fcm(points, seeds, m=m, solver=solver)
    gap = lambda m: jnp.sqrt(jnp.sum(jnp.square(centers(m).centers[0] - centers(m).centers[1])) + 1e-24)
    both = jax.jit(jax.value_and_grad(gap))
    ms = np.linspace(1.3, 5, 38)
    gaps, slopes = np.array([[float(v) for v in both(m)] for m in ms]).T
    trust = np.array([float(jf.conditioning(centers(m), points)) for m in ms])
    status = [jf.describe(centers(m).status) for m in ms]
    merged = [i for i, text in enumerate(status) if text != "Nothing to report."]
    print(
        "\n(d) gap of two centers: first told as merged at m =",
        ms[merged[0]] if merged else None,
        status[merged[0]] if merged else "",
    )

    def wrong(hyper):
        return (centers(hyper.m).labels != truth).mean()

    def crossed(hyper):
        return losses.cross_entropy(centers(hyper.m).memberships, truth)

    stuck = {}
    for name, loss, start in (
        ("counted labels", wrong, 3.0),
        ("cross-entropy", crossed, 3.0),
        ("cross-entropy, merged", crossed, 5.0),
    ):
        found = jf.tune(loss, jf.Hyper(start))
        stuck[name] = {
            "start": start,
            "m": float(found.hyper.m),
            "first": float(found.losses[0]),
            "last": float(found.losses[-1]),
            "gradient": float(found.gradients.m[0]),
            "status": jf.describe(found.status),
        }
    table(
        "(d) Tuning m from a start",
        ("loss", "start", "found", "loss at start", "found", "gradient at start", "says"),
        [(n, s["start"], s["m"], s["first"], s["last"], s["gradient"], s["status"]) for n, s in stuck.items()],
    )
    series = {"m": ms.tolist(), "gap": gaps.tolist(), "slope": slopes.tolist(), "conditioning": trust.tolist()}
    return {"tuned": stuck, "merging": series | {"merged_from": float(ms[merged[0]]) if merged else None}}


def draw(found, searched, costs, lost):
    ms, noises, grid, path = searched
    figure, ((one, two), (three, four)) = plt.subplots(2, 2, figsize=(10, 7.6), layout="constrained")
    names = list(found["rules"])
    one.barh(names, [100 * found["rules"][n]["radius_median"] for n in names], color=["#606060"] * 3 + ["#0072B2"] * 2)
    one.invert_yaxis()
    one.set(xscale="log", xlabel="median error of the radius on fresh scenes (%)", title="(a) rules and tuning")
    shades = two.contourf(1e3 * noises, ms - 1, grid, 16, cmap="cividis_r")
    two.plot(1e3 * np.asarray(path.path.noise_distance), np.asarray(path.path.m) - 1, "o-", color="#D55E00", ms=4)
    two.set(
        xscale="log",
        yscale="log",
        xlabel="noise distance (mm)",
        ylabel="m - 1",
        title="(b) loss on a grid, steps of tune",
    )
    figure.colorbar(shades, ax=two)
    unrolled = [c for n, c in costs.items() if n != "implicit"]
    steps = [c["steps"] for c in unrolled]
    three.loglog(steps, [c["mebibytes"] for c in unrolled], "o-", color="#E69F00", label="through the steps: MiB")
    three.loglog(steps, [1e3 * c["seconds"] for c in unrolled], "o--", color="#E69F00", label="through the steps: ms")
    three.axhline(costs["implicit"]["mebibytes"], color="#0072B2", label="implicit: MiB")
    three.axhline(1e3 * costs["implicit"]["seconds"], color="#0072B2", ls="--", label="implicit, fit included: ms")
    three.set(xlabel="steps differentiated", title="(c) cost of one gradient")
    three.legend(frameon=False, fontsize=8)
    series = lost["merging"]
    four.plot(series["m"], series["gap"], color="#0072B2", label="gap of two centers")
    four.plot(series["m"], series["conditioning"], color="#009E73", label="jf.conditioning")
    four.plot(series["m"], np.clip(np.abs(series["slope"]), 0, 4), color="#D55E00", label="|d gap / dm|, cut at 4")
    four.set(xlabel="m", title="(d) centers that merge")
    four.legend(frameon=False, fontsize=8)
    figure.savefig(RESULTS / "tuning.png", dpi=100)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    print(provenance())
    lost, costs = useless(), cost()
    found, searched = rules_and_grid()
    draw(found, searched, costs, lost)
    write("tuning", {"rules": found, "cost": costs, "useless": lost})


if __name__ == "__main__":
    main()
