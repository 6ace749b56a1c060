"""Run the kernels of matching, triangulation, normals and filters once on tiny maps."""

import numpy as np

from backend.numerics.camera_model import Pinhole, RigidTransform
from backend.numerics.filters import without_outliers
from backend.numerics.matching import match, sample_partner
from backend.numerics.normals import normals
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import (
    projector_consistency,
    triangulate_pair,
    triangulate_projector,
)


def warm_up_kernels() -> None:
    """Compile every geometric kernel, or load it from the cache."""
    K = np.array([[80.0, 0.0, 15.5], [0.0, 80.0, 11.5], [0.0, 0.0, 1.0]])
    camera = Pinhole(K, np.zeros(5), 32, 24)
    aside = RigidTransform(np.eye(3), np.array([-20.0, 0.0, 0.0]))
    pair = rectify(camera, camera, aside)
    u_px = np.tile(np.arange(32, dtype=np.float32), (24, 1))
    sigma_px = np.full_like(u_px, 0.1)
    # the other camera sees everything 4 px further left: a plane at 400 mm
    matches = match(u_px, u_px + 4, pair, sigma_reference_px=sigma_px, sigma_other_px=sigma_px)
    sample_partner(u_px, matches, pair)
    cloud = triangulate_pair(matches, pair)
    normals(cloud.points_mm, camera)
    cloud.points_mm[12, 16] *= 1.5  # one outlier, or its kernel has nothing to do
    without_outliers(cloud.points_mm, sigma_mm=cloud.sigma_mm, pixel_angle_rad=1 / 80)
    triangulate_projector(u_px, camera, camera, aside, sigma_projector_px=sigma_px)
    projector_consistency(cloud.points_mm, u_px, camera, aside)
