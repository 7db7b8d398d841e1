"""Differentiable fuzzy clustering of 3D data in JAX: from a stereo photograph to boxes, cylinders, cones and spheres.

`scene` is the way in for readers: it walks from a stereo pair to shapes and shows where everything lives.
"""

from importlib.metadata import version as _version

from jaxfuzzy import losses as losses
from jaxfuzzy import plot as plot
from jaxfuzzy.blocks import Blocks as Blocks
from jaxfuzzy.blocks import blocks as blocks
from jaxfuzzy.calibrate import calibrate as calibrate
from jaxfuzzy.checks import DataError as DataError
from jaxfuzzy.cloud import Cloud as Cloud
from jaxfuzzy.cloud import read_cloud as read_cloud
from jaxfuzzy.cloud import write_cloud as write_cloud
from jaxfuzzy.conditioning import conditioning as conditioning
from jaxfuzzy.fcm import NoiseRule as NoiseRule
from jaxfuzzy.fcm import Partition as Partition
from jaxfuzzy.fcm import fcm as fcm
from jaxfuzzy.fcm import memberships as memberships
from jaxfuzzy.ground import find_ground as find_ground
from jaxfuzzy.ground import upright as upright
from jaxfuzzy.matcher import Matcher as Matcher
from jaxfuzzy.photos import read_depth as read_depth
from jaxfuzzy.photos import read_disparity as read_disparity
from jaxfuzzy.photos import rectify as rectify
from jaxfuzzy.primitives import Box as Box
from jaxfuzzy.primitives import Cone as Cone
from jaxfuzzy.primitives import Cylinder as Cylinder
from jaxfuzzy.primitives import Plane as Plane
from jaxfuzzy.primitives import Quadric as Quadric
from jaxfuzzy.primitives import Sphere as Sphere
from jaxfuzzy.recover import recover as recover
from jaxfuzzy.reproject import cloud_from_depth as cloud_from_depth
from jaxfuzzy.reproject import cloud_from_disparity as cloud_from_disparity
from jaxfuzzy.reproject import measure_noise as measure_noise
from jaxfuzzy.rig import Rig as Rig
from jaxfuzzy.rig import load_rig as load_rig
from jaxfuzzy.rig import save_rig as save_rig
from jaxfuzzy.scene import Scene as Scene
from jaxfuzzy.scene import load_scene as load_scene
from jaxfuzzy.scene import model_cloud as model_cloud
from jaxfuzzy.scene import model_scene as model_scene
from jaxfuzzy.seeding import Seeds as Seeds
from jaxfuzzy.seeding import histogram_seeds as histogram_seeds
from jaxfuzzy.seeding import principal_axes as principal_axes
from jaxfuzzy.segment import Segmentation as Segmentation
from jaxfuzzy.segment import segment as segment
from jaxfuzzy.sensitivity import Influence as Influence
from jaxfuzzy.sensitivity import influence as influence
from jaxfuzzy.shapes import Shape as Shape
from jaxfuzzy.shapes import fit_shape as fit_shape
from jaxfuzzy.shapes import fit_shapes as fit_shapes
from jaxfuzzy.solve import Solver as Solver
from jaxfuzzy.status import Status as Status
from jaxfuzzy.status import describe as describe
from jaxfuzzy.stereo import disparity as disparity
from jaxfuzzy.stereo import example_pair as example_pair
from jaxfuzzy.stereo import reconstruct as reconstruct
from jaxfuzzy.tuning import Hyper as Hyper
from jaxfuzzy.tuning import Tuned as Tuned
from jaxfuzzy.tuning import tune as tune
from jaxfuzzy.validity import ClusterCount as ClusterCount
from jaxfuzzy.validity import choose_k as choose_k
from jaxfuzzy.validity import fuzzy_silhouette as fuzzy_silhouette
from jaxfuzzy.validity import partition_coefficient as partition_coefficient
from jaxfuzzy.validity import variance_ratio as variance_ratio
from jaxfuzzy.validity import xie_beni as xie_beni
from jaxfuzzy.varieties import Varieties as Varieties
from jaxfuzzy.varieties import nfcv as nfcv

__version__ = _version("jaxfuzzy")
