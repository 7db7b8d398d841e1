import dataclasses
import json
import struct
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
import trimesh

from jaxfuzzy import drawing, export, plot, report
from jaxfuzzy.cloud import read_cloud
from jaxfuzzy.primitives import Box, Sphere
from jaxfuzzy.shapes import Shape
from synthetic import AWAY, RIG, RIGHT, SCHEMA, UP, bodies, empty_scene, make_scene, odd_scene

WRITTEN = {"arrays.npz", "cloud.ply", "model.glb", "model.obj", "rig.json", "scene.json"}


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(scope="module")
def saved(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "a" / "out"
    assert set(report.save(scene, folder, view=False)) == WRITTEN
    return folder


@pytest.mark.parametrize("make", [make_scene, odd_scene, empty_scene])
def test_json_is_as_published(make):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(report.to_dict(make()), SCHEMA)


def test_schema_refuses_what_is_wrong(scene):
    tree = report.to_dict(scene)
    tree["shapes"][1]["parameters"].pop("size")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(tree, SCHEMA)


def test_json_says_what_was_found(saved):
    tree = json.loads((saved / "scene.json").read_text())
    jsonschema.validate(tree, SCHEMA)
    assert set(tree["files"]) == WRITTEN
    assert [shape["kind"] for shape in tree["shapes"]] == ["cone", "box", "cylinder", "sphere", "cone"]
    sphere = tree["shapes"][3]
    assert sphere["parameters"]["radius"] == 0.07
    assert sphere["sizes"][0] == {
        "name": "radius", "value": 0.07, "deviation": 0.002, "angle": False, "lower_bound": False,
    }  # fmt: skip
    assert sphere["scores"]["sphere"] == 1.0
    assert tree["shapes"][0]["scores"]["sphere"] is None  # it was infinite
    assert tree["settings"]["kinds"] == ["box", "cone"]
    assert tree["outliers"] + sum(shape["points"] for shape in tree["shapes"]) == tree["points"]
    assert "slab" in tree["reasons"][0]


def test_lists_of_numbers_stand_on_one_line(saved):
    assert '"up": [0.0, -0.9063077870366499, -0.42261826174069944]' in (saved / "scene.json").read_text()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("make", [make_scene, odd_scene, empty_scene])
def test_load_undoes_save(make, dtype, tmp_path):
    scene = jax.tree.map(lambda x: jnp.asarray(x, dtype) if getattr(x, "dtype", None) == np.float64 else x, make())
    report.save(scene, tmp_path / "out", view=False)
    back = report.load(tmp_path / "out")
    assert jax.tree.structure(scene.shapes) == jax.tree.structure(back.shapes)
    for name in ("cloud", "segmentation", "shapes", "up", "ground", "image", "image_right", "timings", "status"):
        old, new = jax.tree.leaves(getattr(scene, name)), jax.tree.leaves(getattr(back, name))
        assert len(old) == len(new), name
        for a, b in zip(old, new, strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=name)
    assert back.cloud.points.dtype == dtype
    assert all(leaf.dtype == dtype for s in back.shapes if s.primitive for leaf in jax.tree.leaves(s.covariance))
    assert back.rig == scene.rig
    assert back.segmentation.k == scene.segmentation.k
    assert isinstance(back.segmentation.k, int)
    assert back.settings["ks"] == "auto"


def test_settings_of_an_odd_type_are_refused(scene, tmp_path):
    with pytest.raises(TypeError, match="settings must be numbers, text, lists and dicts of them, got object"):
        report.save(dataclasses.replace(scene, settings={"a": object()}), tmp_path / "out", view=False)
    assert not list(tmp_path.iterdir())


def test_ply_holds_what_was_found_of_each_point(scene, saved):
    found = trimesh.load(saved / "cloud.ply").metadata["_ply_raw"]["vertex"]["data"]
    points, labels = np.asarray(scene.cloud.points), np.asarray(scene.segmentation.labels)
    np.testing.assert_array_equal(np.stack([found[n].ravel() for n in "xyz"], 1), points)
    np.testing.assert_array_equal(found["object"].ravel(), labels)
    kinds = {number: kind for kind, number in export.KIND_NUMBERS.items()}
    assert [kinds[found["kind"].ravel()[labels == i][0]] for i in range(5)] == [s.kind for s in scene.shapes]
    assert np.all(found["kind"].ravel()[labels < 0] == 0)
    residual = found["residual"].ravel()
    assert np.all(np.isnan(residual) == (labels < 0))
    ball = bodies()[3]
    expected = np.abs(np.linalg.norm(points[labels == 3] - np.asarray(ball.center), axis=1) - 0.07)
    # Two ways to the same difference of numbers near 1.
    np.testing.assert_allclose(residual[labels == 3], expected, atol=1e-14)
    memberships = np.asarray(scene.segmentation.partition.memberships)
    np.testing.assert_array_equal(found["membership"].ravel()[labels == 2], memberships[labels == 2, 2])
    assert np.all(found["membership"].ravel()[labels < 0] == 0)
    assert found["inlier"].ravel()[labels == 1].sum() == np.asarray(scene.shapes[1].inliers).sum()
    again = read_cloud(saved / "cloud.ply")
    np.testing.assert_allclose(again.pixels_px, scene.cloud.pixels_px)


def test_distances_do_not_depend_on_padding():
    box, points = bodies()[1], np.random.default_rng(1).normal(size=(1500, 3))
    alone = [float(box.distance(jnp.asarray(points[i : i + 1]))[0]) for i in (0, 7, 1499)]
    assert np.asarray(export.distances(box, points))[[0, 7, 1499]].tolist() == pytest.approx(alone, rel=1e-14)
    assert export.distances(box, points[:0]).shape == (0,)


def upright(points):
    """Right, up, towards the camera: written out by hand for the scene's own frame."""
    return np.asarray(points) @ np.stack([RIGHT, UP, -AWAY]).T


def test_glb_opens_elsewhere(scene, saved):
    found = trimesh.load(saved / "model.glb")
    assert set(found.geometry) == {"ground", *(f"object {drawing.name(i, s)}" for i, s in enumerate(scene.shapes))}
    ball = found.geometry["object 3 sphere"]
    assert ball.is_watertight
    # float32 vertices of a sphere of 48 sides
    np.testing.assert_allclose(ball.bounds.mean(0), upright(bodies()[3].center), atol=1e-6)
    box = found.geometry["object 1 box"]
    assert box.volume == pytest.approx(0.14 * 0.12 * 0.1, rel=1e-5)
    tube = found.geometry["object 2 cylinder"]
    assert tube.extents[1] == pytest.approx(0.15, abs=1e-6)  # it stands along y
    assert found.geometry["ground"].face_normals[0] == pytest.approx([0, 1, 0], abs=1e-6)
    blue = np.array([0x00, 0x72, 0xB2]) / 255
    linear = np.where(blue <= 0.04045, blue / 12.92, ((blue + 0.055) / 1.055) ** 2.4)
    shown = found.geometry["object 0 cone"].visual.material.baseColorFactor
    assert np.asarray(shown[:3]) == pytest.approx(np.rint(linear * 255), abs=1)


def test_glb_keeps_the_rules_of_the_format(saved):
    data = (saved / "model.glb").read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON"
    assert size % 4 == 0
    tree = json.loads(data[20 : 20 + size])
    rest, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    assert kind == b"BIN\0"
    assert rest == tree["buffers"][0]["byteLength"] == len(data) - size - 28
    for accessor in tree["accessors"]:
        view = tree["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width = {"VEC3": 12, "SCALAR": 4}[accessor["type"]]
        assert accessor["count"] * width == view["byteLength"]
        if accessor["type"] == "VEC3":
            start = 28 + size + view["byteOffset"]
            values = np.frombuffer(data[start : start + view["byteLength"]], "<f4").reshape(-1, 3)
            assert values.min(0).tolist() == pytest.approx(accessor["min"], rel=1e-7)
    assert tree["nodes"][1]["extras"]["kind"] == "box"


def test_glb_without_objects_is_still_a_file():
    bare = dataclasses.replace(empty_scene(), ground=None)
    assert trimesh.load(trimesh.util.wrap_as_stream(export.glb(bare)), file_type="glb").is_empty
    assert export.obj(bare).count("\n") == 1


def test_obj_opens_elsewhere(scene, saved):
    text = (saved / "model.obj").read_text()
    assert [line[2:] for line in text.splitlines() if line.startswith("o ")][1] == "object_1_box"
    whole = trimesh.load(saved / "model.obj", force="mesh")
    expected = sum(len(drawing.mesh(s.primitive)[1]) for s in scene.shapes) + 2
    assert len(whole.faces) == expected
    faces = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("f ")], int)
    assert faces.min() == 1
    assert faces.max() == text.count("\nv ")


