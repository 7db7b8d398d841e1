"""The rig: its rules, resizing, and the calibration files of others, written out by hand."""

import dataclasses
import json

import cv2
import numpy as np
import pytest

from jaxfuzzy.rig import Rig, load_rig, save_rig

GIVEN = {"focal_px": (700.0, 710.0), "center_px": (319.5, 239.5), "baseline_m": 0.12, "image_size": (640, 480)}
ANGLES = np.array([0.01, -0.02, 0.005])
ROTATION = cv2.Rodrigues(ANGLES)[0]
TRANSLATION = np.array([-0.12, 0.001, -0.002])
LEFT = np.array([[700.0, 0, 319.5], [0, 710.0, 239.5], [0, 0, 1]])
RIGHT = np.array([[705.0, 0, 321.0], [0, 715.0, 238.0], [0, 0, 1]])
LENS = np.array([-0.2, 0.05, 0.001, -0.001, 0.01])


def raw_rig():
    return Rig(
        **GIVEN | {"baseline_m": float(np.linalg.norm(TRANSLATION))},
        right_focal_px=(705.0, 715.0),
        right_center_px=(321.0, 238.0),
        distortion=(LENS, LENS / 2),
        rotation=ROTATION,
        translation=TRANSLATION,
    )


def assert_same(a, b, rtol=1e-12):
    for field in dataclasses.fields(Rig):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if x is None or isinstance(x, bool):
            assert x == y, field.name
        else:
            pairs = zip(x, y, strict=True) if field.name == "distortion" else [(x, y)]
            for one, other in pairs:
                np.testing.assert_allclose(one, other, rtol, 1e-12, err_msg=field.name)


