"""Measurements of SOFAST (OpenCSP): its HDF5 files, or the same arrays in one `.npz`, as one set of names."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from backend.domain.errors import InvalidCaptureError

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

STEPS = 4
"""SOFAST shifts every fringe four times."""

SUFFIXES = (".npz", ".h5", ".hdf5")

_HDF5_NAMES = {
    "MeasurementSofastFringe/fringe_images": "fringe_images",
    "MeasurementSofastFringe/mask_images": "mask_images",
    "MeasurementSofastFringe/fringe_periods_x": "fringe_periods_x",
    "MeasurementSofastFringe/fringe_periods_y": "fringe_periods_y",
    "MeasurementSofastFringe/dist_optic_screen": "dist_optic_screen",
    "MeasurementSofastFringe/optic_screen_dist": "dist_optic_screen",
    "MeasurementSofastFringe/v_measure_point_facet": "v_measure_point_facet",
    "MeasurementSofastFringe/measure_point": "v_measure_point_facet",
    "MeasurementSofastFringe/name": "name",
    "MeasurementSofastFringe/date": "date",
    "Camera/intrinsic_mat": "camera_matrix",
    "Camera/distortion_coef": "distortion",
    "Camera/image_shape_xy": "image_shape_xy",
    "DisplayShape/screen_model": "screen_model",
    "DisplayShape/screen_x": "screen_x",
    "DisplayShape/screen_y": "screen_y",
    "DisplayShape/xy_screen_fraction": "display_fraction_xy",
    "DisplayShape/xy_screen_coords": "display_xy_m",
    "DisplayShape/xyz_screen_coords": "display_xyz_m",
    "SpatialOrientation/r_cam_screen": "r_cam_screen",
    "SpatialOrientation/v_cam_screen_cam": "v_cam_screen_cam",
    "SpatialOrientation/r_cam_optic": "pose_r_cam_optic",
    "SpatialOrientation/v_cam_optic_cam": "pose_v_cam_optic_cam",
    "ImageCalibrationScaling/camera_values": "ramp_camera",
    "ImageCalibrationScaling/display_values": "ramp_display",
    "ImageCalibrationGlobal/camera_values": "ramp_camera",
    "ImageCalibrationGlobal/display_values": "ramp_display",
}
_PICTURES_LAST = ("fringe_images", "mask_images")
"""HDF5 files have the pictures along the last axis."""


@dataclass(frozen=True)
class SofastFile:
    """One measurement; lengths in metres, in the frames of SOFAST."""

    path: Path
    name: str
    date: str
    fringes: UInt8[np.ndarray, "n h w"] | UInt16[np.ndarray, "n h w"]
    """Along y first: period count by period count, four steps each; then along x."""
    fields: UInt8[np.ndarray, "2 h w"] | UInt16[np.ndarray, "2 h w"]
    """Dark and light screen."""
    periods_x: tuple[float, ...]
    periods_y: tuple[float, ...]
    distance_m: float | None
    """From the measure point of the mirror to the origin of the screen."""
    measured_m: Float[np.ndarray, "3"]
    camera_matrix: Float[np.ndarray, "3 3"] | None
    distortion: Float[np.ndarray, "_k"]
    screen_fraction: Float[np.ndarray, "_n 2"] | None
    """x: 1 at the first display column, 0 at the last; y: 1 at the first row."""
    screen_m: Float[np.ndarray, "_n 3"] | None
    camera_to_screen: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None
    """Rotation vector camera -> screen, and the screen's origin in the camera's frame."""
    camera_to_mirror: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None
    """Rotation vector camera -> mirror, and the mirror's origin in the camera's frame."""
    corners_m: Float[np.ndarray, "_m 3"] | None
    mask: Bool[np.ndarray, "h w"] | None
    ramp_camera: Float[np.ndarray, "_r"] | None
    ramp_display: Float[np.ndarray, "_r"] | None


def looks_like_sofast(path: Path) -> bool:
    """Tell whether a file, or what is in a folder, is of that kind by its name."""
    if path.is_dir():
        return not (path / "capture.json").is_file() and bool(_parts(path))
    return path.suffix.lower() in SUFFIXES


def read_sofast(path: Path) -> SofastFile:
    """Read a measurement: an `.npz`, an HDF5 file, or a folder with several of them (or with the `.npy` of an `.npz`).

    Raises
    ------
    InvalidCaptureError
        In one sentence: a file that can't be read, a key that is missing, pictures that are too few, numbers that
        aren't finite.
    """
    if not path.exists():
        raise InvalidCaptureError(f"There is no file {path}: name a SOFAST measurement.")
    found: dict[str, Array] = {}
    for part in _parts(path) if path.is_dir() else [path]:
        found |= _read(part)
    if "fringe_images" not in found:
        raise InvalidCaptureError(
            f"{path} lacks fringe_images (MeasurementSofastFringe/fringe_images in HDF5): it is no SOFAST measurement, "
            f"it holds {', '.join(sorted(found)[:6]) or 'nothing known'}."
        )
    return _assembled(path, _Keys(path, found))


def _parts(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    if not files and (folder / "fringe_images.npy").is_file():
        files = sorted(folder.glob("*.npy"))
    return files


def _read(path: Path) -> dict[str, Array]:
    readers: Mapping[str, Callable[[Path], dict[str, Array]]] = {
        ".npz": _read_npz,
        ".npy": _read_npy,
    }
    try:
        return readers.get(path.suffix.lower(), _read_hdf5)(path)
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise InvalidCaptureError(
            f"{path} can't be read as a SOFAST measurement: {error}."
        ) from None


def _read_npz(path: Path) -> dict[str, Array]:
    from zipfile import BadZipFile

    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except BadZipFile as error:
        raise ValueError(f"it is no .npz archive ({error})") from None


def _read_npy(path: Path) -> dict[str, Array]:
    return {path.stem: np.load(path, allow_pickle=False)}


def _read_hdf5(path: Path) -> dict[str, Array]:
    # h5py costs 0.1 s to import: only those who read such a file pay.
    import h5py

    found: dict[str, Array] = {}
    with h5py.File(path, "r") as file:
        for place, name in _HDF5_NAMES.items():
            if place in file:
                value = np.asarray(file[place][()])
                found[name] = _plain(value, name)
    return found


def _plain(value: Array, name: str) -> Array:
    if name in _PICTURES_LAST and value.ndim == 3:
        return np.ascontiguousarray(np.moveaxis(value, -1, 0))
    if value.dtype.kind in "OS":
        text = value.item()
        return np.array(text.decode() if isinstance(text, bytes) else str(text))
    return value


class _Keys:
    """The arrays of a measurement, checked when taken."""

    def __init__(self, path: Path, found: Mapping[str, Array]) -> None:
        self._path = path
        self._found = found

    def __contains__(self, name: str) -> bool:
        return name in self._found

    def optional(self, name: str) -> Array | None:
        """Return an array as it is; None if there is none."""
        return self._found.get(name)

    def text(self, name: str, default: str = "") -> str:
        """Return a text."""
        return str(self._found[name]) if name in self._found else default

    def numbers(self, name: str, count: int | None = None) -> Float[np.ndarray, "n"]:
        """Return finite numbers in one row."""
        values = np.asarray(self._required(name), np.float64).ravel()
        self._refuse_infinite(name, values)
        if count is not None and values.size != count:
            raise InvalidCaptureError(
                f"{self._path}: {name} holds {values.size} numbers where {count} are needed."
            )
        return values

    def points(self, name: str, size: int) -> Float[np.ndarray, "n size"]:
        """Return points that the file has one per column; those that aren't finite are refused."""
        values = np.asarray(self._required(name), np.float64)
        if values.ndim != 2 or values.shape[0] != size:
            raise InvalidCaptureError(
                f"{self._path}: {name} has shape {values.shape} where {size} x n is needed."
            )
        self._refuse_infinite(name, values)
        return np.ascontiguousarray(values.T)

    def pictures(self, name: str) -> UInt8[np.ndarray, "n h w"] | UInt16[np.ndarray, "n h w"]:
        """Return pictures of 8 or 16 bit."""
        values = self._required(name)
        if values.ndim != 3 or values.dtype not in (np.uint8, np.uint16):
            raise InvalidCaptureError(
                f"{self._path}: {name} is {values.dtype} of shape {values.shape}; pictures of uint8 or uint16 are needed."
            )
        return np.ascontiguousarray(values)

    def _required(self, name: str) -> Array:
        if name not in self._found:
            raise InvalidCaptureError(
                f"{self._path} lacks {name}: export the measurement with all its parts."
            )
        return self._found[name]

    def _refuse_infinite(self, name: str, values: Float[np.ndarray, "..."]) -> None:
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise InvalidCaptureError(
                f"{self._path}: {name} holds {bad} of {values.size} numbers that aren't finite: measure them again or "
                "take them out."
            )