def files(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in Path(folder).rglob("*") if p.is_file()}


class Broken(RuntimeError):
    pass


@pytest.mark.parametrize("error", [Broken, KeyboardInterrupt, OSError(28, "No space left on device")])
def test_nothing_is_left_of_a_failed_run(scene, tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(export, "glb", fail)
    with pytest.raises(OSError if isinstance(error, OSError) else error) as caught:
        report.save(scene, tmp_path / "a" / "out", view=False)
    assert not list(tmp_path.iterdir())
    if isinstance(error, OSError):
        assert str(caught.value) == f"cannot write to {tmp_path}/a/out: No space left on device"


def test_an_earlier_run_is_replaced_and_strangers_stay(scene, tmp_path):
    out = tmp_path / "out"
    report.save(scene, out, view=False)
    (out / "notes.txt").write_text("mine")
    (out / "figures").mkdir()
    (out / "figures" / "mine.png").write_bytes(b"mine")
    stale = json.loads((out / "scene.json").read_text())
    stale["files"] += ["report.html", "figures/old.png", "../outside.txt", "/etc/hostname"]
    (out / "scene.json").write_text(json.dumps(stale))
    (out / "report.html").write_text("of the earlier run")
    (out / "figures" / "old.png").write_bytes(b"old")
    (tmp_path / "outside.txt").write_text("not ours, whatever the file says")
    report.save(dataclasses.replace(scene, settings={"second": True}), out, view=False)
    assert report.load(out).settings == {"second": True}
    assert set(files(out)) == WRITTEN | {"notes.txt", "figures/mine.png"}
    assert (tmp_path / "outside.txt").exists()
    assert {p.name for p in tmp_path.iterdir()} == {"out", "outside.txt"}


@pytest.mark.parametrize("after", range(0, 12, 3))
def test_a_failure_while_moving_is_rolled_back(scene, tmp_path, monkeypatch, after):
    out = tmp_path / "out"
    report.save(scene, out, view=False)
    (out / "notes.txt").write_text("mine")
    before, replace, moved = files(out), Path.replace, []

    def fail_once(self, target):
        moved.append(self)
        if len(moved) == after + 1:
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", fail_once)
    with pytest.raises(KeyboardInterrupt):
        report.save(dataclasses.replace(scene, settings={}), out, view=False)
    assert files(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["cloud.ply", "scene.json", "report.html"])
def test_a_stranger_of_the_same_name_is_not_overwritten(scene, tmp_path, name):
    (tmp_path / name).write_text('{"mine": 1}')
    for attempt in (report.check_folder, lambda folder: report.save(scene, folder, view=False)):
        with pytest.raises(FileExistsError, match=f"holds {name}, which no earlier run wrote: choose another folder"):
            attempt(tmp_path)
    assert files(tmp_path) == {name: b'{"mine": 1}'}


@pytest.mark.parametrize("place", ["file", "file/below", "/proc/nowhere"])
def test_places_that_cannot_be_written(scene, tmp_path, place):
    (tmp_path / "file").write_text("a file")
    for attempt in (report.check_folder, lambda folder: report.save(scene, folder, view=False)):
        with pytest.raises(OSError, match=r"must be a folder, got the file|cannot write to") as caught:
            attempt(tmp_path / place)
        assert "\n" not in str(caught.value)
    assert files(tmp_path) == {"file": b"a file"}


def test_looking_leaves_no_trace(tmp_path):
    report.check_folder(tmp_path / "a" / "out")
    assert not list(tmp_path.iterdir())


def test_folders_are_as_open_as_others(scene, saved):
    assert saved.stat().st_mode & 0o777 == saved.parent.stat().st_mode & 0o777


def test_load_says_what_is_missing_or_damaged(saved, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no scene\.json in"):
        report.load(tmp_path)

    def damaged(name, data):
        for file, content in files(saved).items():
            (tmp_path / file).write_bytes(data if file == name else content)
        return tmp_path

    tree = json.loads((saved / "scene.json").read_text())
    for change, message in (
        (b"{", "is not valid JSON"),
        (b"[]", "is JSON of another kind: schema must be 'jaxfuzzy/scene'"),
        (json.dumps(tree | {"version": 99}).encode(), "has version 99, only 1 is known here"),
        (json.dumps(tree | {"shapes": [{"object": 0}]}).encode(), "is damaged"),
        (json.dumps({k: v for k, v in tree.items() if k != "up"}).encode(), "is damaged"),
        (json.dumps({k: v for k, v in tree.items() if k != "files"}).encode(), "does not list its files"),
    ):
        with pytest.raises(ValueError, match=message):
            report.load(damaged("scene.json", change))
    whole = (saved / "arrays.npz").read_bytes()
    for change in (whole[: len(whole) // 2], b"", b"no zip"):
        with pytest.raises(ValueError, match="is damaged"):
            report.load(damaged("arrays.npz", change))
    damaged("", b"")
    (tmp_path / "arrays.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"lacks arrays\.npz"):
        report.load(tmp_path)


def test_nothing_is_unpickled(saved, tmp_path):
    for file, content in files(saved).items():
        (tmp_path / file).write_bytes(content)
    arrays = dict(np.load(saved / "arrays.npz"))
    np.savez(tmp_path / "arrays.npz", **arrays | {"cloud.points": np.array([print], object)})
    with pytest.raises(ValueError, match="is damaged"):
        report.load(tmp_path)


def test_without_the_view_extra(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(report.importlib.util, "find_spec", lambda name: None)
    assert not report.can_draw()
    assert set(report.save(scene, tmp_path / "out")) == WRITTEN
    monkeypatch.setitem(sys.modules, "k3d", None)
    monkeypatch.setattr(plot, "figures", lambda scene: {})
    with pytest.raises(ModuleNotFoundError):
        report.save(scene, tmp_path / "other", view=True)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_drawing_is_imported_on_use_only():
    code = "import sys, jaxfuzzy.report, jaxfuzzy.page, jaxfuzzy.plot, jaxfuzzy.cli\n"
    code += "print([name for name in ('matplotlib', 'k3d', 'PIL', 'tqdm') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_measures_by_hand():
    box = Box(np.zeros(3), np.array([0.1, 2.0, 0.3]), np.eye(3), np.array([True, True, False]))
    covariance = np.diag([1.0, 1.0, 1.0, 4e-8, 1e-4, 9e-12, 0.0, 0.0, 0.0])
    fields = {"inliers": np.ones(3, bool), "noise_distance": 0.01, "scores": {}, "margin": 0.0, "counts": {}}
    shape = Shape(primitive=box, covariance=covariance, status=jnp.asarray(0), kind="box", **fields)
    expected = "edge 1 100.0 ± 0.20 mm, edge 2 2.000 ± 0.010 m, edge 3 at least 300.0000 ± 0.0030 mm"
    assert drawing.size_text(shape) == expected.replace("100.0 ±", "100.00 ±")
    assert drawing.size_text(shape, metric=False).startswith("edge 1 0.10000 ± 0.00020 units")
    ball = Shape(
        primitive=Sphere(np.zeros(3), np.array(0.05)), covariance=np.full((4, 4), np.inf), status=jnp.asarray(0),
        kind="sphere", **fields,
    )  # fmt: skip
    assert drawing.size_text(ball) == "radius 50.0 mm"


def test_rig_and_photograph_come_back(saved):
    back = report.load(saved)
    assert back.rig == RIG
    assert back.image.dtype == np.uint8
