"""Run the kernels of matching, triangulation, normals and filters once on tiny maps."""

import numpy as np

from backend.numerics.camera_model import Pinhole, RigidTransform
from backend.numerics.confirmation import settle
from backend.numerics.drift import take_off_drift
from backend.numerics.filters import within_limits, without_outliers, without_specks
from backend.numerics.matching import match, sample_partner
from backend.numerics.normals import normals
from backend.numerics.rectification import rectify
from backend.numerics.triangulation import (
    depth_consistency,
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
    points_mm = cloud.points_mm
    normals(points_mm, camera)
    settle(cloud, matches.reasons, u_px, sigma_px, u_px + 4, pair, camera, aside)
    within_limits(cloud.depth_mm, cloud.sigma_mm, highest=1.0)
    without_outliers(cloud.depth_mm, sigma_mm=cloud.sigma_mm, pixel_angle_rad=1 / 80)
    without_specks(cloud.depth_mm, least_pixels=2, pixel_angle_rad=1 / 80)
    triangulate_projector(u_px, camera, camera, aside, sigma_projector_px=sigma_px)
    projector_consistency(points_mm, u_px, camera, aside)
    take_off_drift(np.tile(depth_consistency(cloud, u_px, camera, aside), (6, 6)))
