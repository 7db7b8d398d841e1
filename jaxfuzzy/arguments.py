"""The words of the command line: what each command takes, and its help."""

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

Command = Callable[[argparse.Namespace], int]

WRONG_USE = 2
KINDS = ("plane", "box", "cylinder", "cone", "sphere")
MOST_KS = 1000
# Options that take numbers of which the first may be negative.
PLACES = ("--up", "--camera")

EXAMPLES = """examples:
  jaxfuzzy demo                                    the bundled photograph; open out/report.html
  jaxfuzzy model left.png right.png --rig rig.json
  jaxfuzzy shapes cloud.ply --out found
  jaxfuzzy cluster points.csv -k 2:5 --sizes
  jaxfuzzy COMMAND --help                          more on each

exit status: 0 done, 1 the data could not be modelled, 2 wrong use or unreadable input, 130 stopped
JAXFUZZY_TRACEBACK=1 in the environment shows where an error came from"""

WRITTEN = """writes into DIR, all or nothing:
  report.html, figures/   for people (need the view extra)
  scene.json              kind, sizes, covariance, scores of every object
  cloud.ply               points with object, kind, membership, residual
  model.glb, model.obj    the shapes, for any 3D program
  arrays.npz, rig.json    the rest, for jaxfuzzy.load_scene(DIR)

"""
DEMO = """example:
  jaxfuzzy demo --out out"""
MODEL = """examples:
  jaxfuzzy model left.png right.png --rig calib.txt
  jaxfuzzy model left.png right.png --rig rig.json -k 1:4 --kinds box,cylinder --out found
  jaxfuzzy model left.png right.png --rig intrinsics.yml --rig extrinsics.yml --unit 0.001
  jaxfuzzy model left.png right.png --rig calib.txt --disparity raft.pfm
  jaxfuzzy model color.png --rig calib.txt --depth depth.png --depth-scale 1000
  jaxfuzzy model left.png right.png --rig rig.json --json --quiet | jq '.shapes[].kind'"""
SHAPES = """examples:
  jaxfuzzy shapes cloud.ply
  jaxfuzzy shapes scan.pcd --up 0,0,1 --no-ground --out found
  jaxfuzzy shapes merged.ply --up 0,0,1 --camera none"""
CLUSTER = """examples:
  jaxfuzzy cluster points.csv -k 3 --out labels.csv
  jaxfuzzy cluster points.csv -k 2:5 --sizes            tries 2, 3, 4 and 5
  jaxfuzzy cluster iris.csv --columns sepal_length,petal_length --index xie_beni --rule best"""
CALIBRATE = """example:
  jaxfuzzy calibrate left*.jpg --right right*.jpg --board 9x6 --square 0.025 --out rig.json"""


def parser(commands: Mapping[str, Command]) -> argparse.ArgumentParser:
    """The parser of all commands.

    Args:
        commands: What runs each command, by name.
    """
    top = _Parser(
        prog="jaxfuzzy",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="From a stereo photograph to boxes, cylinders, cones and spheres, by fuzzy clustering.",
        epilog=EXAMPLES,
    )
    top.add_argument("--version", action="version", version=f"jaxfuzzy {version('jaxfuzzy')}")
    made = top.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name: str, text: str, end: str, add: Callable[[argparse.ArgumentParser], None]) -> None:
        one = made.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=end,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add(one)
        one.add_argument("--json", action="store_true", help="print the result as JSON, alone on standard output")
        one.add_argument("--quiet", action="store_true", help="no progress and no remarks on standard error")
        one.set_defaults(run=commands[name])

    command("demo", "model the bundled stereo photograph (Middlebury cones)", WRITTEN + DEMO, _scene)
    command("model", "model the objects in a stereo pair", WRITTEN + MODEL, _model)
    command("shapes", "model the objects in a point cloud", WRITTEN + SHAPES, _shapes)
    command("cluster", "cluster any table of points by fuzzy c-means", CLUSTER, _cluster)
    command("calibrate", "calibrate two cameras from photographs of a chessboard", CALIBRATE, _calibrate)
    return top