def put(tmp_path, text, name="calib.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_own_file_comes_back(tmp_path):
    for rig in (Rig(**GIVEN), Rig(**GIVEN, doffs_px=31.0, max_disparity_px=64, metric=False), raw_rig()):
        save_rig(tmp_path / "rig.json", rig)
        assert load_rig(tmp_path / "rig.json") == rig
    assert json.loads((tmp_path / "rig.json").read_text())["schema"] == "jaxfuzzy/rig"


def test_middlebury_units_offset_and_bound(tmp_path):
    text = (
        "cam0=[1500 0 199; 0 1510 187; 0 0 1]\ncam1=[1500 0 251; 0 1510 187; 0 0 1]\n"
        "doffs=52\nbaseline=80\nwidth=450\nheight=375\nndisp=64\n"
    )
    expected = Rig((1500, 1510), (199, 187), 0.08, (450, 375), 52.0, 64)
    assert_same(load_rig(put(tmp_path, text)), expected)
    # The offset is the difference of the principal points where the file does not spell it out.
    assert_same(load_rig(put(tmp_path, text.replace("doffs=52\n", ""))), expected)
    assert load_rig(put(tmp_path, text.replace("\n", "\r\n"))) == load_rig(put(tmp_path, text))


def test_unknown_baseline_is_refused_unless_arbitrary_units_are_asked_for(tmp_path):
    no_baseline = put(tmp_path, "cam0=[1500 0 199; 0 1500 187; 0 0 1]\nwidth=450\nheight=375\n")
    with pytest.raises(ValueError, match=r"no baseline and no doffs.*arbitrary_units=True"):
        load_rig(no_baseline)
    rig = load_rig(no_baseline, arbitrary_units=True)
    assert (rig.baseline_m, rig.doffs_px, rig.metric) == (1.0, 0.0, False)
    with pytest.raises(ValueError, match=r"baseline_m=1\.0 with metric=False"):
        Rig(**GIVEN | {"baseline_m": None})


KITTI = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P1: 700 0 600 -371 0 700 180 0 0 0 1 0
P2: 700 0 600 49 0 700 180 0.2 0 0 1 0.003
P3: 700 0 600 -315 0 700 180 2.2 0 0 1 0.003
Tr: 1 0 0 0 0 1 0 0 0 0 1 0
"""


def test_kitti_colour_and_grey(tmp_path):
    path = put(tmp_path, KITTI)
    assert_same(load_rig(path), Rig((700, 700), (600, 180), (49 + 315) / 700, None))
    assert_same(load_rig(path, cameras=(0, 1)), Rig((700, 700), (600, 180), 0.53, None))
    raw = (
        "calib_time: 09-Jan-2012 13:57:47\nS_rect_00: 1.242e+03 3.75e+02\nK_01: 1 2 3\n"
        "P_rect_00: 700 0 600 0 0 700 180 0 0 0 1 0\nP_rect_01: 700 0 600 -371 0 700 180 0 0 0 1 0\n"
    )
    assert_same(load_rig(put(tmp_path, raw)), Rig((700, 700), (600, 180), 0.53, (1242, 375)))
    with pytest.raises(ValueError, match=r"of cameras \[0, 1\], not of \(2, 3\)"):
        load_rig(put(tmp_path, raw), cameras=(2, 3))
    # A damaged line is not passed over for the other pair of cameras.
    for damaged in ("P3: 1 2 nan", "P3: 700 0 600 nan 0 700 180 0 0 0 1 0"):
        text = "\n".join(damaged if line.startswith("P3") else line for line in KITTI.splitlines())
        with pytest.raises(ValueError, match="P3 must be 12 numbers"):
            load_rig(put(tmp_path, text))


def write_storage(path, **entries):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_storage_raw_and_rectified(tmp_path, suffix):
    """Written by OpenCV itself; the geometry of the rectified rig is OpenCV's stereoRectify."""
    size = (640, 480)
    r1, r2, p1, p2, q = cv2.stereoRectify(LEFT, LENS, RIGHT, LENS / 2, size, ROTATION, TRANSLATION[:, None])[:5]
    both = {"M1": LEFT, "D1": LENS, "M2": RIGHT, "D2": LENS / 2, "image_width": 640, "image_height": 480}
    pose = {"R": ROTATION, "T": TRANSLATION, "R1": r1, "R2": r2, "P1": p1, "P2": p2, "Q": q}
    whole = write_storage(tmp_path / f"whole.{suffix}", **both, **pose)
    assert_same(load_rig(whole), raw_rig())
    intrinsics = write_storage(tmp_path / f"intrinsics.{suffix}", **both)
    extrinsics = write_storage(tmp_path / f"extrinsics.{suffix}", **pose)
    assert_same(load_rig(intrinsics, extrinsics), raw_rig())
    with pytest.raises(ValueError, match=r"load_rig\(intrinsics, extrinsics\)"):
        load_rig(intrinsics)

    rectified = load_rig(whole, rectified=True)
    baseline = float(np.linalg.norm(TRANSLATION))
    assert_same(rectified, Rig((p1[0, 0], p1[1, 1]), (p1[0, 2], p1[1, 2]), baseline, size), rtol=1e-9)
    from_q = load_rig(write_storage(tmp_path / f"q.{suffix}", Q=q))
    assert_same(dataclasses.replace(from_q, image_size=size), rectified, rtol=1e-9)


def test_opencv_offset_has_the_sign_of_reprojection(tmp_path):
    """Without CALIB_ZERO_DISPARITY the principal points differ; a point reprojected by Q lands where doffs puts it."""
    left = LEFT.copy()
    left[0, 2] = 260.0
    p1, p2, q = cv2.stereoRectify(left, LENS, RIGHT, LENS, (640, 480), ROTATION, TRANSLATION[:, None], flags=0)[2:5]
    projected = load_rig(write_storage(tmp_path / "p.yml", P1=p1, P2=p2))
    for rig in (projected, load_rig(write_storage(tmp_path / "q.yml", Q=q))):
        assert abs(rig.doffs_px) > 5
        x, _, z, w = q @ [100.0, 200.0, 40.0, 1.0]
        depth = rig.focal_px[0] * rig.baseline_m / (40.0 + rig.doffs_px)
        np.testing.assert_allclose(depth, z / w, rtol=1e-9)
        np.testing.assert_allclose((100.0 - rig.center_px[0]) * depth / rig.focal_px[0], x / w, rtol=1e-9)


CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: narrow_stereo/{name}
camera_matrix:
  rows: 3
  cols: 3
  data: [{k}]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: 5
  data:
  - {d[0]}
  - {d[1]}
  - {d[2]}
  - {d[3]}
  - {d[4]}
rectification_matrix:
  rows: 3
  cols: 3
  data: [{r}]
projection_matrix:
  rows: 3
  cols: 4
  data: [{p}]
"""


def camera_info(name, k, d, r, p, model="plumb_bob"):
    k, r, p = (",\n    ".join(map(repr, np.ravel(matrix).tolist())) for matrix in (k, r, p))
    return CAMERA_INFO.format(name=name, k=k, d=d.tolist(), r=r, p=p, model=model)


def test_ros_camera_info(tmp_path):
    """Both files give back the raw cameras that OpenCV's stereoRectify made them from."""
    r1, r2, p1, p2 = cv2.stereoRectify(LEFT, LENS, RIGHT, LENS / 2, (640, 480), ROTATION, TRANSLATION[:, None])[:4]
    left = put(tmp_path, camera_info("left", LEFT, LENS, r1, p1), "left.yaml")
    right = put(tmp_path, camera_info("right", RIGHT, LENS / 2, r2, p2), "right.yaml")
    assert_same(load_rig(left, right), raw_rig(), rtol=1e-7)
    expected = Rig((p1[0, 0], p1[1, 1]), (p1[0, 2], p1[1, 2]), float(np.linalg.norm(TRANSLATION)), (640, 480))
    assert_same(load_rig(left, right, rectified=True), expected, rtol=1e-9)
    assert_same(load_rig(right, rectified=True), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="holds no baseline: give both"):
        load_rig(left)
    with pytest.raises(ValueError, match="rectified=True where the images are rectified"):
        load_rig(right)
    fisheye = put(tmp_path, camera_info("left", LEFT, LENS, r1, p1, "equidistant"), "fisheye.yaml")
    with pytest.raises(ValueError, match="distortion model 'equidistant'"):
        load_rig(fisheye, right)
    # One file of both cameras: two documents, or one that names them; ROS 2 has its letters small.
    both = put(tmp_path, left.read_text() + "---\n" + right.read_text(), "both.yaml")
    small = [
        path.read_text().replace("camera_matrix:", "k:").replace("distortion_coefficients:", "d:")
        .replace("rectification_matrix:", "r:").replace("projection_matrix:", "p:").replace("image_", "")
        for path in (left, right)
    ]  # fmt: skip
    echoed = [put(tmp_path, text, f"{i}.yaml") for i, text in enumerate(small)]
    inside = "".join(
        f"{name}:\n" + "".join(f"  {line}\n" for line in text.splitlines())
        for name, text in zip(("left", "right"), small, strict=True)
    )
    for one in ((both,), echoed, (put(tmp_path, inside, "inside.yaml"),)):
        assert_same(load_rig(*one), raw_rig(), rtol=1e-7)
        assert_same(load_rig(*one, rectified=True), expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("hello\n", "no known format"),
        ("{}", "neither M1"),
        ('{"schema": "other"}', "schema must be"),
        ('{"schema": "jaxfuzzy/rig", "version": 2}', "version 2"),
        ('{"schema": "jaxfuzzy/rig", "version": 1}', "lacks the fields: focal_px, center_px, baseline_m"),
        ('{"schema": "jaxfuzzy/rig", "version": 1, "focal": 3}', "unknown fields: focal"),
        ('{"schema": "jaxfuzzy/rig", "version', "not valid JSON"),
        ("<?xml version='1.0'?><opencv_storage><M1>", "not valid XML"),
        ("cam0=[1 0 1; 0 1 1]\n", "3 x 3"),
        (
            "cam0=[1500 0 199; 0 1500 187; 0 0 1]\ncam1=[1500 0 251; 0 1500 187; 0 0 1]\nbaseline=wide\n",
            "baseline must be a number",
        ),
        (
            "%YAML:1.0\nP1: !!opencv-matrix\n   rows: 3\n   cols: 4\n   dt: d\n   data: [1., 2.]\n",
            "3 x 4 but holds 2 numbers",
        ),
        ("%YAML:1.0\nwidth: 3\n", "neither M1"),
        ("P0: 1 2 3\nP1: 1 2 3\n", "P0 must be 12 numbers, got '1 2 3'"),
        ("a: 1\n---\nb: 2\n---\nc: 3\n", "holds 3 documents"),
        (KITTI.replace("-315", "600"), "left and right are swapped"),
        (
            "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -1 0 700 180 -371 0 0 1 0\n",
            "one camera above the other",
        ),
    ],
)
def test_what_is_no_rig_is_one_sentence(tmp_path, text, says):
    path = put(tmp_path, text)
    with pytest.raises(ValueError, match=says) as caught:
        load_rig(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="rig not found"):
        load_rig(tmp_path / "none.json")
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match="no text file"):
        load_rig(tmp_path / "image.png")
    with pytest.raises(OSError, match="cannot write"):
        save_rig(tmp_path / "no" / "rig.json", Rig(**GIVEN))


