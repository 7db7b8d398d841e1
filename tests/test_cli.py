import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest

import jaxfuzzy.scene
from jaxfuzzy import arguments, cli, plot, report, table, terminal
from jaxfuzzy.matcher import Matcher
from jaxfuzzy.primitives import KINDS
from jaxfuzzy.rig import Rig, save_rig
from synthetic import SCHEMA, empty_scene, make_scene

COMMANDS = ("demo", "model", "shapes", "cluster", "calibrate")


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Runs a command in an empty folder and gives back exit status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        status = cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return status, out, err

    return call


@pytest.fixture
def modelled(monkeypatch):
    """Puts a finished scene in the place of the modelling and of the drawing; both have tests of their own."""
    asked = {}

    def model(*inputs, progress, **options):
        asked.update(inputs=inputs, options=options)
        progress("matching", 0.0)
        progress("objects", 0.5)
        return asked.get("scene") or make_scene()

    monkeypatch.setattr(jaxfuzzy.scene, "model_scene", model)
    monkeypatch.setattr(jaxfuzzy.scene, "model_cloud", model)
    monkeypatch.setattr(plot, "figures", lambda scene: {})
    return asked


def three_groups(path="points.csv", names=("width", "depth")):
    rng = np.random.default_rng(0)
    groups = (((0, 0), 100), ((1, 1), 60), ((2, 0), 30))
    points = np.concatenate([rng.normal(middle, 0.1, (count, 2)) for middle, count in groups])
    np.savetxt(path, points, delimiter=",", header=",".join(names), comments="")
    return points


def test_kinds_of_the_command_line_are_those_of_the_library():
    """Said twice, so that help needs no import of JAX."""
    assert arguments.KINDS == KINDS


def last_line(err):
    return err.strip().splitlines()[-1]


@pytest.mark.parametrize("words", [(), *((name,) for name in COMMANDS)])
def test_help_teaches(run, words):
    status, out, err = run(*words, "--help")
    assert (status, err) == (0, "")
    assert "example" in out
    assert "jaxfuzzy " + (words[0] if words else "demo") in out.split("example")[1]
    assert max(map(len, out.splitlines())) <= 120


