"""A scene for other programs: what was found out about each point, and the models as GLB and OBJ.

Models are written in metres and turned upright, y up, as glTF prescribes; the cloud stays in the camera's frame.
"""

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfuzzy import drawing
from jaxfuzzy.fitting import distances
from jaxfuzzy.primitives import PRIMITIVES

if TYPE_CHECKING:
    from jaxfuzzy.scene import Scene

# The number that stands for each kind in the cloud's `kind` column; 0 is no object.
KIND_NUMBERS = {name: number for number, name in enumerate((*PRIMITIVES, "unknown"), start=1)}
_GLTF_UNSIGNED_INT, _GLTF_FLOAT = 5125, 5126
_GLTF_VERTICES, _GLTF_INDICES = 34962, 34963


def point_columns(scene: "Scene") -> dict[str, np.ndarray]:
    """What was found out about each point, by name.

    object: number of its object, -1 for none. kind: of its object, see `KIND_NUMBERS`. membership: in its object, not a
    number where memberships were not kept. inlier: whether it lies on its object's surface. residual: distance to that
    surface in metres, not a number where there is none.
    """
    points, labels = np.asarray(scene.cloud.points), np.asarray(scene.segmentation.labels)
    numbers = np.array([KIND_NUMBERS[shape.kind] for shape in scene.shapes] + [0], np.uint8)
    residual = np.full(len(points), np.nan, points.dtype)
    inlier = np.zeros(len(points), bool)
    for index, shape in enumerate(scene.shapes):
        own = np.flatnonzero(labels == index)
        inlier[own] = np.asarray(shape.inliers)
        if shape.primitive is not None:
            residual[own] = distances(shape.primitive, points[own])
    degrees = np.asarray(scene.segmentation.partition.memberships)
    membership = np.full(len(points), np.nan)
    membership[labels < 0] = 0.0
    if len(degrees) == len(points):
        found = np.flatnonzero(labels >= 0)
        membership[found] = degrees[found, labels[found]]
    return {
        "object": labels.astype(np.int32),
        "kind": numbers[labels],
        "membership": membership.astype(points.dtype),
        "inlier": inlier,
        "residual": residual,
    }


def bodies(scene: "Scene") -> list[tuple[str, int, dict[str, Any], np.ndarray, np.ndarray]]:
    """Everything of a scene that has a mesh: name, object number, what it is, vertices (V, 3) upright y up, faces (F, 3)."""
    right, away, up = drawing.upright_frame(scene.up)
    turn = np.stack([right, up, -away])
    found = []
    for index, shape in enumerate(scene.shapes):
        vertices, faces = drawing.mesh(shape.primitive)
        if shape.primitive is not None and len(faces):
            found.append((f"object {drawing.name(index, shape)}", index, shape.primitive.to_dict(), vertices, faces))
    if scene.ground is not None:
        vertices, faces = drawing.mesh(scene.ground)
        found.append(("ground", -1, scene.ground.to_dict(), vertices, faces))
    return [(name, index, what, vertices @ turn.T, faces) for name, index, what, vertices, faces in found]


def obj(scene: "Scene") -> str:
    """The models as Wavefront OBJ, one object each, with vertex colors."""
    lines = ["# jaxfuzzy: metres, y up"]
    before = 1
    for name, index, _, vertices, faces in bodies(scene):
        tint = "{:.4f} {:.4f} {:.4f}".format(*drawing.rgb(index))
        lines.append(f"o {name.replace(' ', '_')}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f} {tint}" for x, y, z in vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + before]
        before += len(vertices)
    return "\n".join(lines) + "\n"


def glb(scene: "Scene") -> bytes:
    """The models as binary glTF 2.0: one named node an object, its kind and numbers (camera's frame) in `extras`."""
    found = bodies(scene)
    blob = bytearray()
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "jaxfuzzy"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(found)))}],
    }

    def add(array: np.ndarray, target: int, **accessor: Any) -> int:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes, "target": target})
        blob.extend(array.tobytes())
        accessors.append({"bufferView": len(views) - 1, **accessor})
        return len(accessors) - 1

    nodes, meshes, materials = [], [], []
    for number, (name, index, what, vertices, faces) in enumerate(found):
        places = np.ascontiguousarray(vertices, "<f4")
        corners = np.ascontiguousarray(faces, "<u4").ravel()
        bounds = {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
        at = add(places, _GLTF_VERTICES, componentType=_GLTF_FLOAT, count=len(places), type="VEC3", **bounds)
        by = add(corners, _GLTF_INDICES, componentType=_GLTF_UNSIGNED_INT, count=len(corners), type="SCALAR")
        primitive = {"attributes": {"POSITION": at}, "indices": by, "material": number}
        meshes.append({"name": name, "primitives": [primitive]})
        nodes.append({"name": name, "mesh": number, "extras": what})
        tint = [*(linear(value) for value in drawing.rgb(index)), 1.0]
        surface = {"baseColorFactor": tint, "metallicFactor": 0.0, "roughnessFactor": 0.8}
        materials.append({"name": name, "doubleSided": True, "pbrMetallicRoughness": surface})
    if found:  # glTF forbids empty lists
        tree |= {"nodes": nodes, "meshes": meshes, "materials": materials}
        tree |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(blob)}]}
    else:
        tree["scenes"] = [{}]
    text = json.dumps(tree, allow_nan=False).encode()
    chunks = _chunk(b"JSON", text, b" ") + (_chunk(b"BIN\0", bytes(blob), b"\0") if found else b"")
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def linear(value: float) -> float:
    """An sRGB tone in 0..1 as linear light, which glTF counts in (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def _chunk(kind: bytes, data: bytes, filler: bytes) -> bytes:
    data += filler * (-len(data) % 4)
    return struct.pack("<I", len(data)) + kind + data