def test_a_baseline_in_millimetres_is_noticed_and_can_be_told(tmp_path):
    path = put(tmp_path, KITTI.replace("-315", "-83951"))
    with pytest.warns(UserWarning, match="unit_m=0.001"):
        load_rig(path)
    assert load_rig(path, unit_m=0.001).baseline_m == pytest.approx(0.12, rel=1e-12)


def test_the_unit_of_an_own_file_can_be_told_and_other_options_are_refused(tmp_path):
    """A board whose squares were given in millimetres makes a rig in kilometres."""
    pose = {"rotation": np.eye(3), "translation": (-120.0, 0, 0)}
    save_rig(tmp_path / "rig.json", Rig(**GIVEN | {"baseline_m": 120.0} | pose))
    with pytest.warns(UserWarning, match=r"baseline of 120 m.*unit_m=0\.001"):
        load_rig(tmp_path / "rig.json")
    rig = load_rig(tmp_path / "rig.json", unit_m=0.001)
    assert rig.baseline_m == pytest.approx(0.12, rel=1e-12)
    np.testing.assert_allclose(rig.translation, (-0.12, 0, 0), rtol=1e-12)
    for options in ({"other": tmp_path / "rig.json"}, {"cameras": (0, 1)}, {"rectified": True}):
        with pytest.raises(ValueError, match=f"own JSON, which has no use for {next(iter(options))}"):
            load_rig(tmp_path / "rig.json", **options)