def _assembled(path: Path, keys: _Keys) -> SofastFile:
    fringes, fields = keys.pictures("fringe_images"), keys.pictures("mask_images")
    periods_x = tuple(float(p) for p in keys.numbers("fringe_periods_x"))
    periods_y = tuple(float(p) for p in keys.numbers("fringe_periods_y"))
    _check_pictures(path, fringes, fields, len(periods_x), len(periods_y))
    fraction, screen_m = _screen(keys)
    mask = keys.optional("mask_processed")
    if mask is not None and mask.shape != fringes.shape[1:]:
        raise InvalidCaptureError(
            f"{path}: mask_processed has shape {mask.shape} but the pictures {fringes.shape[1:]}."
        )
    has_ramp = "ramp_camera" in keys and "ramp_display" in keys
    has_camera = "camera_matrix" in keys
    return SofastFile(
        path=path,
        name=keys.text("name", path.stem),
        date=keys.text("date"),
        fringes=fringes,
        fields=fields,
        periods_x=periods_x,
        periods_y=periods_y,
        distance_m=float(keys.numbers("dist_optic_screen", 1)[0])
        if "dist_optic_screen" in keys
        else None,
        measured_m=keys.numbers("v_measure_point_facet", 3)
        if "v_measure_point_facet" in keys
        else np.zeros(3),
        camera_matrix=keys.numbers("camera_matrix", 9).reshape(3, 3) if has_camera else None,
        distortion=keys.numbers("distortion") if "distortion" in keys else np.zeros(5),
        screen_fraction=fraction,
        screen_m=screen_m,
        camera_to_screen=_pose(keys, "r_cam_screen", "v_cam_screen_cam"),
        camera_to_mirror=_pose(keys, "pose_r_cam_optic", "pose_v_cam_optic_cam"),
        corners_m=keys.points("facet_corners_m", 3) if "facet_corners_m" in keys else None,
        mask=None if mask is None else mask.astype(bool),
        ramp_camera=keys.numbers("ramp_camera") if has_ramp else None,
        ramp_display=keys.numbers("ramp_display") if has_ramp else None,
    )


