"""Files of a measured mirror, as bytes: arrays for other programs, tables for people, a summary in numbers."""

import io
import json
import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from backend.stages.screen_phase import ScreenPhase
from backend.stages.slopes import Slopes, second_order
from backend.stages.surface import Surface

_M = 1e-3
DEFECT_RANGE = 0.3
"""Departure from the surroundings that is drawn black or white."""


def result_npz(phase: ScreenPhase, slopes: Slopes | None) -> bytes:
    """Write `result.npz`.

    frac_x, frac_y (h, w): position on the screen, x as the pattern counts it, y from the bottom up (as SOFAST does),
    NaN where invalid. wrapped_x, wrapped_y (periods, h, w) [rad], the coarsest first. slopes (2, n): dz/dx and dz/dy
    of the mirror's pixels in row-major order, NaN where unknown. surf_coefs: z = c0 + c1 x + c2 x^2 + c3 y + c4 x y +
    c5 y^2 in metres. bad_frames: numbers of the fringe frames found defective, from 0. mask (h, w): the pixels of `slopes`.
    """
    name = _camera(phase, slopes)
    empty = np.zeros((0, 0), np.float32)
    share_y = phase.share_y.get(name)
    arrays: dict[str, Any] = {
        "frac_x": phase.share_x.get(name, empty),
        "frac_y": empty if share_y is None else 1.0 - share_y.astype(np.float64),
        "wrapped_x": phase.wrapped_x_rad.get(name, empty[None]),
        "wrapped_y": phase.wrapped_y_rad.get(name, empty[None]),
        "mask": phase.mirror[name] > 0,
        "bad_frames": np.array(bad_frames(phase), np.int64),
    }
    if slopes is not None:
        arrays["slopes"] = slope_rows(slopes)
        arrays["surf_coefs"] = coefficients_m(slopes)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def surface_csv(slopes: Slopes, surface: Surface) -> bytes:
    """Write one line per pixel: its place in the picture, x y z [mm], slopes and their errors [mrad], height error [um]."""
    name = slopes.camera
    known = np.isfinite(surface.height_mm[name])
    row, column = np.nonzero(known)
    points = slopes.points_mm[name][known]
    columns = {
        "pixel_x": column,
        "pixel_y": row,
        "x_mm": points[:, 0],
        "y_mm": points[:, 1],
        "z_mm": surface.height_mm[name][known],
        "slope_x_mrad": slopes.slope_x_mrad[name][known],
        "slope_y_mrad": slopes.slope_y_mrad[name][known],
        "slope_error_x_mrad": slopes.error_x_mrad[name][known],
        "slope_error_y_mrad": slopes.error_y_mrad[name][known],
        "height_error_um": surface.error_um[name][known],
    }
    buffer = io.StringIO()
    form = ["%d", "%d", "%.4f", "%.4f", "%.6f", "%.5f", "%.5f", "%.5f", "%.5f", "%.4f"]
    table = np.stack([np.asarray(c, np.float64) for c in columns.values()], axis=1)
    np.savetxt(buffer, table, fmt=form, delimiter=",", header=",".join(columns), comments="")
    return buffer.getvalue().encode()


def surface_h5(phase: ScreenPhase, slopes: Slopes, surface: Surface) -> bytes:
    """Write every map of the mirror into one HDF5 file, with units, pose and terms."""
    # h5py costs 0.1 s to import: only exports pay.
    import h5py

    name = slopes.camera
    maps: Mapping[str, tuple[Float32[np.ndarray, "h w"], str]] = {
        "screen_share_x": (phase.share_x[name], "of the width"),
        "screen_share_y": (phase.share_y[name], "of the height"),
        "modulation": (phase.modulation_gray[name], "gray"),
        "x": (slopes.points_mm[name][..., 0], "mm"),
        "y": (slopes.points_mm[name][..., 1], "mm"),
        "height": (surface.height_mm[name], "mm"),
        "height_error": (surface.error_um[name], "um"),
        "slope_x": (slopes.slope_x_mrad[name], "mrad"),
        "slope_y": (slopes.slope_y_mrad[name], "mrad"),
        "slope_error_x": (slopes.error_x_mrad[name], "mrad"),
        "slope_error_y": (slopes.error_y_mrad[name], "mrad"),
        "curvature": (slopes.curvature_per_m[name], "1/m"),
    }
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for key, (values, unit) in maps.items():
            place = file.create_dataset(
                f"maps/{key}", data=values, compression="gzip", shuffle=True
            )
            place.attrs["unit"] = unit
        file["mirror_from_camera/R"] = slopes.mirror_from_camera.R
        file["mirror_from_camera/t_mm"] = slopes.mirror_from_camera.t_mm
        file["surface/coefficients_m"] = coefficients_m(slopes)
        file["surface/zernike_rms_um"] = [row.rms_um for row in surface.zernike]
        file["surface/zernike_nm"] = [[row.n, row.m] for row in surface.zernike]
        file.attrs["frame"] = (
            "x right and y up as seen from the mirror's front, z towards the viewer"
        )
    return buffer.getvalue()


