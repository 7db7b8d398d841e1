"""One peer in a process of its own: reads a task from standard input, writes figures to standard output, both JSON.

    PYTHON benchmarks/peers.py PEER < task.json

PYTHON may be that of another environment: this file needs only NumPy and the peer. A task has "data" and "seeds" (.npy files),
"m" and "what": "sweep" (seconds an iteration), or "fit" (seconds and objective of "steps" iterations).
"""

import json
import sys
import time

import numpy as np


def distances(x, v):
    return np.maximum((x * x).sum(1)[:, None] - 2 * x @ v.T + (v * v).sum(1), 0)


def memberships(x, v, m):
    d = np.maximum(distances(x - x.mean(0), v - x.mean(0)), 1e-300)
    ratio = (d.min(1, keepdims=True) / d) ** (1 / (m - 1))
    return ratio / ratio.sum(1, keepdims=True)


def objective(x, v, m):
    return float((memberships(x, v, m) ** m * distances(x - x.mean(0), v - x.mean(0))).sum())


def run_scikit_fuzzy(x, seeds, m, steps):
    import skfuzzy

    u0 = memberships(x, seeds, m).T
    return skfuzzy.cmeans(x.T, len(seeds), m, error=0.0, maxiter=steps, init=u0)[0], steps


def run_fuzzy_c_means(x, seeds, m, steps):
    from fcmeans import FCM

    # Its own loop, from memberships given: the class itself can only start at random.
    model = FCM(n_clusters=len(seeds), m=m, max_iter=min(steps, 1000))
    model.u = memberships(x, seeds, m)
    for _ in range(steps):
        before = model.u.copy()
        model._update_centers(x)
        model._update_u(x)
        np.linalg.norm(model.u - before)
    return np.asarray(model._centers), steps


def run_kmeans(x, seeds, m, steps):
    from sklearn.cluster import KMeans

    model = KMeans(len(seeds), init=seeds, n_init=1, max_iter=steps, tol=0.0, algorithm="lloyd").fit(x)
    return model.cluster_centers_, model.n_iter_


RUN = {"scikit-fuzzy": run_scikit_fuzzy, "fuzzy-c-means": run_fuzzy_c_means, "scikit-learn k-means": run_kmeans}


def seconds_a_sweep(run, x, seeds, m):
    """From pairs of runs of different length that no tolerance stops, so that set-up cancels."""
    run(x, seeds, m, 3)
    rates = []
    for _ in range(5):
        times, counts = [], []
        for steps in (3, 13):
            begin = time.perf_counter()
            counts.append(run(x, seeds, m, steps)[1])
            times.append(time.perf_counter() - begin)
        rates.append((times[1] - times[0]) / (counts[1] - counts[0]))
    return sorted(rates)


def main():
    task = json.load(sys.stdin)
    run = RUN[sys.argv[1]]
    x, seeds, m = np.load(task["data"]), np.load(task["seeds"]), task["m"]
    if task["what"] == "sweep":
        rates = seconds_a_sweep(run, x, seeds, m)
        result = {"median": rates[len(rates) // 2], "min": rates[0], "max": rates[-1]}
    else:
        run(x[:1000], seeds, m, 2)
        begin = time.perf_counter()
        v, _ = run(x, seeds, m, task["steps"])
        seconds = time.perf_counter() - begin
        result = {"seconds": seconds, "steps": task["steps"], "objective": objective(x.astype(float), v, m)}
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
