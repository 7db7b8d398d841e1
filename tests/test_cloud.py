"""Point-cloud files: every format by hand, every way of being damaged, and real clouds."""

import io
import pickle
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfuzzy.cloud import Cloud, read_cloud, write_cloud
from jaxfuzzy.cloudfiles import parse

POINTS = np.array([[0.1, -0.2, 1.5], [1e-7, 3.25, 2.0], [-7.0, 0.0, 1e6]], np.float32)
COLORS = np.array([[255, 0, 51], [1, 2, 3], [0, 255, 0]], np.uint8)


def full_cloud():
    return Cloud(
        points=jnp.asarray(POINTS),
        colors=jnp.asarray(COLORS / 255, jnp.float32),
        depth_std=jnp.asarray([0.001, 0.002, 0.003], jnp.float32),
        pixels_px=jnp.asarray([[0, 1], [2, 3], [4, 5.5]], jnp.float32),
    )


def put(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".csv"])
def test_a_cloud_comes_back_as_it_was(tmp_path, suffix, ascii):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(
        path, full_cloud(), extra={"object": np.array([0, -1, 2]), "kept": np.array([True, False, True])}, ascii=ascii
    )
    back = read_cloud(path)
    # Text has the shortest digits that read back as the same float32, so nothing is lost in any format.
    np.testing.assert_array_equal(np.asarray(back.points, np.float32), POINTS)
    np.testing.assert_array_equal(np.rint(np.asarray(back.colors) * 255), COLORS)
    np.testing.assert_array_equal(back.depth_std, full_cloud().depth_std)
    np.testing.assert_array_equal(back.pixels_px, full_cloud().pixels_px)
    columns = parse(path.read_bytes())
    np.testing.assert_array_equal(columns["object"], [0, -1, 2])
    np.testing.assert_array_equal(columns["kept"], [1, 0, 1])


@pytest.mark.parametrize(("suffix", "colored"), [(".npy", False), (".xyz", True), (".txt", True)])
def test_formats_without_names_keep_the_points(tmp_path, suffix, colored):
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, full_cloud())
    back = read_cloud(path)
    np.testing.assert_array_equal(np.asarray(back.points, np.float32), POINTS)
    assert (back.colors is not None) == colored
    assert [p.name for p in tmp_path.iterdir()] == [path.name], "a temporary file was left behind"


def test_double_precision_is_kept_where_jax_keeps_it(tmp_path):
    far = np.array([[500000.123456789, 4.5e6, 1.0]])
    for suffix in (".ply", ".pcd", ".npz", ".npy", ".csv", ".xyz"):
        write_cloud(tmp_path / f"far{suffix}", Cloud(points=jnp.asarray(far)))
        np.testing.assert_array_equal(read_cloud(tmp_path / f"far{suffix}").points, far)


def test_what_is_written_others_read(tmp_path):
    write_cloud(tmp_path / "cloud.ply", full_cloud())
    other = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_allclose(other.vertices, POINTS)
    np.testing.assert_array_equal(other.colors[:, :3], COLORS)


PLY_HEAD = """ply
format {order} 1.0
comment made by hand
element face 2
property list uchar int vertex_indices
element vertex {count}
property float nx
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
element edge 1
property int vertex1
end_header
"""


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_with_faces_before_and_edges_after_the_vertices(tmp_path, order):
    head = PLY_HEAD.format(order=order, count=2)
    if order == "ascii":
        body = b"3 0 1 1\n4 0 1 1 0\n0.5 1 2 3 10 20 30\n0.5 -1 -2 -3.5 40 50 60\n7\n"
    else:
        mark = "<" if "little" in order else ">"
        body = struct.pack(f"{mark}B3iB4i", 3, 0, 1, 1, 4, 0, 1, 1, 0)
        body += struct.pack(f"{mark}f3d3B", 0.5, 1, 2, 3, 10, 20, 30) + struct.pack(
            f"{mark}f3d3B", 0.5, -1, -2, -3.5, 40, 50, 60
        )
        body += struct.pack(f"{mark}i", 7)
    back = read_cloud(put(tmp_path, "a.ply", head.encode() + body))
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [-1, -2, -3.5]])
    np.testing.assert_allclose(back.colors, np.array([[10, 20, 30], [40, 50, 60]]) / 255, rtol=1e-6)