def test_what_a_format_has_no_use_for_is_refused(tmp_path):
    kitti, middlebury = put(tmp_path, KITTI, "kitti.txt"), tmp_path / "calib.txt"
    middlebury.write_text(
        "cam0=[700 0 320; 0 700 240; 0 0 1]\ncam1=[700 0 320; 0 700 240; 0 0 1]\ndoffs=0\nbaseline=120\n"
    )
    for path in (kitti, middlebury):
        with pytest.raises(ValueError, match="which needs no second file"):
            load_rig(path, kitti)
    with pytest.raises(ValueError, match="a choice among its four"):
        load_rig(middlebury, cameras=(0, 1))
    assert load_rig(kitti, cameras=(2, 3)).baseline_m > 0


def test_what_contradicts_itself_is_told(tmp_path):
    text = "cam0=[700 0 320; 0 700 240; 0 0 1]\ncam1=[700 0 372; 0 700 240; 0 0 1]\ndoffs={}\nbaseline=120\n"
    assert load_rig(put(tmp_path, text.format(52))).doffs_px == 52
    for wrong, says in (
        (text.format(0), "doffs is 0 px by one entry and 52"),
        (text.format(-52), "doffs is -52"),
        (text.format(52).replace("cam1=[700", "cam1=[525"), "focal length is 700 px by one entry and 525"),
        (text.format(52).replace("240; 0 0 1]\ndoffs", "140; 0 0 1]\ndoffs"), "row of the center is 240"),
    ):
        with pytest.warns(UserWarning, match=says):
            load_rig(put(tmp_path, wrong))
    left, right = "P1: [500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]", "P2: [{}, 0, 320, -50, 0, 500, {}, 0, 0, 0, 1, 0]"
    assert load_rig(put(tmp_path, f"{left}\n{right.format(500, 240)}\n")).baseline_m == pytest.approx(0.1)
    for focal, row, says in ((1000, 240, "focal length is 500"), (500, 140, "row of the center is 240")):
        with pytest.raises(ValueError, match=says):
            load_rig(put(tmp_path, f"{left}\n{right.format(focal, row)}\n"))
    turned = "M1: [500, 0, 0, 0, 500, 0, 320, 240, 1]\nM2: [500, 0, 0, 0, 500, 0, 320, 240, 1]\n"
    with pytest.raises(ValueError, match="M1 must end in the row 0, 0, 1"):
        load_rig(put(tmp_path, turned + "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.1, 0, 0]\n"))


