"""Real clouds whose shapes are known: a stereo cloud of a mug."""

import numpy as np

from jaxfuzzy.cloud import Cloud
from jaxfuzzy.scene import model_cloud


def finite(xyz, step):
    p = xyz[::step, ::step].reshape(-1, 3).astype(np.float32)
    return p[np.isfinite(p).all(1)]


def test_the_mug_of_a_stereo_cloud_is_a_cylinder_of_its_radius(shared_data):
    points = finite(np.load(shared_data / "pcl_mug_stereo" / "table_scene_mug_stereo_textured.npz")["xyz"], 3)
    # Without the wall behind the table.
    scene = model_cloud(Cloud(points[points[:, 2] < 1.5]))
    largest = max(scene.shapes, key=lambda shape: len(shape.inliers))
    assert largest.kind == "cylinder"
    # 39.0 mm by a circle fit to its side, 39.6 mm in PCL's own tutorial.
    np.testing.assert_allclose(largest.primitive.radius, 0.039, rtol=0.03)
