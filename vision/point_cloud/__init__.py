"""Point clouds: depth to points, filters, shapes, clusters, alignment, files.

>>> import numpy as np
>>> from vision import CameraModel
>>> from vision.point_cloud import cloud_from_depth, voxel_grid
>>> camera = CameraModel.from_horizontal_fov(64, 48, 1.2)
>>> cloud = cloud_from_depth(np.full((48, 64), 2.0, np.float32), camera)
>>> len(cloud), cloud.frame
(3072, 'camera')
>>> len(voxel_grid(cloud, 0.5)) < 100
True
"""

from vision.point_cloud.cloud import FRAMES, CloudFrame, PointCloud, cloud_from_depth
from vision.point_cloud.clusters import Cluster, Scene, euclidean_clusters, scene_of
from vision.point_cloud.files import CloudFileError, read_cloud, write_cloud
from vision.point_cloud.filters import pass_through, remove_outliers, voxel_grid
from vision.point_cloud.registration import Alignment, RegistrationError, align
from vision.point_cloud.surfaces import Plane, estimate_normals, ground_plane, key_points

__all__ = [
    "FRAMES",
    "Alignment",
    "CloudFileError",
    "CloudFrame",
    "Cluster",
    "Plane",
    "PointCloud",
    "RegistrationError",
    "Scene",
    "align",
    "cloud_from_depth",
    "estimate_normals",
    "euclidean_clusters",
    "ground_plane",
    "key_points",
    "pass_through",
    "read_cloud",
    "remove_outliers",
    "scene_of",
    "voxel_grid",
    "write_cloud",
]