def test_a_camera_that_was_never_calibrated(tmp_path):
    """What ROS drivers publish until somebody calibrates: zeros."""
    text = "image_width: 640\nimage_height: 480\n"
    for name, count in (("camera_matrix", 9), ("rectification_matrix", 9), ("projection_matrix", 12)):
        text += f"{name}:\n  rows: 3\n  cols: {count // 3}\n  data: {[0] * count}\n"
    path = put(tmp_path, text)
    with pytest.raises(ValueError, match="never calibrated"):
        load_rig(path, path)


def test_a_single_camera_will_do_without_a_baseline(tmp_path):
    """A depth camera's: its depths are metres by themselves."""
    matrix = "[500, 0, 320, 0, 510, 240, 0, 0, 1]"
    ros = "image_width: 640\nimage_height: 480\n"
    for name, cols, data in (
        ("camera_matrix", 3, matrix),
        ("rectification_matrix", 3, "[1, 0, 0, 0, 1, 0, 0, 0, 1]"),
        ("projection_matrix", 4, "[500, 0, 320, 0, 0, 510, 240, 0, 0, 0, 1, 0]"),
    ):
        ros += f"{name}:\n  rows: 3\n  cols: {cols}\n  data: {data}\n"
    for text in (f"%YAML:1.0\ncamera_matrix: {matrix}\nimage_width: 640\nimage_height: 480\n", ros):
        path = put(tmp_path, text)
        rig = load_rig(path, arbitrary_units=True)
        assert (rig.focal_px, rig.center_px, rig.image_size, rig.metric) == ((500, 510), (320, 240), (640, 480), False)
        with pytest.raises(ValueError, match=r"baseline|how they stand|neither M1"):
            load_rig(path)


def test_two_cameras_are_no_single_one(tmp_path):
    """Without how they stand to each other their pictures cannot be matched, in whatever units."""
    matrix = "[500, 0, 320, 0, 510, 240, 0, 0, 1]"
    path = put(tmp_path, f"M1: {matrix}\nM2: {matrix}\n")
    with pytest.raises(ValueError, match="not how they stand to each other"):
        load_rig(path, arbitrary_units=True)


def test_lists_of_dashes(tmp_path):
    """As PyYAML writes nested lists."""
    block = lambda name, rows: (
        f"{name}:\n" + "".join(("- " if i == 0 else "  ") + f"- {x}\n" for row in rows for i, x in enumerate(row))
    )
    camera = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
    text = block("M1", camera) + block("M2", camera) + block("R", np.eye(3)) + "T:\n- -0.1\n- 0.0\n- 0.0\n"
    rig = load_rig(put(tmp_path, text))
    assert (rig.focal_px, rig.center_px, rig.baseline_m) == ((500.0, 510.0), (320.0, 240.0), pytest.approx(0.1))