def _pose(
    keys: _Keys, turn: str, shift: str
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    if turn not in keys or shift not in keys:
        return None
    return keys.numbers(turn, 3), keys.numbers(shift, 3)


def _check_pictures(path: Path, fringes: Array, fields: Array, n_x: int, n_y: int) -> None:
    needed = STEPS * (n_x + n_y)
    if len(fringes) != needed:
        missing = "are missing" if len(fringes) < needed else "are too many"
        raise InvalidCaptureError(
            f"{path} holds {len(fringes)} fringe frames, but {n_y} period counts along y and {n_x} along x in "
            f"{STEPS} steps are {needed}: {abs(needed - len(fringes))} {missing}."
        )
    if len(fields) != 2 or fields.shape[1:] != fringes.shape[1:] or fields.dtype != fringes.dtype:
        raise InvalidCaptureError(
            f"{path}: mask_images is {fields.dtype} of shape {fields.shape}; a dark and a light picture like the fringe "
            f"frames ({fringes.dtype}, {fringes.shape[2]}x{fringes.shape[1]} px) are needed."
        )


def _screen(
    keys: _Keys,
) -> tuple[Float[np.ndarray, "n 2"] | None, Float[np.ndarray, "n 3"] | None]:
    """Return fractions and points of the best screen model at hand: measured in 3-D, in 2-D, or a rectangle."""
    for fraction, points in _screens(keys):
        if len(fraction) == len(points):
            return fraction, points
    return None, None


def _screens(
    keys: _Keys,
) -> Iterator[tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 3"]]]:
    if "display_xyz_m" in keys:
        yield keys.points("display_fraction_xy", 2), keys.points("display_xyz_m", 3)
    if "display_xy_m" in keys:
        flat = keys.points("display_xy_m", 2)
        yield (
            keys.points("display_fraction_xy", 2),
            np.column_stack([flat, np.zeros(len(flat))]),
        )
    if "display_rect_size_m" in keys or "screen_x" in keys:
        width, height = (
            keys.numbers("display_rect_size_m", 2)
            if "display_rect_size_m" in keys
            else (keys.numbers("screen_x", 1)[0], keys.numbers("screen_y", 1)[0])
        )
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        points = np.column_stack([(corners - 0.5) * [width, height], np.zeros(4)])
        yield corners, points