def joined(words: Sequence[str]) -> list[str]:
    """Words with `--up -1,0,0` as one, `--up=-1,0,0`: what begins with a dash is an option to argparse."""
    found: list[str] = []
    for word in words:
        if found and found[-1] in PLACES and re.match(r"-[\d.]", word):
            found[-1] += "=" + word
        else:
            found.append(word)
    return found


def _scene(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--out", type=Path, default=Path("out"), metavar="DIR", help="folder for the results (default: out)")
    add(
        "-k", dest="ks", type=_or_auto(_ks), metavar="K", help="how many objects may be there: 3, 1:6 or auto (default)"
    )
    add(
        "--noise-distance",
        type=_or_auto(_length),
        metavar="M",
        help="farther than this from a surface is noise, in metres, or auto (default)",
    )
    add(
        "--up",
        type=_or_auto(_direction),
        metavar="X,Y,Z",
        help="the vertical direction, such as 0,0,1; auto (default) has y down",
    )
    add("--kinds", type=_kinds, metavar="KIND,...", help=f"kinds to try (default: {','.join(KINDS)})")
    add("--paper", dest="rule", action="store_const", const="paper", help="the paper's own rules for number and kind")


def _model(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("left", type=Path, metavar="LEFT", help="left image")
    add(
        "right",
        type=Path,
        nargs="?",
        metavar="RIGHT",
        help="right image, of the same size; not needed with --disparity or --depth",
    )
    add(
        "--rig",
        type=Path,
        required=True,
        action="append",
        metavar="FILE",
        help="the cameras: rig.json of calibrate, Middlebury or KITTI calib.txt, OpenCV yml/xml, ROS camera_info; "
        "twice where they are in two files (left and right, or intrinsics and extrinsics)",
    )
    add("--unit", type=_length, metavar="M", help="unit of that file in metres, such as 0.001 (default: its format's)")
    add("--rectified", action="store_true", help="the images are rectified though the file describes the raw cameras")
    add(
        "--arbitrary-units",
        action="store_true",
        help="go on where the file holds no baseline; lengths mean nothing then",
    )
    add("--resized", action="store_true", help="the images were resized since the rig was made: scale it to them")
    add(
        "--disparity",
        type=Path,
        metavar="FILE",
        help="disparities of the left image from another matcher, in place of matching: PFM, PNG, TIFF, NPY or NPZ",
    )
    add(
        "--disparity-scale",
        type=_length,
        default=1.0,
        metavar="N",
        help="what that file's numbers are divided by, such as 16 or 256 (default: 1)",
    )
    add("--depth", type=Path, metavar="FILE", help="depths of the left image in metres instead, of the same formats")
    add(
        "--depth-scale",
        type=_length,
        default=1.0,
        metavar="N",
        help="what that file's numbers are divided by, such as 1000 for millimetres (default: 1)",
    )
    add(
        "--depth-std",
        type=_length,
        metavar="M",
        help="standard deviation of those depths in metres (default: the rig's stereo error, or what the scene shows)",
    )
    add(
        "--min-disparity",
        type=int,
        metavar="N",
        help="smallest disparity to search, below 0 for cameras that look inwards (default: from the scene)",
    )
    add(
        "--disparities",
        type=int,
        metavar="N",
        help="how many disparities to search, a multiple of 16 (default: from the scene)",
    )
    _scene(command)


def _shapes(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("cloud", type=Path, metavar="CLOUD", help="PLY, PCD, NPY, NPZ, CSV or XYZ, in metres")
    add(
        "--camera",
        type=_camera,
        metavar="X,Y,Z",
        help="where the points were seen from, or none if that is not known (default: 0,0,0)",
    )
    add("--no-ground", action="store_true", help="there is no table to find and remove; needs --up")
    _scene(command)


def _cluster(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("points", type=Path, metavar="POINTS", help="CSV or other text, NPY, NPZ, PLY or PCD")
    add("-k", dest="ks", type=_ks, default=(2, 3, 4, 5), metavar="K", help="3, 2,4 or 2:5, both ends (default: 2:5)")
    add("-m", type=float, default=2.0, metavar="M", help="fuzzifier, above 1 (default: 2)")
    add("--sizes", action="store_true", help="learn the sizes of the clusters")
    add(
        "--noise-distance",
        type=_length,
        metavar="D",
        help="farther than this from a center is noise (default: no noise)",
    )
    add("--columns", type=lambda text: text.split(","), default=[], metavar="A,B", help="only these columns")
    add(
        "--index",
        default="vrc",
        metavar="NAME",
        help="what to judge k by: vrc (default), xie_beni, partition_coefficient, modified_partition_coefficient, "
        "fuzzy_silhouette or jump",
    )
    add("--rule", default="paper", metavar="NAME", help="paper: first local maximum (default); best: the best value")
    add("--out", type=Path, metavar="FILE", help="points with labels and memberships: .csv, .json or .npz")


def _calibrate(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("left", type=Path, nargs="+", metavar="LEFT", help="images of the left camera")
    add(
        "--right",
        type=Path,
        nargs="+",
        required=True,
        metavar="RIGHT",
        help="as many of the right camera, in the same order",
    )
    add("--board", type=_board, default=(9, 6), metavar="CxR", help="inner corners a row and rows (default: 9x6)")
    add("--square", type=_length, required=True, metavar="M", help="edge of one square in metres")
    add("--marker", type=_length, metavar="M", help="edge of one marker in metres, where the board is a ChArUco board")
    add(
        "--dictionary",
        default="DICT_4X4_50",
        metavar="NAME",
        help="markers of a ChArUco board, as OpenCV names them (default: DICT_4X4_50)",
    )
    add(
        "--out",
        type=Path,
        default=Path("rig.json"),
        metavar="FILE",
        help="where to write the rig: .json (default: rig.json), or .yml or .xml as OpenCV does",
    )


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_USE, f"{self.prog}: {message}; see {self.prog} --help\n")


def _or_auto(convert: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda text: text if text == "auto" else convert(text)


def _ks(text: str) -> tuple[int, ...]:
    try:
        if ":" in text:
            low, high = (int(word) for word in text.split(":"))
            if high - low >= MOST_KS:
                raise argparse.ArgumentTypeError(f"must be at most {MOST_KS} numbers, got {text!r}")
            found = tuple(range(low, high + 1))
        else:
            found = tuple(int(word) for word in text.split(","))
    except ValueError:
        found = ()
    if not found or min(found) < 1:
        raise argparse.ArgumentTypeError(f"must be a number, a range such as 2:5, or a list such as 2,4, got {text!r}")
    return found


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a length above 0, got {text!r}")
    return value


def _place(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        return ()


def _camera(text: str) -> tuple[float, ...] | str:
    found = _place(text)
    if text != "none" and len(found) != 3:
        raise argparse.ArgumentTypeError(f"must be three numbers such as 0,0,1.5, or none, got {text!r}")
    return found or text


def _direction(text: str) -> tuple[float, ...]:
    found = _place(text)
    if len(found) != 3 or not any(found):
        raise argparse.ArgumentTypeError(f"must be three numbers such as 0,-1,0, not all 0, got {text!r}")
    return found


def _kinds(text: str) -> tuple[str, ...]:
    found = tuple(text.split(","))
    if unknown := [kind for kind in found if kind not in KINDS]:
        raise argparse.ArgumentTypeError(f"must be some of {','.join(KINDS)}, got {unknown[0]!r}")
    return found


def _board(text: str) -> tuple[int, int]:
    try:
        columns, rows = (int(word) for word in text.lower().split("x"))
    except ValueError:
        columns = rows = 0
    if columns < 2 or rows < 2:
        raise argparse.ArgumentTypeError(f"must be inner corners such as 9x6, got {text!r}")
    return columns, rows