RECTIFIED = Rig((700.5, 710.25), (300.0, 200.5), 0.12, (640, 480), doffs_px=31.125, max_disparity_px=64)
RAW = Rig(
    (700.5, 710.25),
    (300.0, 200.5),
    0.12,
    (640, 480),
    right_focal_px=(690.0, 691.0),
    right_center_px=(310.0, 210.0),
    rotation=((1.0, 0.0, 0.0), (0.0, 0.8, -0.6), (0.0, 0.6, 0.8)),
    translation=(-0.12, 0.0, 0.0),
    distortion=((0.1, -0.2, 0.001, 0.002, 0.03), (0.2, 0.1, 0.0, 0.0, -0.1)),
)


@pytest.mark.parametrize("suffix", ["json", "yml", "yaml", "xml", "txt"])
def test_written_rigs_come_back(tmp_path, suffix):
    """Every format holds all there is but OpenCV's, which knows no bound of the disparity."""
    path = tmp_path / f"rig.{suffix}"
    save_rig(path, RECTIFIED)
    bound = 64 if suffix in ("json", "txt") else None
    assert_same(load_rig(path), dataclasses.replace(RECTIFIED, max_disparity_px=bound))
    if suffix == "txt":
        with pytest.raises(ValueError, match="cameras that are not rectified"):
            save_rig(path, RAW)
    else:
        save_rig(path, RAW)
        assert_same(load_rig(path), RAW)


def test_opencv_reads_what_is_written(tmp_path):
    save_rig(tmp_path / "rig.yml", RECTIFIED)
    file = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    q, place = file.getNode("Q").mat(), np.array([100.0, 50.0, 20.0, 1.0])
    x, _, z, w = q @ place
    # f B / (d + doffs), as the module says.
    np.testing.assert_allclose(z / w, 700.5 * 0.12 / (20 + 31.125), rtol=1e-12)
    np.testing.assert_allclose(x / w, (100 - 300) / 700.5 * z / w, rtol=1e-12)


def test_rigs_are_written_in_known_formats_alone(tmp_path):
    for name in ("rig.pdf", "rig.json.bak"):
        with pytest.raises(ValueError, match=r"path must end in one of \.json, \.yml"):
            save_rig(tmp_path / name, RECTIFIED)
    with pytest.raises(ValueError, match="arbitrary units"):
        save_rig(tmp_path / "rig.yml", dataclasses.replace(RECTIFIED, metric=False))
    with pytest.raises(TypeError, match="rig must be a Rig, got NoneType"):
        save_rig(tmp_path / "rig.json", None)
    assert not list(tmp_path.iterdir())
    save_rig(tmp_path / "rig", RECTIFIED)
    assert load_rig(tmp_path / "rig") == RECTIFIED


def test_a_remark_before_the_first_entry_does_no_harm(tmp_path):
    matrix = "[700, 0, 320, 0, 700, 240, 0, 0, 1]"
    text = f"M1: {matrix}\nM2: {matrix}\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.12, 0, 0]\n"
    assert_same(load_rig(put(tmp_path, "# my cameras\n" + text)), load_rig(put(tmp_path, text, "plain.yml")))


def test_numbers_of_numpy_are_numbers(tmp_path):
    rig = Rig(**GIVEN | {"metric": np.True_, "image_size": (640, 480)})
    save_rig(tmp_path / "rig.json", rig)
    assert load_rig(tmp_path / "rig.json").metric is True
    assert_same(rig.scaled(np.float32(0.5)), rig.scaled(0.5))
    assert rig.scaled(np.int64(2)).image_size == (1280, 960)
    with pytest.raises(ValueError, match="to must be a factor or whole numbers"):
        rig.scaled((320.7, 240))


