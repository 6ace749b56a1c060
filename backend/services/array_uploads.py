"""Arrays that an operator hands over: `.npy` files and pictures, read without trust, as artifacts."""

import io
import re
from enum import StrEnum
from typing import Any

import cv2
import numpy as np

from backend.contract.scans import ArtifactRef
from backend.domain.errors import InvalidSettingError
from backend.storage.artifacts import ArtifactStore

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

LARGEST_UPLOAD_BYTES = 128 * 2**20
"""Room for a mask of a projector of 8192 x 4096 pixels."""

_MOST_PIXELS = 2**25
_NPY = b"\x93NUMPY"
_PNG = b"\x89PNG\r\n\x1a\n"
_TOLERANCE = 1e-6


class UploadKind(StrEnum):
    """What an upload is meant as."""

    MASK = "mask"
    """h x w factors, stored as float32 in [0, 1]; a picture's full scale is 1, NaN is where nothing was painted."""
    ARRAY = "array"
    """Stored as it is: gray levels of a picture, any numbers of a `.npy` file."""


def store_upload(store: ArtifactStore, data: bytes, kind: UploadKind) -> ArtifactRef:
    """Read an uploaded file and keep it as an artifact.

    Parameters
    ----------
    store
        Where it goes.
    data
        The file: `.npy`, or a gray picture (PNG, TIFF, PGM ...) of 8 or 16 bit.
    kind
        What it is meant as.

    Raises
    ------
    InvalidSettingError
        If it can't be used; the sentence says what is wrong with it.
    """
    array = _read_npy(data) if data.startswith(_NPY) else _read_picture(data)
    meta = store.put(_as_mask(array) if kind is UploadKind.MASK else array)
    return ArtifactRef(hash=meta.hash, shape=meta.shape, dtype=meta.dtype)


def _read_npy(data: bytes) -> Array:
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError, MemoryError) as error:
        raise InvalidSettingError(
            f"The .npy file can't be read ({error}): save it again with numpy.save."
        ) from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise InvalidSettingError(
            f"The .npy file holds {getattr(array, 'dtype', 'no array')}: save numbers or booleans."
        )
    if array.dtype.itemsize > 8:
        raise InvalidSettingError(
            f"The .npy file holds {array.dtype}, which is too wide to be kept: save it as float64 or float32."
        )
    return array


def _read_picture(data: bytes) -> Array:
    _refuse_giant(data)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        picture = None
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        raise InvalidSettingError(
            f"The upload of {len(data)} bytes is neither a .npy file nor a picture of 8 or 16 bit: "
            "save it as PNG or with numpy.save."
        )
    if picture.ndim == 3:
        colours = picture[..., :3]
        if np.ptp(colours, axis=2).max(initial=0) > 0:
            raise InvalidSettingError(
                "The uploaded picture is in colour: save it in shades of gray."
            )
        picture = colours[..., 0]
    return np.ascontiguousarray(picture)


def _refuse_giant(data: bytes) -> None:
    """Refuse a small file that unpacks to gigabytes, where its header tells."""
    if not data.startswith(_PNG) or len(data) < 24:
        return
    width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    if width * height > _MOST_PIXELS:
        raise InvalidSettingError(
            f"The uploaded picture has {width} x {height} px; {_MOST_PIXELS} pixels are the most."
        )


def _as_mask(array: Array) -> Array:
    if array.ndim != 2 or array.size == 0:
        shape = " x ".join(map(str, array.shape)) or "a single number"
        raise InvalidSettingError(
            f"A mask has to be height x width, but the upload is {shape}: save one picture."
        )
    if array.dtype.kind == "u":
        return (array / np.float32(np.iinfo(array.dtype).max)).astype(np.float32)
    values = array.astype(np.float32)
    painted = values[~np.isnan(values)]
    low, high = float(painted.min(initial=1.0)), float(painted.max(initial=0.0))
    if low < -_TOLERANCE or high > 1 + _TOLERANCE:
        raise InvalidSettingError(
            f"A mask's factors have to be from 0 to 1, but the upload has {low:g} to {high:g}: "
            "scale it, or save whole numbers of 8 or 16 bit."
        )
    return np.clip(values, 0.0, 1.0)


def looks_like_hash(value: object) -> bool:
    """Tell an artifact's hash from the name of a file."""
    return isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value) is not None
