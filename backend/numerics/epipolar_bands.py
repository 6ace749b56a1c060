"""Light part of the projector's epipolar lines at a time: second reflections mostly come from other lines."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from backend.numerics.camera_model import (
    Pinhole,
    RigidTransform,
    check_pinhole,
    check_transform,
    ray_lattice,
)
from backend.numerics.errors import CalibrationError


class EpipolarLines(NamedTuple):
    """Which epipolar line every pixel lies on: where the line crosses the middle of the projector, in [px] of rows.

    A camera pixel and the projector pixel that lights it directly have the same number, wherever the surface is.
    """

    projector_px: Float32[np.ndarray, "hp wp"]
    camera_px: Float32[np.ndarray, "h w"]


def epipolar_lines(
    camera: Pinhole, projector: Pinhole, projector_from_camera: RigidTransform
) -> EpipolarLines:
    r"""Find the epipolar line of every pixel of a camera and a projector.

    Parameters
    ----------
    camera, projector
        Models of both, lens distortion included.
    projector_from_camera
        Pose of the projector.

    Raises
    ------
    CalibrationError
        If a model or the pose can't be used, or the camera stands above or below the projector: then the lines
        run along its columns and don't cross its middle column.

    Notes
    -----
    With the camera's centre t in the projector's frame, every ray q of the projector and every ray R r of a camera
    pixel lies in the epipolar plane of normal :math:`l = t \times q`. The plane cuts the projector's middle column
    x = 0 at :math:`y = -l_z / l_y = (t_x q_y - t_y q_x) / (t_x q_z - t_z q_x)`, given in pixels by the
    projector's focal length.
    """
    check_pinhole(camera, "the camera")
    check_pinhole(projector, "the projector")
    check_transform(projector_from_camera, "the projector")
    R, t_mm = projector_from_camera
    if abs(t_mm[0]) < 0.2 * float(np.linalg.norm(t_mm)):
        raise CalibrationError(
            "camera and projector stand above each other, so no line between them crosses the projector's columns; "
            "put the camera to the projector's side"
        )
    scale_px = projector.K[1, 1]
    return EpipolarLines(
        _crossings(projector, np.eye(3), t_mm, scale_px), _crossings(camera, R, t_mm, scale_px)
    )


def _crossings(
    device: Pinhole, R: Float[np.ndarray, "3 3"], t_mm: Float[np.ndarray, "3"], scale_px: float
) -> Float32[np.ndarray, "h w"]:
    """Return where the epipolar lines of a device's pixels cross the projector's x = 0."""
    x, y = ray_lattice(device).map()
    turned = [R[row, 0] * x + R[row, 1] * y + R[row, 2] for row in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (t_mm[0] * turned[1] - t_mm[1] * turned[0]) / (
            t_mm[0] * turned[2] - t_mm[2] * turned[0]
        )
    return np.asarray(slope * scale_px, np.float32)


class Bands(NamedTuple):
    """Epipolar lines gathered into bands, which are numbered by a Gray code."""

    low_px: float
    """Where the first band begins."""
    width_px: float
    bits: int

    def number(self, lines_px: Float32[np.ndarray, "*shape"]) -> Int32[np.ndarray, "*shape"]:
        """Return the Gray-coded number of each line's band; lines outside belong to the first or last one."""
        last = 2**self.bits - 1
        with np.errstate(invalid="ignore"):
            plain = np.clip(np.floor((lines_px - self.low_px) / self.width_px), 0, last)
        band = np.nan_to_num(plain).astype(np.int32)
        return np.asarray(band ^ (band >> 1), np.int32)

    def lit(
        self, lines_px: Float32[np.ndarray, "*shape"], bit: int, *, inverse: bool
    ) -> Bool[np.ndarray, "*shape"]:
        """Tell which lines are lit when the bands are whose bit is 1 (`inverse`: 0)."""
        is_set = (self.number(lines_px) >> bit) & 1 == 1
        return np.asarray(is_set != inverse)

    def well_lit(
        self, lines_px: Float32[np.ndarray, "*shape"], bit: int, *, inverse: bool, margin_px: float
    ) -> Bool[np.ndarray, "*shape"]:
        """Tell which lines are lit and farther than a margin from any dark one."""
        places = (lines_px, lines_px - np.float32(margin_px), lines_px + np.float32(margin_px))
        return np.asarray(
            np.logical_and.reduce([self.lit(place, bit, inverse=inverse) for place in places])
        )


def bands_around(
    lines_px: Float32[np.ndarray, "n"], bits: int, *, margin_px: float = 10.0
) -> Bands:
    """Divide the lines of the given pixels, but for the outermost half percent on each side, into 2**bits bands.

    Raises
    ------
    CalibrationError
        If no line is known.
    """
    known = lines_px[np.isfinite(lines_px)]
    if known.size == 0:
        raise CalibrationError("none of the pixels has an epipolar line; check the calibration")
    low, high = np.percentile(known, [0.5, 99.5]).astype(float)
    return Bands(low - margin_px, (high - low + 2 * margin_px) / 2**bits, bits)


class Best(NamedTuple):
    """The coordinate of every pixel from the measurement with the least light so far."""

    projector_px: Float32[np.ndarray, "h w"]
    """NaN where no measurement serves."""
    sigma_px: Float32[np.ndarray, "h w"]
    brightness: Float32[np.ndarray, "h w"]
    """Of that measurement; infinite where there is none."""


SAME_LIGHT = 0.05
"""Measurements whose brightness differs by less got the same light."""
_AGREES_SIGMAS = 3.0


def nothing_yet(shape: tuple[int, int]) -> Best:
    """Return what is known before the first measurement."""
    return Best(
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.inf, np.float32),
    )


def take_in(
    best: Best,
    projector_px: Float32[np.ndarray, "h w"],
    sigma_px: Float32[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"],
    serves: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    r"""Take in a further measurement, in place.

    Parameters
    ----------
    best
        What is known so far; changed.
    projector_px, sigma_px, brightness
        Coordinate, its standard deviation, and brightness per exposure time of the measurement.
    serves
        Pixels that were lit directly and have a coordinate.

    Returns
    -------
    Where it replaced what was known.

    Notes
    -----
    Direct light is the same in every measurement that lights a pixel directly; whatever comes on top came by another
    way. So the darkest one has the least of that. One that is as dark to 5 % and agrees within 3 sigma is averaged
    with it, weighted by :math:`1/\sigma^2`.
    """
    known = serves & np.isfinite(projector_px) & np.isfinite(sigma_px)
    with np.errstate(invalid="ignore"):
        darker = known & (brightness < np.float32(1 - SAME_LIGHT) * best.brightness)
        alike = known & ~darker & (brightness <= np.float32(1 + SAME_LIGHT) * best.brightness)
        off = np.abs(projector_px - best.projector_px)
        alike &= off <= np.float32(_AGREES_SIGMAS) * np.hypot(sigma_px, best.sigma_px)
    for target, source in zip(best, (projector_px, sigma_px, brightness), strict=True):
        target[darker] = source[darker]
    weight, added = 1 / best.sigma_px[alike] ** 2, 1 / sigma_px[alike] ** 2
    best.projector_px[alike] = (weight * best.projector_px[alike] + added * projector_px[alike]) / (
        weight + added
    )
    best.sigma_px[alike] = 1 / np.sqrt(weight + added)
    best.brightness[alike] = np.minimum(best.brightness[alike], brightness[alike])
    return np.asarray(darker)