def test_a_mark_of_byte_order_does_no_harm(tmp_path):
    """Windows editors write one before the text."""
    path = tmp_path / "calib.txt"
    path.write_bytes(b"\xef\xbb\xbf" + KITTI.encode())
    assert_same(load_rig(path), load_rig(put(tmp_path, KITTI, "plain.txt")))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"focal_px": 700.0}, "focal_px must be 2 numbers, got 700.0"),
        ({"focal_px": (700, 0)}, "focal_px must be finite and above 0"),
        ({"baseline_m": -0.1}, "baseline_m must be finite and above 0"),
        ({"baseline_m": float("nan")}, "baseline_m must be finite"),
        ({"doffs_px": "x"}, "doffs_px must be one number"),
        ({"metric": "false"}, "metric must be True or False, got 'false'"),
        ({"image_size": (640.5, 480)}, "whole numbers"),
        ({"rotation": np.eye(3)}, "rotation and translation must be given together"),
        ({"distortion": (LENS, LENS)}, "distortion must come with rotation"),
        ({"rotation": 2 * np.eye(3), "translation": (-0.12, 0, 0)}, "rotation must be a 3 x 3 rotation"),
        ({"rotation": np.diag([1, 1, -1]), "translation": (-0.12, 0, 0)}, "rotation must be a 3 x 3 rotation"),
        (
            {"rotation": np.eye(3), "translation": (-0.12, 0, 0), "distortion": ((0, 0, 0, np.nan), LENS)},
            "distortion must be finite",
        ),
        ({"rotation": np.eye(3), "translation": (0.12, 0, 0)}, "left and right are swapped"),
        ({"rotation": np.eye(3), "translation": (0, -0.12, 0)}, "mainly along x"),
        ({"rotation": np.eye(3), "translation": (-0.2, 0, 0)}, "baseline_m must be the length"),
        ({"rotation": np.eye(3), "translation": (-0.12, 0, 0), "distortion": (LENS, LENS[:3])}, "4, 5, 8, 12 or 14"),
    ],
)
def test_impossible_rigs_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        Rig(**GIVEN | change)


def test_scaling_keeps_every_ray_and_depth():
    """A pixel's corner keeps its place in the picture; f, c and doffs scale, the baseline does not."""
    rig = Rig((700, 710), (300.0, 200.0), 0.12, (640, 480), doffs_px=31.0, max_disparity_px=64)
    with pytest.warns(UserWarning, match="if they were cropped"):
        half = rig.scaled((320, 120))
    assert half.baseline_m == rig.baseline_m
    assert half.image_size == (320, 120)
    assert half.max_disparity_px == 32
    u, v, d = 123.0, 77.0, 20.0
    small_u, small_v = (u + 0.5) / 2 - 0.5, (v + 0.5) / 4 - 0.5
    np.testing.assert_allclose((small_u - half.center_px[0]) / half.focal_px[0], (u - 300.0) / 700, rtol=1e-12)
    np.testing.assert_allclose((small_v - half.center_px[1]) / half.focal_px[1], (v - 200.0) / 710, rtol=1e-12)
    depth, small_depth = (r.focal_px[0] * r.baseline_m / (x + r.doffs_px) for r, x in ((rig, d), (half, d / 2)))
    np.testing.assert_allclose(small_depth, depth, rtol=1e-12)
    assert rig.scaled(0.5) == rig.scaled((320, 240))
    with pytest.raises(ValueError, match="factor"):
        dataclasses.replace(rig, image_size=None).scaled((320, 240))
    with pytest.raises(ValueError, match="to must be a finite number above 0"):
        rig.scaled(-1.0)


def test_every_real_rig_loads(shared_data):
    paths = sorted(shared_data.glob("*/calib.txt"))
    assert len(paths) >= 9
    for path in paths:
        rig = load_rig(path)
        assert 0.05 < rig.baseline_m < 0.5, path
        assert rig.doffs_px > 30, path
    with pytest.raises(ValueError, match="extrinsics"):
        load_rig(shared_data / "opencv_chessboard" / "intrinsics.yml")
    with pytest.raises(ValueError, match="no stereo calibration"):
        load_rig(shared_data / "opencv_chessboard" / "left_intrinsics.yml")