def test_the_module_is_the_command_line():
    words = [sys.executable, "-m", "jaxfuzzy"]
    done = subprocess.run([*words, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"jaxfuzzy {jaxfuzzy.__version__}\n"
    failed = subprocess.run([*words, "model"], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert "Traceback" not in failed.stderr


def test_help_comes_without_drawing_or_modelling():
    code = "import sys, jaxfuzzy.arguments as a\na.parser(dict.fromkeys(%r))\n" % (COMMANDS,)  # noqa: UP031
    code += "print([m for m in ('matplotlib', 'k3d', 'tqdm') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_scene_on_the_terminal(run, modelled, tmp_path):
    status, out, err = run("demo", "--out", "found")
    assert status == 0
    lines = out.splitlines()
    assert lines[0].split() == ["object", "sizes", "points", "on", "surface"]
    assert lines[4].split() == ["3", "sphere", "radius", "70.0", "±", "2.0", "mm", "318", "90", "%"]
    assert "note: The supporting plane's residual is larger" in out
    assert "note on 2: An extent was not seen to its end" in out
    assert [line.split(": ")[1] for line in err.splitlines()[:3]] == ["matching", "objects", "writing"]
    assert "report.html" in last_line(err)
    assert report.load(tmp_path / "found").segmentation.k == 5
    assert modelled["inputs"][0].name == "im2.png"
    assert modelled["options"] == {}


def test_options_reach_the_pipeline(run, modelled):
    three_groups("cloud.csv", ("x", "y"))
    np.savetxt("cloud.xyz", np.random.default_rng(0).normal(size=(60, 3)))
    words = ("-k", "1:3", "--noise-distance", "0.01", "--kinds", "box,cone", "--up", "0,0,1", "--no-ground", "--paper")
    assert run("shapes", "cloud.xyz", *words)[0] == 0
    assert modelled["options"] == {
        "ks": (1, 2, 3), "noise_distance": 0.01, "kinds": ("box", "cone"), "up": (0.0, 0.0, 1.0), "ground": None,
        "rule": "paper",
    }  # fmt: skip
    for camera, place in (
        ("none", None),
        ("1,2,3.5", (1.0, 2.0, 3.5)),
        ("0,0,0", (0.0, 0.0, 0.0)),
        ("-.1,0,-2", (-0.1, 0.0, -2.0)),
    ):
        assert run("shapes", "cloud.xyz", "--camera", camera)[0] == 0
        assert modelled["options"] == {"camera": place}
    assert run("shapes", "cloud.xyz", "-k", "auto", "--up", "auto", "--noise-distance", "auto")[0] == 0
    assert modelled["options"] == {"ks": "auto", "noise_distance": "auto", "up": "auto"}
    assert run("shapes", "cloud.xyz", "--up", "-1,0,0")[0] == 0
    assert modelled["options"] == {"up": (-1.0, 0.0, 0.0)}


def test_where_an_error_came_from_is_shown_on_request(run, monkeypatch, capsys):
    assert run("shapes", "none.ply")[0] == 2
    monkeypatch.setenv("JAXFUZZY_TRACEBACK", "1")
    assert cli.main(["shapes", "none.ply"]) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert last_line(err) == "jaxfuzzy: cloud not found: none.ply"


def test_json_alone_on_standard_output(run, modelled):
    status, out, err = run("demo", "--json", "--quiet")
    assert (status, err) == (0, "")
    tree = json.loads(out)
    folder, files = tree.pop("folder"), tree["files"]
    assert folder == "out"
    assert "scene.json" in files
    jsonschema.validate(tree, SCHEMA)


def test_nothing_found_is_not_done(run, modelled, tmp_path):
    modelled["scene"] = empty_scene()
    status, out, err = run("demo")
    assert (status, out) == (1, "")
    assert "no object was found. The supporting plane's residual" in last_line(err)
    assert not list(tmp_path.iterdir())


def test_ctrl_c_leaves_nothing(run, modelled, monkeypatch, tmp_path):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(report.export, "glb", interrupt)
    status, out, err = run("demo")
    assert (status, out, last_line(err)) == (130, "", "jaxfuzzy: stopped")
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_said_before_computing(run, modelled, monkeypatch):
    monkeypatch.setattr(report.importlib.util, "find_spec", lambda name: None)
    status, _, err = run("demo")
    assert status == 0
    assert err.splitlines()[0] == (
        "jaxfuzzy: report.html and figures are left out: they need pip install 'jaxfuzzy[view]'"
    )
    assert not Path("out/report.html").exists()


def pictures(width=64, height=48, flat=False):
    import cv2

    rng = np.random.default_rng(0)
    for name in ("left.png", "right.png"):
        image = np.full((height, width, 3), 128) if flat else rng.integers(0, 255, (height, width, 3))
        cv2.imwrite(name, image.astype(np.uint8))
    save_rig("rig.json", Rig((60.0, 60.0), (31.5, 23.5), 0.1, (64, 48)))


def test_bad_stereo_input(run, tmp_path):
    pictures()
    Path("broken.png").write_bytes(Path("left.png").read_bytes()[:200])
    Path("empty.png").write_bytes(b"")
    Path("noise.png").write_bytes(b"no picture at all" * 100)
    Path("calib.txt").write_text(
        "cam0=[60 0 32; 0 60 24; 0 0 1]\ncam1=[60 0 32; 0 60 24; 0 0 1]\nwidth=64\nheight=48\n"
    )
    Path("text.json").write_text("not a rig")
    before = sorted(tmp_path.iterdir())
    for words, message in (
        (("missing.png", "right.png", "--rig", "rig.json"), "left image not found: missing.png"),
        (("broken.png", "right.png", "--rig", "rig.json"), "left is not an image that can be read"),
        (("left.png", "empty.png", "--rig", "rig.json"), "right image is empty: empty.png"),
        (("left.png", "noise.png", "--rig", "rig.json"), "right is not an image that can be read: noise.png"),
        (("left.png", ".", "--rig", "rig.json"), "right image must be a file, got the folder ."),
        (("left.png", "right.png", "--rig", "missing.json"), "rig not found: missing.json"),
        (("left.png", "right.png", "--rig", "calib.txt"), "holds no baseline"),
        (("left.png", "right.png", "--rig", "text.json"), "rig text.json"),
        (("left.png", "right.png", *("--rig", "rig.json") * 3), "--rig takes one or two files, got 3"),
        (
            ("left.png", "right.png", "--rig", "rig.json", "--out", "left.png"),
            "out must be a folder, got the file left.png",
        ),
        (("left.png", "right.png", "--rig", "rig.json", "--out", "left.png/a"), "cannot write to left.png/a"),
        (("left.png", "right.png"), "the following arguments are required: --rig; see jaxfuzzy model --help"),
        (("left.png", "right.png", "--rig", "rig.json", "--kinds", "torus"), "must be some of plane,box,"),
        (("left.png", "right.png", "--rig", "rig.json", "--noise-distance", "0"), "must be a length above 0, got '0'"),
        (("left.png", "right.png", "--rig", "rig.json", "-k", "3:1"), "must be a number, a range such as 2:5"),
    ):
        status, out, err = run("model", *words)
        assert (status, out) == (2, ""), err
        assert message in last_line(err)
        assert sorted(tmp_path.iterdir()) == before


def test_a_rig_in_two_files_and_another_unit(run, monkeypatch):
    from jaxfuzzy import scene
    from jaxfuzzy.checks import DataError

    rigs = []

    def model_scene(left, right, rig, **_):
        rigs.append(rig)
        raise DataError("seen enough")

    monkeypatch.setattr(scene, "model_scene", model_scene)
    camera = "%YAML:1.0\n---\nM{0}: [[60, 0, 32], [0, 60, 24], [0, 0, 1]]\nD{0}: [0, 0, 0, 0, 0]\n"
    Path("intrinsics.yml").write_text(camera.format(1) + camera.format(2).removeprefix("%YAML:1.0\n---\n"))
    Path("extrinsics.yml").write_text("%YAML:1.0\n---\nR: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nT: [-120, 0, 0]\n")
    words = ("model", "left.png", "right.png", "--rig", "intrinsics.yml", "--rig", "extrinsics.yml", "--unit", "0.001")
    assert run(*words)[0] == 1
    assert not rigs[0].rectified
    assert abs(rigs[0].baseline_m - 0.12) < 1e-12
    Path("calib.txt").write_text("cam0=[60 0 32; 0 60 24; 0 0 1]\n")
    assert run("model", "left.png", "right.png", "--rig", "calib.txt", "--arbitrary-units")[0] == 1
    assert not rigs[1].metric


def test_pairs_that_do_not_agree(run, tmp_path):
    pictures(64, 40)
    save_rig("rig.json", Rig((60.0, 60.0), (31.5, 23.5), 0.1, (64, 48)))
    status, out, err = run("model", "left.png", "right.png", "--rig", "rig.json")
    assert (status, out) == (2, "")
    assert "images must have the size the rig is for, 64 x 48, got 64 x 40" in last_line(err)
    Path("left.png").rename("small.png")
    pictures()
    status, out, err = run("model", "small.png", "right.png", "--rig", "rig.json")
    assert (status, out) == (2, "")
    assert "left and right must have the same size, got 64 x 40 and 64 x 48" in last_line(err)
    assert not (tmp_path / "out").exists()


def test_a_pair_without_texture_cannot_be_modelled(run, tmp_path):
    pictures(flat=True)
    status, out, err = run("model", "left.png", "right.png", "--rig", "rig.json")
    assert (status, out) == (1, "")
    assert "pixels were matched, 50 are needed" in last_line(err)
    assert not (tmp_path / "out").exists()


def test_bad_clouds(run, tmp_path):
    Path("empty.ply").write_bytes(b"")
    Path("cut.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n0000"
    )
    Path("two.csv").write_text("1,2\n3,4\n")
    np.save("objects.npy", np.array([print], object), allow_pickle=True)
    np.savetxt("few.xyz", np.random.default_rng(0).normal(size=(9, 3)) + [0, 0, 2])
    before = sorted(tmp_path.iterdir())
    for words, status, message in (
        (("missing.ply",), 2, "cloud not found: missing.ply"),
        (("empty.ply",), 2, "cloud is empty: empty.ply"),
        (("cut.ply",), 2, "cloud cut.ply"),
        (("two.csv",), 2, "must have at least three columns"),
        (("objects.npy",), 2, "holds Python objects"),
        (("few.xyz", "--up", "0,0,0"), 2, "must be three numbers such as 0,-1,0, not all 0, got '0,0,0'"),
        (("few.xyz", "--no-ground"), 2, "--no-ground needs --up X,Y,Z"),
        (("few.xyz", "--camera", "1,2"), 2, "must be three numbers such as 0,0,1.5, or none, got '1,2'"),
        (("few.xyz", "--up", "0,1,0", "--no-ground"), 1, "9 of 9 points"),
    ):
        found, out, err = run("shapes", *words)
        assert (found, out) == (status, ""), err
        assert message in last_line(err)
        assert sorted(tmp_path.iterdir()) == before


def test_cluster_finds_the_groups(run):
    points = three_groups()
    status, out, err = run("cluster", "points.csv", "--sizes", "--out", "labels.csv")
    assert status == 0
    assert last_line(err) == "jaxfuzzy: wrote labels.csv"
    lines = out.splitlines()
    assert lines[0].startswith("vrc: k = 2 ")
    assert [line.split()[2] for line in lines[2:]] == ["100", "30", "60"]
    rows = list(csv.DictReader(Path("labels.csv").read_text().splitlines()))
    assert list(rows[0]) == ["width", "depth", "label", "membership_0", "membership_1", "membership_2", "noise"]
    assert len(rows) == len(points)
    # Written with nine digits.
    assert float(rows[7]["depth"]) == pytest.approx(points[7, 1], rel=1e-8)
    total = sum(float(rows[7][name]) for name in list(rows[0])[3:])
    assert total == pytest.approx(1, abs=1e-8)
    assert {row["label"] for row in rows[:100]} == {"0"}


def test_cluster_in_other_words(run):
    points = three_groups()
    status, out, err = run("cluster", "points.csv", "-k", "3", "--json", "--quiet", "--out", "labels.npz")
    assert (status, err) == (0, "")
    tree = json.loads(out)
    assert tree["k"] == 3
    assert tree["columns"] == ["width", "depth"]
    assert sorted(tree["counts"]) == [30, 60, 100]
    assert len(tree["labels"]) == len(points)
    written = np.load("labels.npz")
    assert written["labels"].tolist() == tree["labels"]
    np.testing.assert_allclose(written["memberships"].sum(1), 1, atol=1e-12)

    status, out, _ = run("cluster", "points.csv", "-k", "3", "--noise-distance", "0.2", "--out", "labels.json")
    assert status == 0
    assert "noise: " in out
    assert json.loads(Path("labels.json").read_text())["columns"][-1] == "noise"
    status, out, _ = run("cluster", "points.csv", "--json", "--rule", "best", "--index", "xie_beni")
    assert (status, json.loads(out)["k"], json.loads(out)["index"]) == (0, 3, "xie_beni")
    # The same k alone: of one candidate no index is taken.
    whole, (status, out, _) = json.loads(out), run("cluster", "points.csv", "--json", "-k", "3")
    assert (status, json.loads(out)["index"]) == (0, None)
    # Two starts from the same seeds, one of them padded.
    np.testing.assert_allclose(json.loads(out)["centers"], whole["centers"], atol=1e-5)


def test_bad_tables(run, tmp_path):
    three_groups()
    Path("iris.csv").write_text("a,b,species\n1,2,setosa\n3,4,virginica\n")
    Path("empty.csv").write_text("")
    Path("names.csv").write_text("a,b\n")
    Path("ragged.csv").write_text("1,2\n3\n")
    Path("nan.csv").write_text("1,2\n3,nan\n4,5\n")
    Path("binary.csv").write_bytes(b"\0\1\2" * 99)
    Path("latin.csv").write_bytes("1,2\n3,ü\n".encode("latin-1"))
    np.save("whole.npy", np.zeros((5, 2)))
    Path("cut.npy").write_bytes(Path("whole.npy").read_bytes()[:100])
    np.save("cube.npy", np.zeros((2, 2, 2)))
    np.savez("two.npz", a=np.zeros((5, 2)), b=np.zeros(3))
    before = sorted(tmp_path.iterdir())
    for words, message in (
        (("missing.csv",), "points not found: missing.csv"),
        ((".",), "points must be a file, got the folder ."),
        (("empty.csv",), "points is empty: empty.csv"),
        (("names.csv",), "points names.csv holds names but no points"),
        (("ragged.csv",), "points ragged.csv has 2 columns, but not in line 2"),
        (("nan.csv", "-k", "2"), "points must be finite, got 1 non-finite rows, the first at index 1"),
        (("iris.csv",), "has 'setosa' in column species, line 2, which is not a number; choose others by --columns"),
        (("iris.csv", "--columns", "a,c"), "has no column 'c', only a, b, species"),
        (("binary.csv",), "is in no known format"),
        (("latin.csv",), "is no UTF-8 text"),
        (("cut.npy",), "is damaged, cut short"),
        (("cube.npy",), "must hold real numbers of shape (N, D)"),
        (("two.npz",), "must hold an array 'points' or a single one, got a, b"),
        (("points.csv", "-k", "500"), "k must be at least 1 and at most 190 (the number of points), got 500"),
        (("points.csv", "-k", "0"), "must be a number, a range such as 2:5, or a list such as 2,4, got '0'"),
        (("points.csv", "-k", "two"), "got 'two'"),
        (("points.csv", "-k", "auto"), "got 'auto'"),
        (("points.csv", "-k", "2:99999999999"), "must be at most 1000 numbers"),
        (("points.csv", "-k", "1:3"), "ks must not hold 1 for index='vrc'"),
        (("points.csv", "-m", "1"), "m must be a finite number above 1.0, got 1.0"),
        (("points.csv", "-m", "nan"), "m must be a finite number above 1.0, got nan"),
        (("points.csv", "-m", "many"), "argument -m: invalid float value: 'many'"),
        (("points.csv", "--index", "elbow"), "index must be one of 'vrc', "),
        (("points.csv", "-k", "3", "--index", "elbow"), "index must be one of 'vrc', "),
        (("points.csv", "-k", "3", "--rule", "mine"), "rule must be one of 'paper', 'best', got 'mine'"),
        (("points.csv", "--rule", "mine"), "rule must be one of 'paper', 'best', got 'mine'"),
        (("points.csv", "--noise-distance", "inf"), "must be a length above 0, got 'inf'"),
        (("points.csv", "--out", "labels.txt"), "out must end in one of .csv, .json, .npz, got labels.txt"),
        (("points.csv", "--out", "points.csv"), "out must not be the input, got points.csv"),
        (("points.csv", "--out", "nowhere/labels.csv"), "out must be in an existing folder"),
    ):
        status, out, err = run("cluster", *words)
        assert (status, out) == (2, ""), (words, err)
        assert message in last_line(err)
        assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("text", "names", "rows"),
    [
        ("a;b\n1;2\n", ["a", "b"], [[1, 2]]),
        ("1 2  3\n# remark\n4 5 6\n\n", ["x0", "x1", "x2"], [[1, 2, 3], [4, 5, 6]]),
        ("\ufeffa\tb\n1\t2e3\n", ["a", "b"], [[1, 2000]]),
        ('"a, b",c\n1,2\r\n', ["a, b", "c"], [[1, 2]]),
        ("5\n7\n", ["x0"], [[5], [7]]),
    ],
)
def test_tables_people_have(tmp_path, text, names, rows):
    (tmp_path / "t.csv").write_bytes(text.encode())
    found, points = table.read_points(tmp_path / "t.csv")
    assert found == names
    assert points.tolist() == rows


def test_clouds_are_tables_too(tmp_path):
    from jaxfuzzy.cloud import Cloud, write_cloud

    points = np.random.default_rng(0).normal(size=(5, 3))
    write_cloud(tmp_path / "c.ply", Cloud(points, np.zeros((5, 3))))
    names, found = table.read_points(tmp_path / "c.ply")
    assert names == ["x", "y", "z"]
    np.testing.assert_array_equal(found, points)
    assert table.read_points(tmp_path / "c.ply", ["red", "2"])[0] == ["red", "z"]


def test_calibrate(run, shared_data):
    folder = shared_data / "opencv_chessboard"
    numbers = ("01", "03", "05", "06")
    left, right = ([folder / f"{side}{n}.jpg" for n in numbers] for side in ("left", "right"))
    status, out, _ = run("calibrate", *left, "--right", *right, "--square", "0.025", "--out", "rig.json")
    assert status == 0
    assert "baseline 8" in out  # 3.34 squares of 25 mm, as OpenCV's own sample finds
    assert "over 4 pairs" in out
    assert json.loads(Path("rig.json").read_text())["schema"] == "jaxfuzzy/rig"
    status, out, err = run("calibrate", *left, "--right", *right, "--square", "0.025", "--json", "--quiet")
    assert (status, err) == (0, "")
    # What is printed is what the file holds, so that either can be given to --rig.
    assert json.loads(out) == json.loads(Path("rig.json").read_text())


def test_ready_disparities_and_resized_pictures_reach_the_pipeline(run, modelled):
    pictures(128, 96)
    np.save("map.npy", np.full((96, 128), 160.0))
    words = ("model", "left.png", "right.png", "--rig", "rig.json", "--resized", "--up", "0,-1,0")
    assert run(*words)[0] == 0
    assert modelled["inputs"][2].image_size == (128, 96)
    assert modelled["inputs"][2].focal_px == (120.0, 120.0)
    assert modelled["options"] == {"up": (0.0, -1.0, 0.0)}
    assert run(*words, "--disparity", "map.npy", "--disparity-scale", "16")[0] == 0
    assert (modelled["options"]["disparity_px"] == 10).all()
    cv2.imwrite("depth.png", np.full((96, 128), 1500, np.uint16))
    assert run("model", "left.png", *words[3:], "--depth", "depth.png", "--depth-scale", "1000")[0] == 0
    assert modelled["inputs"][1] is None
    assert (modelled["options"]["depth_m"] == 1.5).all()
    assert run(*words, "--min-disparity", "-16", "--disparities", "48")[0] == 0
    assert modelled["options"]["matcher"] == Matcher(min_disparity=-16, disparities=48)
    np.save("raw.npy", np.full((96, 128), 160, np.int16))
    for more, says in (
        (("--disparity", "none.pfm"), "disparity not found: none.pfm"),
        (("--depth", "none.png"), "depth not found: none.png"),
        (("--disparity", "raw.npy"), "is OpenCV's fixed point: give scale=16, or --disparity-scale 16"),
        (("--disparities", "40"), "disparities must be a multiple of 16, got 40"),
    ):
        status, _, err = run(*words, *more)
        assert status == 2
        assert says in last_line(err)
    status, _, err = run("model", "left.png", *words[3:])
    assert status == 2
    assert "RIGHT must be given, unless --disparity or --depth is" in last_line(err)


def test_no_photograph_is_overwritten(run, tmp_path):
    pictures()
    before = Path("left.png").read_bytes()
    words = ("left.png", "--right", "right.png", "--square", "0.02", "--out", "left.png")
    status, _, err = run("calibrate", *words)
    assert status == 2
    assert "out must not be the input, got left.png" in last_line(err)
    assert Path("left.png").read_bytes() == before


def test_bad_calibration(run, tmp_path):
    pictures()
    before = sorted(tmp_path.iterdir())
    pair = ("left.png", "--right", "right.png", "--square", "0.02")
    for words, status, message in (
        (("left.png", "--right", "right.png"), 2, "the following arguments are required: --square"),
        (("left.png", "--right", "right.png", "left.png", "--square", "0.02"), 2, "must be pairs, got 1 and 2"),
        (("left.png", "--right", "right.png", "--square", "-1"), 2, "must be a length above 0, got '-1'"),
        ((*pair, "--board", "9"), 2, "must be inner corners such as 9x6, got '9'"),
        ((*pair, "--out", "nowhere/rig.json"), 2, "out must be in an existing folder"),
        ((*pair, "--out", "."), 2, "out must be a file, got the folder ."),
        ((*pair, "--out", "rig.pdf"), 2, "out must end in one of .json, .yml, .yaml, .xml for cameras"),
        ((*pair, "--out", "rig.txt"), 2, "that are not rectified, got .txt"),
        (("missing.png", "--right", "right.png", "--square", "0.02"), 2, "missing.png"),
        (pair, 1, "was found in 0 of 1 pairs"),
    ):
        found, out, err = run("calibrate", *words)
        assert (found, out) == (status, ""), (words, err)
        assert message in last_line(err)
        assert sorted(tmp_path.iterdir()) == before


def test_unknown_words(run):
    for words in ((), ("frobnicate",), ("demo", "--frobnicate"), ("demo", "extra")):
        status, out, err = run(*words)
        assert (status, out) == (2, "")
        assert len(err.splitlines()) == 1
        assert err.rstrip().endswith("--help")


def test_errors_of_the_program_itself_are_not_hidden(run, modelled, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a fault of ours")

    monkeypatch.setattr(jaxfuzzy.scene, "model_scene", broken)
    with pytest.raises(RuntimeError):
        cli.main(["demo"])


def test_warnings_become_lines(run, modelled, monkeypatch):
    import warnings

    def warn(*_, **__):
        warnings.warn("the baseline is\n  odd", stacklevel=2)
        warnings.warn("for programmers", DeprecationWarning, stacklevel=2)
        return make_scene()

    monkeypatch.setattr(jaxfuzzy.scene, "model_scene", warn)
    _, _, err = run("demo")
    assert "jaxfuzzy: warning: the baseline is odd" in err
    assert "programmers" not in err


def test_a_terminal_gets_a_bar(monkeypatch):
    class Terminal(io.StringIO):
        encoding = "utf-8"

        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    with terminal.Progress(quiet=False) as progress:
        progress("matching", 0.0)
        progress("shapes", 0.5)
        progress("shapes", 0.4)
        assert progress.bar.n == 0.5, "a share never goes back"
        shown = sys.stderr.getvalue()
        time.sleep(1.5)
        assert len(sys.stderr.getvalue()) > len(shown), "the clock must go on through a long stage"
    assert "shapes" in shown
    assert "50 %" in shown
    assert "left" in shown
    assert "\n" not in shown
    monkeypatch.setattr(sys, "stderr", Terminal())
    with terminal.Progress(quiet=True) as progress:
        progress("matching", 0.0)
    assert sys.stderr.getvalue() == ""


def test_terminals_of_other_encodings(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    terminal.show("half-angle (19.8 ± 0.3)° 漢")
    stream.flush()
    assert stream.buffer.getvalue() == b"half-angle (19.8 +- 0.3) deg ?\n"


def environment(tmp_path):
    # A cache folder named in the environment would be taken before the user's own.
    inherited = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    return inherited | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}


def test_the_process_itself(tmp_path):
    """One real process: exit status, compiled code kept in the user's cache folder, a reader who leaves early."""
    three_groups(tmp_path / "points.csv")
    command = [sys.executable, "-m", "jaxfuzzy.cli", "cluster", "points.csv", "-k", "3", "--json"]
    where = {"cwd": tmp_path, "env": environment(tmp_path), "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, **where)
    process.stdout.close()
    err = process.stderr.read().decode()
    process.stderr.close()
    assert process.wait(120) == 0
    assert err == "jaxfuzzy: fitting\n"
    assert any((tmp_path / "cache" / "jaxfuzzy").iterdir())


@pytest.fixture
def interrupts():
    """In the background of a shell interrupts are ignored, and would be by a child too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_being_stopped_in_a_real_process(tmp_path, how):
    command = [sys.executable, "-m", "jaxfuzzy.cli", "demo", "--out", "found"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment(tmp_path), stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr.readline() == "jaxfuzzy: matching\n"
        time.sleep(0.5)
        process.send_signal(how)
        rest = process.stderr.read()
        assert process.wait(300) == 130
    assert "Traceback" not in rest
    assert last_line(rest) == "jaxfuzzy: stopped"
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
