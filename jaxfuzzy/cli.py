"""The command line: stereo pairs, clouds, tables and calibration boards in; results on disk and a short table out.

Results go to standard output, everything else to standard error. Exit status: 0 done, 1 the data could not be modelled,
2 wrong use or unreadable input, 130 stopped by Ctrl-C or by being asked to end.
"""

import argparse
import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxfuzzy import checks
from jaxfuzzy.arguments import WRONG_USE, joined, parser
from jaxfuzzy.checks import DataError
from jaxfuzzy.terminal import Progress, columns, say, show, warnings_as_lines

if TYPE_CHECKING:
    from jaxfuzzy.fcm import Partition
    from jaxfuzzy.scene import Scene

DONE, NOT_MODELLED, STOPPED = 0, 1, 130
# What is left of a run once the scene is modelled: drawing and writing, roughly.
WRITING = 0.2


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: The words after the program's name; by default those it was started with.

    Returns:
        The exit status.
    """
    try:
        args = parser(
            {"demo": _demo, "model": _model, "shapes": _shapes, "cluster": _cluster, "calibrate": _calibrate}
        ).parse_args(joined(sys.argv[1:] if argv is None else argv))
    except SystemExit as done:  # argparse has said why
        return int(done.code or 0)
    try:
        with warnings_as_lines(), _stopped_in_order():
            _set_up_process()
            status: int = args.run(args)
            sys.stdout.flush()
            return status
    except KeyboardInterrupt:
        say("stopped")
        return STOPPED
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain once more when it closes it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("JAXFUZZY_TRACEBACK"):
            traceback.print_exc()
        say(str(error))
        return NOT_MODELLED if isinstance(error, DataError) else WRONG_USE
    except MemoryError:
        say("not enough memory for an input of this size")
        return WRONG_USE


def _demo(args: argparse.Namespace) -> int:
    from jaxfuzzy.stereo import example_pair

    left, right, rig = example_pair()
    return _scene(args, lambda **options: _modelling().model_scene(left, right, rig, **options))


def _model(args: argparse.Namespace) -> int:
    from jaxfuzzy.matcher import Matcher
    from jaxfuzzy.photos import read_depth, read_disparity, read_grey
    from jaxfuzzy.rig import load_rig

    if args.right is None and args.disparity is None and args.depth is None:
        raise ValueError("RIGHT must be given, unless --disparity or --depth is")
    if len(args.rig) > 2:
        raise ValueError(f"--rig takes one or two files, got {len(args.rig)}")
    rig = load_rig(*args.rig, unit_m=args.unit, rectified=args.rectified, arbitrary_units=args.arbitrary_units)
    if args.resized and rig.image_size is None:
        raise ValueError("--resized needs a rig that says how large its images are, which this file does not")
    if args.resized:
        rig = rig.scaled(read_grey(args.left, "left").shape[::-1])
    given: dict[str, Any] = {}
    if args.disparity is not None:
        given["disparity_px"] = read_disparity(args.disparity, scale=args.disparity_scale)
    if args.depth is not None:
        given["depth_m"] = read_depth(args.depth, scale=args.depth_scale)
    if args.depth_std is not None:
        given["depth_std"] = args.depth_std
    if args.min_disparity is not None or args.disparities is not None:
        given["matcher"] = Matcher(min_disparity=args.min_disparity, disparities=args.disparities)
    return _scene(args, lambda **options: _modelling().model_scene(args.left, args.right, rig, **given, **options))


def _shapes(args: argparse.Namespace) -> int:
    from jaxfuzzy.cloud import read_cloud

    if args.no_ground and args.up in (None, "auto"):
        raise ValueError("--no-ground needs --up X,Y,Z: without a table there is nothing to take the vertical from")
    cloud = read_cloud(args.cloud)
    return _scene(args, lambda **options: _modelling().model_cloud(cloud, **options))


def _scene(args: argparse.Namespace, model: Callable[..., "Scene"]) -> int:
    """Models a scene, writes it, and prints what was found."""
    from jaxfuzzy import report
    from jaxfuzzy.status import describe

    report.check_folder(args.out)
    if not report.can_draw():
        say("report.html and figures are left out: they need pip install 'jaxfuzzy[view]'", args.quiet)
    names = ("ks", "noise_distance", "kinds", "up", "ground", "camera", "rule")
    options = {name: getattr(args, name) for name in names if getattr(args, name, None) is not None}
    if getattr(args, "no_ground", False):
        options["ground"] = None
    if options.get("camera") == "none":
        options["camera"] = None
    with Progress(args.quiet) as progress:
        scene = model(progress=lambda stage, share: progress(stage, share * (1 - WRITING)), **options)
        if not scene.shapes:
            raise DataError(f"no object was found. {describe(scene.status)}")
        progress("writing", 1 - WRITING)
        files = report.save(scene, args.out)
    tree = report.to_dict(scene)
    if args.json:
        show(json.dumps(tree | {"folder": os.fspath(args.out), "files": files}, allow_nan=False))
        return DONE
    for line in _scene_lines(scene, tree):
        show(line)
    shown = [name for name in files if not name.startswith("figures/")]
    pictures = len(files) - len(shown)
    say(f"wrote {args.out}/: {', '.join(shown)}{f', figures/ ({pictures})' if pictures else ''}", args.quiet)
    return DONE


def _cluster(args: argparse.Namespace) -> int:
    from jaxfuzzy import table
    from jaxfuzzy.fcm import fcm
    from jaxfuzzy.seeding import histogram_seeds
    from jaxfuzzy.status import describe
    from jaxfuzzy.validity import INDICES, RULES, choose_k

    checks.choice(args.index, "index", INDICES)
    checks.choice(args.rule, "rule", RULES)
    if args.out is not None:
        table.check_suffix(args.out)
        _check_file(args.out, args.points)
    names, points = table.read_points(args.points, args.columns)
    ks = args.ks
    with Progress(args.quiet) as progress:
        scores: dict[int, float] = {}
        if len(ks) > 1:
            progress("trying every k", 0.0)
            chosen = choose_k(
                points, ks, m=args.m, index=args.index, rule=args.rule, noise_distance=args.noise_distance
            )
            k, partition = int(chosen.k), chosen.partition
            scores = {int(one): float(score) for one, score in zip(chosen.ks, chosen.scores, strict=True)}
        else:
            progress("fitting", 0.0)
            k = ks[0]
            partition = fcm(points, histogram_seeds(points, k).centers, m=args.m, noise_distance=args.noise_distance)
        if args.sizes:  # from a fit without sizes: started from the seeds alone, sizes follow a poor seed
            partition = fcm(points, partition.centers, m=args.m, noise_distance=args.noise_distance, sizes=True)
        if args.out is not None:
            progress("writing", 0.9)
            table.write_points(args.out, names, points, partition)
    result = _cluster_result(names, k, args.index if scores else None, scores, partition)
    if args.json:
        show(json.dumps(result, allow_nan=False))
        return DONE
    if scores:
        show(f"{args.index}: " + ", ".join(f"k = {one} {score:.4g}" for one, score in scores.items()))
    rows = [
        [str(i), f"{size:.4f}", str(result["counts"][i]), *(f"{v:.6g}" for v in result["centers"][i])]
        for i, size in enumerate(result["sizes"])
    ]
    for line in columns(["cluster", "size", "points", *names], rows):
        show(line)
    if result["noise_points"]:
        show(f"noise: {result['noise_points']} points")
    if result["status"]:
        show(f"note: {describe(result['status'])}")
    if args.out is not None:
        say(f"wrote {args.out}", args.quiet)
    return DONE


def _cluster_result(
    names: Sequence[str], k: int, index: str | None, scores: dict[int, float], partition: "Partition"
) -> dict[str, Any]:
    import numpy as np

    from jaxfuzzy.status import SENTENCES

    labels, status = np.asarray(partition.labels), int(partition.status)
    return {
        "schema": "jaxfuzzy/partition",
        "version": 1,
        "columns": list(names),
        "k": k,
        "index": index,
        "scores": {str(one): score if np.isfinite(score) else None for one, score in scores.items()},
        "centers": np.asarray(partition.centers, float).tolist(),
        "sizes": np.asarray(partition.sizes, float).tolist(),
        "counts": [int((labels == i).sum()) for i in range(k)],
        "noise_points": int((labels < 0).sum()),
        "objective": float(partition.objective),
        "steps": int(partition.steps),
        "status": status,
        "reasons": [sentence for bit, sentence in SENTENCES.items() if bit & status],
        "labels": labels.tolist(),
    }


def _calibrate(args: argparse.Namespace) -> int:
    from jaxfuzzy.calibrate import calibrate
    from jaxfuzzy.rig import fields_of, save_rig
    from jaxfuzzy.rigwriters import check_suffix, own_tree

    _check_file(args.out, *args.left, *args.right)
    check_suffix(args.out.suffix.lower(), "out", rectified=False)
    board = {"board": args.board, "square_m": args.square, "marker_m": args.marker, "dictionary": args.dictionary}
    with Progress(args.quiet) as progress:
        progress("looking for the board", 0.0)
        rig = calibrate(args.left, args.right, **board)
        save_rig(args.out, rig)
    if args.json:
        show(json.dumps(own_tree(fields_of(rig)), allow_nan=False))
        return DONE
    found = rig.calibration
    show(f"focal length {rig.focal_px[0]:.2f} px, baseline {1e3 * rig.baseline_m:.2f} mm")
    if found is not None:
        show(f"reprojection error {found.rms_px:.3f} px over {len(found.pairs)} pairs (below 0.5 is good)")
        for number, reason in found.left_out:
            show(f"left out {args.left[number]}: {reason}")
    say(f"wrote {args.out}", args.quiet)
    return DONE


def _scene_lines(scene: "Scene", tree: dict[str, Any]) -> Iterator[str]:
    from jaxfuzzy import drawing

    metric = tree["units"]["length"] == "m"
    rows = [
        [
            drawing.name(index, shape),
            drawing.size_text(shape, metric=metric) or "-",
            str(entry["points"]),
            f"{100 * entry['inliers'] / max(entry['points'], 1):.0f} %",
        ]
        for index, (shape, entry) in enumerate(zip(scene.shapes, tree["shapes"], strict=True))
    ]
    yield from columns(["object", "sizes", "points", "on surface"], rows, right=(2, 3))
    for reason in tree["reasons"]:
        yield f"note: {reason}"
    by_reason: dict[str, list[str]] = {}
    for entry in tree["shapes"]:
        for reason in entry["reasons"]:
            by_reason.setdefault(reason, []).append(str(entry["object"]))
    for reason, objects in by_reason.items():
        yield f"note on {', '.join(objects)}: {reason}"


def _check_file(path: Path, *inputs: Path) -> None:
    """Whether a file can be written, and is none of those that are read, before a long computation."""
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise ValueError(f"out must not be the input, got {path}")
    if path.is_dir():
        raise ValueError(f"out must be a file, got the folder {path}")
    if not path.parent.is_dir():
        raise ValueError(f"out must be in an existing folder, got {path}")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"cannot write {path}: Permission denied")


def _modelling() -> Any:
    from jaxfuzzy import scene

    return scene


@contextmanager
def _stopped_in_order() -> Iterator[None]:
    """Takes being asked to end for Ctrl-C, so that nothing half-written is left behind."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield  # somebody else has a say in it
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _set_up_process() -> None:
    """Keeps what JAX compiles in the user's cache folder, so that a second run need not compile."""
    import gc

    import jax

    # Tracing makes millions of short-lived objects: looking for cycles among them every 700 took a tenth of a run.
    gc.set_threshold(1_000_000)
    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return  # the user, or a test, has chosen
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxfuzzy"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", os.fspath(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


if __name__ == "__main__":
    sys.exit(main())