PCD_HEAD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z rgb _
SIZE 4 4 4 4 1
TYPE F F F {rgb} U
COUNT 1 1 1 1 3
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4
DATA {data}
"""
PCD_POINTS = np.array([[1, 2, 3], [np.nan, np.nan, np.nan], [-1, 0.5, 2], [4, 5, 6]], "<f4")
PCD_RGB = np.array([0x0A141E, 0, 0xFFFFFF, 0x010203], "<u4")


def lzf(data):
    """LibLZF by hand: the first bytes literally, then copies wherever the next three bytes came before."""
    out, literal, at = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literal), 32):
            piece = literal[start : start + 32]
            out.append(len(piece) - 1)
            out.extend(piece)
        literal.clear()

    while at < len(data):
        start = data.find(data[at : at + 3], max(0, at - 8000), at + 2) if at + 3 <= len(data) else -1
        if 0 <= start < at:
            length = 3
            while at + length < len(data) and length < 264 and data[start + length] == data[at + length]:
                length += 1
            flush()
            offset, rest = at - start - 1, length - 2
            out.append((min(rest, 7) << 5) | (offset >> 8))
            if rest >= 7:
                out.append(rest - 7)
            out.append(offset & 255)
            at += length
        else:
            literal.append(data[at])
            at += 1
    flush()
    return bytes(out)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("rgb", ["F", "U"])
def test_pcd_by_hand_with_nan_padding_and_packed_color(tmp_path, data, rgb):
    head = PCD_HEAD.format(rgb=rgb, width=2, height=2, data=data).encode()
    colors = PCD_RGB.view("<f4") if rgb == "F" else PCD_RGB
    if data == "ascii":
        rows = [f"{x} {y} {z} {c!r} 0 0 0" for (x, y, z), c in zip(PCD_POINTS.tolist(), colors.tolist(), strict=True)]
        body = ("\n".join(rows) + "\n").encode()
    elif data == "binary":
        body = b"".join(PCD_POINTS[i].tobytes() + colors[i : i + 1].tobytes() + b"\0\0\0" for i in range(4))
    else:
        planar = PCD_POINTS.T.tobytes() + colors.tobytes() + bytes(12)
        packed = lzf(planar)
        assert len(packed) < len(planar), "the compressor of this test copies nothing"
        body = struct.pack("<II", len(packed), len(planar)) + packed
    path = put(tmp_path, "a.pcd", head + body)
    with pytest.warns(UserWarning, match=r"1 of 4 points are not finite"):
        back = read_cloud(path)
    np.testing.assert_array_equal(back.points, PCD_POINTS[[0, 2, 3]])
    np.testing.assert_allclose(np.asarray(back.colors)[0] * 255, [10, 20, 30], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(back.colors)[2] * 255, [1, 2, 3], rtol=1e-6)


@given(st.lists(st.sampled_from([b"abc", b"x" * 40, b"\0", b"abcabc"]), max_size=60))
@settings(max_examples=50, deadline=None)
def test_compressed_points_unpack_to_what_they_were(parts):
    text = b"".join(parts)
    text += b"\0" * (-len(text) % 12 + 12)
    count = len(text) // 12
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary_compressed\n"
    packed = lzf(text)
    columns = parse(head.encode() + struct.pack("<II", len(packed), len(text)) + packed)
    assert b"".join(columns[name].tobytes() for name in "xyz") == text


PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PLY_TEXT = PLY.format(2) + "1 2 3\n4 5 6\n"
PCD_TEXT = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n1 2 3\n4 5 6\n"


@pytest.mark.parametrize(
    ("name", "text", "colored"),
    [
        ("names.csv", "label,Z,X,Y\n1,3,1,2\n2,6,4,5\n", False),
        ("semicolons.csv", '"x";"y";"z";"r";"g";"b"\n1;2;3;255;0;0\n4;5;6;0;0;255\n', True),
        ("blanks.xyz", "# a comment\n1 2 3\n\n4\t5  6 # the second\n", False),
        ("colors.xyz", "1 2 3 255 0 0\n4 5 6 0 0 255\n", True),
        ("normals.xyz", "1 2 3 0.5 0 0\n4 5 6 0 -1 0\n", False),
        ("counted.pts", "2\n1 2 3\n4 5 6\n", False),
        ("marked.csv", "\ufeffx,y,z\r\n1,2,3\r\n4,5,6\r\n", False),
        ("cloudcompare.txt", "//X Y Z R G B\n2\n1 2 3 255 0 0\n4 5 6 0 0 255\n", True),
        ("spaced.txt", "// X Y Z R G B\n1 2 3 255 0 0\n4 5 6 0 0 255\n", True),
        ("quoted.csv", '"x","y","z"\n"1","2","3"\n"4","5","6"\n', False),
        ("quoted.xyz", '"1","2","3"\n"4","5","6"\n', False),
        ("ending.csv", "x,y,z,\n1,2,3,\n4,5,6,\n", False),
        ("gaps.csv", "x,y,note,z\n1,2,,3\n4,5,7,6\n", False),
        ("counted.csv", "2\n1,2,3\n4,5,6\n", False),
        ("capitals.ply", PLY_TEXT.replace("float x", "float X").replace("float z", "float Z"), False),
        ("comments.pcd", "#.PCD v.7\n# by hand\n" + PCD_TEXT.replace("ascii", "ASCII"), False),
    ],
)
def test_text(tmp_path, name, text, colored):
    back = read_cloud(put(tmp_path, name, text))
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [4, 5, 6]])
    assert (back.colors is not None) == colored
    if colored:
        np.testing.assert_array_equal(back.colors, [[1, 0, 0], [0, 0, 1]])


def test_a_gap_among_coordinates_is_no_point(tmp_path):
    """As pandas writes what is not known."""
    with pytest.warns(UserWarning, match="1 of 3 points are not finite"):
        back = read_cloud(put(tmp_path, "a.csv", "x,y,z\n1,2,3\n1,,3\n4,5,6\n"))
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [4, 5, 6]])


def test_colors_of_numpy_files(tmp_path):
    """In three further columns, as in a text file, or with an opacity."""
    np.save(tmp_path / "six.npy", np.array([[1, 2, 3, 255, 0, 0], [4, 5, 6, 0, 0, 255.0]]))
    np.savez(
        tmp_path / "four.npz", points=np.array([[1, 2, 3], [4, 5, 6.0]]), colors=np.eye(4, dtype=np.uint8)[[0, 2]] * 255
    )
    for name in ("six.npy", "four.npz"):
        np.testing.assert_array_equal(read_cloud(tmp_path / name).colors, [[1, 0, 0], [0, 0, 1]])


def test_points_that_their_precision_does_not_tell_apart(tmp_path):
    """A metre of the world in metres of a map: single precision has steps of half a metre there."""
    far = np.random.default_rng(0).uniform(0, 1, (50, 3)) + [500_000, 4_600_000, 100]
    np.save(tmp_path / "far.npy", far)
    np.testing.assert_array_equal(read_cloud(tmp_path / "far.npy").points, far)
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"points lie up to 4\.6e\+06 .* subtract an offset"):
        read_cloud(tmp_path / "far.npy")


def test_empty_numpy_clouds(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((0, 6)))
    np.savez(tmp_path / "b.npz", points=np.zeros((0, 3)), colors=np.zeros((0, 4), np.uint8))
    for name in ("a.npy", "b.npz"):
        with pytest.raises(ValueError, match="holds no finite point, out of 0"):
            read_cloud(tmp_path / name)


def test_a_column_that_is_no_whole_number_is_left_as_it_is(tmp_path):
    """Of one that is not asked for nothing hangs on that; a color beyond its range is the brightest, not what is left of 256."""
    head = PLY.format(2).replace(
        "end_header", "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int label\nend_header"
    )
    back = read_cloud(put(tmp_path, "a.ply", head + "1 2 3 300 0 0 nan\n4 5 6 0 0 255 7\n"))
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(back.colors, [[1, 0, 0], [0, 0, 1]])


def test_columns_without_a_name_are_columns(tmp_path):
    """As pandas writes its index."""
    back = read_cloud(put(tmp_path, "a.csv", ",x,y,z\n0,1,2,3\n1,4,5,6\n"))
    np.testing.assert_array_equal(back.points, [[1, 2, 3], [4, 5, 6]])
    with pytest.raises(ValueError, match="has 4 names but 3 columns"):
        read_cloud(put(tmp_path, "b.csv", "x,y,z,\n1,2,3\n"))


def test_a_viewpoint_elsewhere_is_told(tmp_path):
    text = PCD_TEXT.replace("POINTS", "VIEWPOINT 2 3 1.5 1 0 0 0\nPOINTS")
    with pytest.warns(UserWarning, match=r"seen from \(2\.0, 3\.0, 1\.5\) by its own word.*give that as camera"):
        read_cloud(put(tmp_path, "a.pcd", text))


def test_numpy_maps_and_records(tmp_path):
    points = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    points[0, 0, 2] = np.inf
    np.savez(tmp_path / "map.npz", xyz=points, rgb=np.full((2, 2, 3), 51, np.uint8), label=np.zeros((2, 2), np.uint8))
    with pytest.warns(UserWarning, match="1 of 4 points"):
        back = read_cloud(tmp_path / "map.npz")
    np.testing.assert_array_equal(back.points, points.reshape(-1, 3)[1:])
    np.testing.assert_allclose(back.colors, 0.2, rtol=1e-6)
    np.save(
        tmp_path / "records.npy", np.array([(1.0, 2.0, 3.0, 9)], [("z", "f4"), ("y", "f4"), ("x", "f4"), ("n", "i4")])
    )
    np.testing.assert_array_equal(read_cloud(tmp_path / "records.npy").points, [[3, 2, 1]])


def npy(array, allow_pickle=False):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=allow_pickle)
    return file.getvalue()


def lying_npy():
    return npy(np.zeros((4, 3))).replace(b"(4, 3)", b"(9, 3)")


BINARY = PLY.replace("ascii", "binary_little_endian")
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "empty"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "no known format"),
        ("hello world\n", "no points"),
        ("# nothing\n", "no points"),
        ("1 2\n3 4\n", "at least three columns, x, y and z, got 2"),
        ("1 2 3\n4 5\n", "not numbers"),
        ("1 2 3\n4 five 6\n", "not numbers"),
        ("5\n1 2 3\n4 5 6\n", "5 points are promised, there are 2"),
        ("a,b,c\n1,2,3\n", "no column x, y, z"),
        ("nan nan nan\n", "no finite point, out of 1"),
        (PLY.format(3) + "1 2 3\n4 5 6\n", "3 points are promised, there are 2"),
        (PLY.format(1) + "1 2 3\n4 5 6\n", "2 points where 1 are promised"),
        (PLY.format(1) + "1 2\n", "2 numbers a vertex where the header says 3"),
        (PLY.format(-1) + "1 2 3\n", "'-1' where element vertex"),
        (PLY.format(0), "no points"),
        (PLY.format("ten"), "'ten' where element vertex"),
        (PLY.format(1).replace("end_header\n", ""), "without end_header"),
        (PLY.format(1).replace("float z", "quad z") + "1 2 3\n", "'property quad z'"),
        (PLY.format(1).replace("ascii", "morse") + "1 2 3\n", "morse"),
        (PLY.format(1).replace("vertex", "vertices") + "1 2 3\n", "no vertices"),
        (PLY.format(1).replace("float z", "float w") + "1 2 3\n", "no column z"),
        (PLY.format(1).replace("float z", "list uchar int z") + "1 2 3\n", "list among the vertex"),
        (BINARY.format(2).encode() + bytes(23), "promises 2 points, there are 1"),
        (BINARY.format(10**15).encode() + bytes(24), "promises 1000000000000000 points, there are 2"),
        (BINARY.format(1).encode() + b"\1" * 24, "more than the 1 points"),
        (PCD.format(3, "ascii") + "1 2 3\n", "3 points are promised, there are 1"),
        (PCD.format(3, "binary").encode() + bytes(35), "promises 3 points, there are 2"),
        (PCD.format(3, "morse"), "DATA 'morse'"),
        (PCD.format(3, "binary").replace("HEIGHT 1", "HEIGHT 2"), "WIDTH x HEIGHT is 3 x 2"),
        (PCD.format(3, "binary").replace("SIZE 4 4 4", "SIZE 4 4"), "differ in length"),
        (PCD.format(3, "binary").replace("SIZE 4 4 4", "SIZE 4 4 3"), "unknown type"),
        (PCD.format(3, "binary").replace("FIELDS x y z\n", ""), "without FIELDS"),
        (PCD.format(1, "binary_compressed").encode() + struct.pack("<II", 4, 11) + b"\3abc", "11 bytes of points"),
        (PCD.format(1, "binary_compressed").encode() + struct.pack("<II", 90, 12) + b"\3abc", "cut short"),
        (PCD.format(1, "binary_compressed").encode() + struct.pack("<II", 4, 12) + b"\2abc", "unpacks to 3 bytes"),
        (PCD.format(1, "binary_compressed").encode() + struct.pack("<II", 2, 12) + b"\x20\x05", "before their start"),
        (PCD.format(1, "binary_compressed").encode() + struct.pack("<II", 1, 12) + b"\xe0", "cut short"),
        (npy(np.zeros((2, 2))), r"float64 \(2, 2\)"),
        (npy(np.zeros((2, 3), complex)), "complex128"),
        (npy(np.zeros((2, 3)))[:-8], "damaged, cut short"),
        (lying_npy(), "damaged, cut short"),
        (b"PK\x03\x04 not a zip", "damaged, cut short"),
        (b",\n,\n", "holds no points"),
        (b",", "holds no points"),
    ],
)
def test_damaged_files_are_one_sentence(tmp_path, data, says):
    path = put(tmp_path, "bad.bin", data)
    with pytest.raises(ValueError, match=says) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


def test_nothing_is_unpickled(tmp_path):
    for data in (pickle.dumps(Bomb()), npy(np.array([Bomb()], object), allow_pickle=True)):
        with pytest.raises(ValueError, match=r"no known format|no points|Python objects"):
            read_cloud(put(tmp_path, "bomb.npy", data))


def test_every_cut_of_a_binary_file_is_refused_or_whole(tmp_path):
    write_cloud(tmp_path / "a.ply", full_cloud())
    whole = (tmp_path / "a.ply").read_bytes()
    for end in range(4, len(whole)):
        with pytest.raises(ValueError, match=r"cut short|header|format|vertices|no column|promised|numbers"):
            read_cloud(put(tmp_path, "cut.ply", whole[:end]))


def test_wrong_use(tmp_path):
    with pytest.raises(FileNotFoundError, match="cloud not found"):
        read_cloud(tmp_path / "missing.ply")
    with pytest.raises(ValueError, match="folder"):
        read_cloud(tmp_path)
    with pytest.raises(ValueError, match=r"must end in one of .*\.ply"):
        write_cloud(tmp_path / "cloud.obj", full_cloud())
    with pytest.raises(ValueError, match="column object must hold 3 numbers"):
        write_cloud(tmp_path / "cloud.ply", full_cloud(), extra={"object": np.zeros(2)})
    for name in ("x", "colors", "my id", ""):
        with pytest.raises(ValueError, match=f"extra must have names .* got '{name}'"):
            write_cloud(tmp_path / "cloud.npz", full_cloud(), extra={name: np.zeros(3)})
    with pytest.raises(ValueError, match="column id must hold whole numbers of 32 bits, got up to 1099511627783"):
        write_cloud(tmp_path / "cloud.ply", full_cloud(), extra={"id": np.array([1, 2, 2**40 + 7])})
    with pytest.raises(ValueError, match="colors must be 0 to 1, got 0 to 255"):
        write_cloud(tmp_path / "cloud.ply", Cloud(POINTS, COLORS))
    with pytest.raises(TypeError, match="cloud must be a Cloud, got ndarray"):
        write_cloud(tmp_path / "cloud.ply", POINTS)
    with pytest.raises(OSError, match="cannot write"):
        write_cloud(tmp_path / "no" / "cloud.ply", full_cloud())
    assert list(tmp_path.iterdir()) == [], "something half-written was left behind"


@pytest.mark.parametrize(
    ("name", "count"),
    [("pyransac3d_boxes/caixa.ply", 46370), ("pcl_mug_stereo/table_scene_mug_stereo_textured.npz", 209280)],
)
@pytest.mark.filterwarnings("ignore:.*points are not finite")
def test_real_clouds(shared_data, name, count):
    cloud = read_cloud(shared_data / name)
    assert cloud.points.shape == (count, 3)
    assert cloud.colors is not None
    assert 0.2 < float(np.mean(cloud.colors)) < 0.8