def summary_json(phase: ScreenPhase, slopes: Slopes | None, surface: Surface | None) -> bytes:
    """Write the figures of the measurement; what isn't known is null."""
    document: dict[str, Any] = {
        "valid_share": phase.valid_share,
        "reading": phase.reading,
        "ramp_belongs": phase.ramp_belongs,
        "ramp_error_percent": phase.ramp_error_percent,
        "gray_error_percent": phase.gray_error_percent,
        "bad_frames": bad_frames(phase),
        "left_out": list(phase.left_out),
        "ripple_mrad": {
            axis: {f"{row.periods:g}": row.ripple_mrad for row in phase.sets if row.axis == axis}
            for axis in ("x", "y")
        },
        "closure": {
            axis: {f"{row.periods:g}": row.closure for row in phase.sets if row.axis == axis}
            for axis in ("x", "y")
        },
        "phase_noise_mrad": phase.median_sigma_mrad,
    }
    if slopes is not None:
        document |= {
            "focal_lengths_m": [slopes.focal_x_m, slopes.focal_y_m],
            "rms_slopes_mrad": [slopes.rms_x_mrad, slopes.rms_y_mrad],
            "slope_error_rms_mrad": slopes.error_rms_mrad,
            "surf_coefs": coefficients_m(slopes).tolist(),
            "pose_from": slopes.pose_from,
            "tilt_mrad": slopes.tilt_mrad,
        }
    if surface is not None:
        document |= {
            "height_error_rms_um": surface.error_rms_um,
            "height_error_span_um": surface.error_span_um,
            "zernike_rms_um": {
                f"{row.number} {row.name}".strip(): row.rms_um for row in surface.zernike
            },
        }
    return json.dumps(_finite(document), indent=1).encode()


def modulation_png(phase: ScreenPhase) -> bytes:
    """Draw the modulation of the finest fringes, black for none."""
    values = next(iter(phase.modulation_gray.values()))
    return _png(values, 0.0, float(np.percentile(values, 99.0)))


def defects_png(phase: ScreenPhase) -> bytes:
    """Draw what differs from its surroundings: dark where the mirror scatters light, gray where it doesn't."""
    return _png(next(iter(phase.defects.values())), -DEFECT_RANGE, DEFECT_RANGE)


def _png(values: Float32[np.ndarray, "h w"], low: float, high: float) -> bytes:
    share = np.nan_to_num((values - low) / max(high - low, 1e-9), nan=0.0)
    picture = np.rint(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    return bytes(cv2.imencode(".png", picture)[1])


def bad_frames(phase: ScreenPhase) -> list[int]:
    """Return the numbers of the frames found defective, ascending."""
    return sorted(f.number for f in phase.findings if f.number is not None)


def slope_rows(slopes: Slopes) -> Float64[np.ndarray, "2 n"]:
    """Return dz/dx and dz/dy of the mirror's pixels, row by row."""
    mirror = slopes.mirror[slopes.camera]
    maps = (slopes.slope_x_mrad[slopes.camera], slopes.slope_y_mrad[slopes.camera])
    return np.stack([1e-3 * m[mirror].astype(np.float64) for m in maps])


def coefficients_m(slopes: Slopes) -> Float[np.ndarray, "terms"]:
    """Return the surface's coefficients for x, y and z in metres; those of order 2 if there are more."""
    scale = np.array([_M, 1.0, 1 / _M, 1.0, 1 / _M, 1 / _M])
    return np.asarray(scale * second_order(slopes.coefficients))


def _camera(phase: ScreenPhase, slopes: Slopes | None) -> str:
    return slopes.camera if slopes is not None else next(iter(phase.mirror))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(v) for name, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
