"""Damaged files thrown at every reader, in a process with limited memory and a limit of time for each case.

    python tests/fuzz_files.py --cases 5000 --seed 0 [--only 17]

A case is right when the reader gives a result whose numbers are finite, or raises ValueError or FileNotFoundError in one line.
Every case is made from the seed and its number alone; a failure prints both, so that `--only` repeats it.
"""

import argparse
import faulthandler
import io
import json
import os
import pickle
import random
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from pathlib import Path

os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")

import cv2
import jax
import numpy as np

from jaxfuzzy import report
from jaxfuzzy.cloud import Cloud, read_cloud, write_cloud
from jaxfuzzy.photos import read_disparity, read_grey
from jaxfuzzy.rig import load_rig, save_rig
from jaxfuzzy.table import read_points
from synthetic import RIG, make_scene

# What a case may take: the whole file set is below 100 kB, so more is a reader led astray.
SECONDS = 10
MEMORY = 1 << 30
NUMBERS = (
    b"-1",
    b"0",
    b"1",
    b"7",
    b"4294967295",
    b"99999999999999999999",
    b"1e999",
    b"nan",
    b"inf",
    b"0x10",
    b"9" * 5000,
)
POINTS = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)

MIDDLEBURY = """cam0=[1500 0 199; 0 1510 187; 0 0 1]
cam1=[1500 0 251; 0 1510 187; 0 0 1]
doffs=52
baseline=80
width=450
height=375
ndisp=64
"""
KITTI = "".join(f"P{i}: 700 0 600 {-371 * (i % 2)} 0 700 180 0 0 0 1 0\n" for i in range(4))
STORAGE = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 320., 0., 700., 240., 0., 0., 1. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 320., 0., 700., 240., 0., 0., 1. ]
R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
T: [-0.1, 0, 0]
image_width: 640
image_height: 480
"""
LISTED = b"""ply
format binary_little_endian 1.0
element face 2
property list char int vertex_indices
element vertex 2
property float x
property float y
property float z
end_header
"""


def originals(folder: Path) -> list[tuple[str, str, bytes]]:
    """Sound files: the reader's name, the file's name, its bytes."""
    cloud = Cloud(POINTS, np.full((30, 3), 0.5, np.float32), np.ones(30, np.float32), np.ones((30, 2), np.float32))
    found = []
    for name, ascii in (("a.ply", True), ("b.ply", False), ("a.pcd", True), ("b.pcd", False), ("c.npy", False),
                        ("c.npz", False), ("c.csv", False), ("c.xyz", False)):  # fmt: skip
        write_cloud(folder / name, cloud, ascii=ascii)
        data = (folder / name).read_bytes()
        found += [("cloud", name, data), ("table", name, data)]
    listed = LISTED + struct.pack("<b3ib3i", 3, 0, 1, 0, 3, 1, 0, 1) + POINTS[:2].tobytes()
    head = "# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary_compressed\n"
    packed = head.encode() + struct.pack("<II", 25, 24) + b"\x17" + POINTS[:2].T.tobytes()
    found += [("cloud", "listed.ply", listed), ("cloud", "packed.pcd", packed)]
    save_rig(folder / "rig.json", RIG)
    xml = "<?xml version='1.0'?><opencv_storage><Q><rows>4</rows><cols>4</cols><data>" + " ".join(["1."] * 16)
    xml += "</data></Q></opencv_storage>"
    for name, data in (("rig.json", (folder / "rig.json").read_bytes()), ("calib.txt", MIDDLEBURY.encode()),
                       ("kitti.txt", KITTI.encode()), ("rig.yml", STORAGE.encode()), ("rig.xml", xml.encode())):  # fmt: skip
        found.append(("rig", name, data))
    image = np.random.default_rng(1).integers(0, 255, (40, 50, 3), np.uint8)
    for suffix in (".png", ".jpg", ".bmp", ".tiff", ".webp", ".pgm"):
        kinds = (("image", image[..., 0] if suffix == ".pgm" else image), ("disparity", image[..., 0]))
        found += [(reader, f"a{suffix}", bytes(cv2.imencode(suffix, pixels)[1])) for reader, pixels in kinds]
    found.append(("disparity", "a.pfm", b"Pf\n6 5\n-1.0\n" + POINTS.tobytes()[:120]))
    report.save(make_scene(dtype=np.float32), folder / "scene", view=False)
    found += [
        ("scene", name, (folder / "scene" / name).read_bytes()) for name in ("scene.json", "arrays.npz", "rig.json")
    ]
    return found


def png(width: int, height: int, rows: bytes) -> bytes:
    """A PNG that says any size and holds any rows."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def npy(shape: tuple[int, ...], body: bytes = b"", descr: str = "<f4") -> bytes:
    """An NPY file that says any shape."""
    head = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    head += b" " * (63 - (10 + len(head)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body


def zipped(members: dict[str, bytes]) -> bytes:
    """A zip file."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


class Payload:
    """Unpickled, it would leave a trace."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("UNPICKLED",)


def bombs() -> list[tuple[str, str, bytes]]:
    """Files that promise or unpack to far more than they are, and files that want to be run."""
    big = zipped({"points.npy": npy((100_000_000, 3), bytes(300_000_000)), "x.npy": npy((3,), bytes(12))})
    lies = zipped({"points.npy": npy((10**12, 3), bytes(24))})
    pickled = io.BytesIO()
    np.save(pickled, np.array([Payload()], dtype=object), allow_pickle=True)
    deep = 20_000
    entities = "<!DOCTYPE x [<!ENTITY a '" + "a" * 10_000 + "'>]><x>" + "&a;" * 100_000 + "</x>"
    laughs = "<!DOCTYPE x [<!ENTITY a0 'ha'>" + "".join(f"<!ENTITY a{i + 1} '{f'&a{i};' * 10}'>" for i in range(12))
    ply = b"ply\nformat %s 1.0\n%sproperty float x\nproperty float y\nproperty float z\nend_header\n"
    pcd = "# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT %s\nWIDTH %s\nHEIGHT 1\nPOINTS %s\nDATA %s\n"
    back = LISTED.replace(b"face 2", b"face 999999999999") + b"\xff" * 200
    found = [("cloud", name, data) for name, data in (
        ("huge.ply", ply % (b"binary_little_endian", b"element vertex 999999999999\n") + bytes(24)),
        ("ascii.ply", ply % (b"ascii", b"element vertex 999999999999\n") + b"1 2 3\n"),
        ("before.ply", ply % (b"binary_little_endian", b"element a 999999999999999\nelement vertex 1\n") + bytes(12)),
        ("back.ply", back),
        ("header.ply", b"ply\n" + b"comment x\n" * 500_000),
        ("count.pcd", (pcd % ("1 1 999999999999", 1, 1, "binary")).encode() + bytes(12)),
        ("points.pcd", (pcd % ("1 1 1", 10**15, 10**15, "binary_compressed")).encode() + struct.pack("<II", 9, 2**32 - 1)),
        ("digits.pcd", (pcd % ("1 1 1", "9" * 5000, "9" * 5000, "ascii")).encode()),
        ("wide.csv", b"1," * 400_000 + b"1\n"),
        ("quotes.csv", b'"' * 400_000),
    )]  # fmt: skip
    for reader in ("cloud", "table", "disparity"):
        found += [
            (reader, "big.npz", big),
            (reader, "lies.npz", lies),
            (reader, "lies.npy", npy((10**12, 3), bytes(24))),
            (reader, "negative.npy", npy((-1, 3), bytes(24))),
            (reader, "overflow.npy", npy((2**62, 2**62), bytes(24))),
            (reader, "object.npy", pickled.getvalue()),
            (reader, "object.npz", zipped({"points.npy": pickled.getvalue()})),
            (reader, "pickle.npy", pickle.dumps(Payload())),
            (reader, "record.npy", npy((2,), bytes(24), "|V12")),
        ]
    found += [("rig", name, text.encode()) for name, text in (
        ("laughs.xml", laughs + "]><x>&a12;</x>"),
        ("entities.xml", entities),
        ("outside.xml", "<!DOCTYPE x [<!ENTITY a SYSTEM 'file:///etc/hostname'>]><opencv_storage><Q>&a;</Q></opencv_storage>"),
        ("deep.xml", "<a>" * deep + "</a>" * deep),
        ("deep.json", '{"a":' * deep + "1" + "}" * deep),
        ("lists.json", '{"schema": "jaxfuzzy/rig", "version": 1, "a": ' + "[" * deep + "]" * deep + "}"),
        ("brackets.yml", "a: " + "[" * 300_000),
        ("lines.txt", "cam0 = 1" + "\n" * 300_000),
        ("blanks.txt", "cam0 = [" + " " * 300_000 + "x"),
        ("digits.txt", "cam0 = [" + "1" * 300_000 + "]"),
        ("dashes.yml", "a:\n" + "- 1\n" * 100_000),
        ("indent.yml", "".join(" " * i + "a:\n" for i in range(1500))),
    )]  # fmt: skip
    for reader in ("image", "disparity"):
        found += [
            (reader, "says.png", png(60_000, 60_000, b"\0" * 100)),
            (reader, "says_more.png", png(2**31 - 1, 2**31 - 1, b"\0" * 100)),
            (reader, "zeros.png", png(30_000, 30_000, bytes(30_001 * 30_000 // 16))),
            (
                reader,
                "says.bmp",
                b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 2**20, 2**20, 1, 24, 0, 0, 0, 0, 0, 0),
            ),
            (reader, "says.pgm", b"P5\n1000000 1000000\n255\n" + bytes(100)),
            (reader, "says.pfm", b"Pf\n1000000 1000000\n-1.0\n" + bytes(100)),
            (reader, "text.svg", b"<svg/>"),
        ]
    found += [
        (
            "scene",
            "scene.json",
            ('{"schema": "jaxfuzzy/scene", "version": 1, "files": ' + "[" * deep + "]" * deep + "}").encode(),
        ),
        ("scene", "arrays.npz", big),
        ("scene", "arrays.npz", lies),
        ("scene", "arrays.npz", zipped({"cloud.points.npy": pickled.getvalue()})),
    ]
    return found


def damaged(data: bytes, rng: random.Random) -> bytes:
    """A file after one to four accidents."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(8):
            case 0:
                data = data[:at]
            case 1:
                flipped = bytearray(data)
                for _ in range(rng.choice((1, 1, 8, 64))):
                    if flipped:
                        flipped[rng.randrange(min(len(flipped), rng.choice((64, 512, 1 << 30))))] ^= 1 << rng.randrange(
                            8
                        )
                data = bytes(flipped)
            case 2:
                data = data[:at] + rng.randbytes(rng.choice((1, 4, 100))) + data[at:]
            case 3:
                data = data[:at] + data[at + rng.choice((1, 4, 100)) :]
            case 4 | 5:  # a number of the text becomes another
                spots = [i for i in range(min(len(data), 4096)) if data[i : i + 1].isdigit()]
                if spots:
                    start = end = rng.choice(spots)
                    while end < len(data) and data[end : end + 1] in b"0123456789.e+-":
                        end += 1
                    data = data[:start] + rng.choice(NUMBERS) + data[end:]
            case 6:
                piece = data[at : at + rng.choice((1, 16, 200))]
                data = data[:at] + piece * rng.choice((2, 50)) + data[at:]
            case 7:  # words change places
                words = data.split(b" ")
                if len(words) > 2:
                    i, j = rng.randrange(len(words)), rng.randrange(len(words))
                    words[i], words[j] = words[j], words[i]
                    data = b" ".join(words)
    return data


def read(reader: str, path: Path) -> object:
    """What a reader makes of a file."""
    if reader == "cloud":
        return read_cloud(path)
    if reader == "table":
        return read_points(path)[1]
    if reader == "rig":
        return load_rig(path)
    if reader == "image":
        return read_grey(path, "left")
    if reader == "disparity":
        return read_disparity(path)
    return report.load(path.parent)


def finite(reader: str, result: object) -> bool:
    """Whether nothing in a result is NaN or infinite that should not be."""
    if reader in ("scene", "disparity", "table"):
        return True  # infinite scores, unknown pixels and what a table holds are legal there; `fcm` refuses the rest
    leaves = jax.tree.leaves(vars(result) if reader == "rig" else result)
    return all(np.isfinite(leaf).all() for leaf in leaves if isinstance(leaf, float | np.ndarray | jax.Array))


def main() -> int:
    """Runs the cases; the exit status says whether all were right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="one case by its number")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sound, worst = originals(folder), bombs()
        for reader, file, data in sound:  # each reader must take the sound files, or the rest proves nothing
            (folder / file).write_bytes(data)
            if reader != "scene":
                read(reader, folder / file)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
        print(f"seed {args.seed}, {len(worst)} made by hand, {args.cases} by accident", flush=True)
        tally = {"read": 0, "refused": 0}
        wrong, slowest = [], (0.0, -1)
        numbers = range(len(worst) + args.cases) if args.only is None else [args.only]
        for number in numbers:
            if number < len(worst):
                reader, file, data = worst[number]
            else:
                rng = random.Random(f"{args.seed} {number}")
                reader, file, data = rng.choice(sound)
                data = damaged(data, rng)
            path = folder / ("scene" if reader == "scene" else "") / file
            before = path.read_bytes() if reader == "scene" else b""
            path.write_bytes(data)
            print(
                f"\r{number} {reader} {file} ", end="", file=sys.stderr, flush=True
            )  # the last one said is the one that hangs
            begin = time.perf_counter()
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            try:
                result = read(reader, path)
                tally["read"] += 1
                if not finite(reader, result):
                    wrong.append((number, reader, file, "a result that is not finite"))
            except (ValueError, FileNotFoundError) as error:
                tally["refused"] += 1
                if "\n" in str(error) or not str(error) or len(str(error)) > 1000:
                    wrong.append((number, reader, file, f"an error of several lines or none: {str(error)[:300]!r}"))
            except BaseException:
                wrong.append((number, reader, file, traceback.format_exc(limit=-4)))
            faulthandler.cancel_dump_traceback_later()
            slowest = max(slowest, (time.perf_counter() - begin, number))
            if reader == "scene":
                path.write_bytes(before)
        for number, reader, file, why in wrong[:40]:
            print(f"case {number} of seed {args.seed} ({reader}, {file}): {why}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps(tally | {"wrong": len(wrong), "slowest": [round(slowest[0], 2), slowest[1]], "peak_mib": peak}))
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
