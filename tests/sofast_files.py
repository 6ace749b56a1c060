"""A small SOFAST measurement, simulated: a tilted mirror of known focal lengths before a flat screen."""

from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

FOCAL_M = (30.0, 20.0)
SIZE = (120, 90)
CORNERS_M = np.array([[0.5, -0.5, -0.5, 0.5], [-0.4, -0.4, 0.4, 0.4], [0.0] * 4])
PERIODS = np.array([0.9, 3.9, 15.9])

HDF5_NAMES = {
    "fringe_images": "MeasurementSofastFringe/fringe_images",
    "mask_images": "MeasurementSofastFringe/mask_images",
    "fringe_periods_x": "MeasurementSofastFringe/fringe_periods_x",
    "fringe_periods_y": "MeasurementSofastFringe/fringe_periods_y",
    "dist_optic_screen": "MeasurementSofastFringe/dist_optic_screen",
    "v_measure_point_facet": "MeasurementSofastFringe/v_measure_point_facet",
    "name": "MeasurementSofastFringe/name",
    "date": "MeasurementSofastFringe/date",
    "camera_matrix": "Camera/intrinsic_mat",
    "distortion": "Camera/distortion_coef",
    "image_shape_xy": "Camera/image_shape_xy",
    "display_fraction_xy": "DisplayShape/xy_screen_fraction",
    "display_xyz_m": "DisplayShape/xyz_screen_coords",
    "r_cam_screen": "SpatialOrientation/r_cam_screen",
    "v_cam_screen_cam": "SpatialOrientation/v_cam_screen_cam",
    "pose_r_cam_optic": "SpatialOrientation/r_cam_optic",
    "pose_v_cam_optic_cam": "SpatialOrientation/v_cam_optic_cam",
}


def measurement(seed: int = 0) -> dict[str, Any]:
    """Trace every pixel and draw the fringes that it sees; keys as in the `.npz` files."""
    width, height = SIZE
    K = np.array([[400.0, 0, 60], [0, 400, 45], [0, 0, 1]])
    mirror_turn = np.array([np.pi - 0.06, 0.0, 0.0])
    R = cv2.Rodrigues(mirror_turn)[0]
    middle = np.array([0.05, 0.1, 5.0])
    screen_turn, screen_origin = np.array([0.05, np.pi, 0.0]), np.array([-0.3, 1.2, 0.4])
    S = cv2.Rodrigues(screen_turn)[0]

    y, x = np.mgrid[:height, :width]
    rays = np.stack([(x - 60) / 400, (y - 45) / 400, np.ones(x.shape)], -1).reshape(-1, 3)
    camera = -R @ middle
    along = rays @ R.T
    bend = np.array([0.25 / FOCAL_M[0], 0.25 / FOCAL_M[1]])
    z = np.zeros(len(along))
    for _ in range(8):
        at = camera[:2] + ((z - camera[2]) / along[:, 2])[:, None] * along[:, :2]
        z = at**2 @ bend
    points = np.column_stack([at, z])
    normals = np.column_stack([-2 * bend * at, np.ones(len(at))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inwards = (points - camera) / np.linalg.norm(points - camera, axis=1, keepdims=True)
    outwards = inwards - 2 * (inwards * normals).sum(1)[:, None] * normals
    # Into the screen's frame, by way of the camera's.
    start = (points @ R + middle - screen_origin) @ S.T
    way = outwards @ R @ S.T
    hit = start - (start[:, 2] / way[:, 2])[:, None] * way
    screen_m = np.array([6.0, 4.0])
    fraction = hit[:, :2] / screen_m + 0.5
    on_mirror = (np.abs(at[:, 0]) < 0.5) & (np.abs(at[:, 1]) < 0.4)
    assert (np.abs(fraction[on_mirror] - 0.5) < 0.5).all()

    rng = np.random.default_rng(seed)

    def picture(light):
        gray = np.where(on_mirror, 20 + 190 * light, 6.0) + rng.normal(0, 0.4, len(light))
        return np.clip(np.rint(gray), 0, 255).astype(np.uint8).reshape(height, width)

    fringes = [
        picture(0.5 + 0.5 * np.cos(2 * np.pi * p * u - k * np.pi / 2))
        for u in (1 - fraction[:, 1], fraction[:, 0])
        for p in PERIODS
        for k in range(4)
    ]
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 5)), -1).reshape(-1, 2)
    return {
        "fringe_images": np.stack(fringes),
        "mask_images": np.stack([picture(0 * z), picture(0 * z + 1)]),
        "fringe_periods_x": PERIODS,
        "fringe_periods_y": PERIODS,
        "dist_optic_screen": np.float64(np.linalg.norm(middle - screen_origin)),
        "v_measure_point_facet": np.zeros(3),
        "name": "a facet",
        "date": "2023-01-13T11:30:05",
        "camera_matrix": K * [[1, 1, 1], [1, 1, 1], [1, 1, 0.125]],
        "distortion": np.zeros(5),
        "image_shape_xy": np.array(SIZE),
        "display_fraction_xy": grid.T,
        "display_xyz_m": np.column_stack([(grid - 0.5) * screen_m, np.zeros(len(grid))]).T,
        "r_cam_screen": screen_turn,
        "v_cam_screen_cam": screen_origin,
        "pose_r_cam_optic": mirror_turn + np.array([0.01, -0.004, 0.002]),
        "pose_v_cam_optic_cam": middle * 1.01,
        "facet_corners_m": CORNERS_M,
    }


def write_npz(path: Path, **changes: Any) -> Path:
    """Write a measurement, with other values for some keys, or without those that are None."""
    arrays = {k: v for k, v in (measurement() | changes).items() if v is not None}
    np.savez(path, **arrays)
    return path


def write_hdf5(path: Path, names: tuple[str, ...] = tuple(HDF5_NAMES)) -> Path:
    """Write (some of) a measurement as SOFAST does: pictures along the last axis."""
    arrays = measurement()
    with h5py.File(path, "w") as file:
        for name in names:
            value = arrays[name]
            if name in ("fringe_images", "mask_images"):
                value = np.moveaxis(value, 0, -1)
            file[HDF5_NAMES[name]] = value
        if "display_xyz_m" in names:
            file["DisplayShape/screen_model"] = "distorted3D"
    return path
