"""PLY files of point clouds: binary, little endian, one vertex per point with everything known of it."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from backend.domain.errors import InvalidCaptureError
from backend.stages.cloud import Cloud

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("sigma_mm", "<f4"), ("pixel_x", "<f4"), ("pixel_y", "<f4"),
        ("exposure_index", "u1"),
    ]
)  # fmt: skip
"""One point: x y z in mm in the reference camera's frame (x right, y down, z forward)."""

_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i4": "int"}
_TYPES = {name: kind for kind, name in _NAMES.items()}
_CHUNK = 1 << 16
"""Points converted at a time: 2.6 MB, which stay in the cache between the columns."""
_COMMENTS = (
    "unglare point cloud",
    "x y z in mm in the frame of the reference camera: x right, y down, z forward",
    "sigma_mm: predicted standard deviation along the ray of pixel_x, pixel_y of that camera",
    "exposure_index: 0 = shortest exposure, 255 = not known",
)


def write_ply(file: BinaryIO, cloud: Cloud) -> None:
    """Write a cloud; OSError passes."""
    for part in ply_parts(cloud):
        file.write(part)


def ply_parts(cloud: Cloud) -> Iterator[bytes | memoryview]:
    """Return a cloud's file in pieces, so that three million points need no second copy in memory."""
    yield _header(len(cloud.points_mm))
    columns = _columns(cloud)
    for start in range(0, len(cloud.points_mm), _CHUNK):
        count = min(_CHUNK, len(cloud.points_mm) - start)
        vertices = np.empty(count, VERTEX)
        for name, column in columns.items():
            vertices[name] = column[start : start + count]
        yield vertices.view(np.uint8).data


def _columns(cloud: Cloud) -> dict[str, Array]:
    triples = {"xyz": cloud.points_mm, "n": cloud.normals, "rgb": cloud.colour}
    names = {"xyz": ("x", "y", "z"), "n": ("nx", "ny", "nz"), "rgb": ("red", "green", "blue")}
    columns = {
        name: triples[key][:, index] for key in triples for index, name in enumerate(names[key])
    }
    scalars = ("sigma_mm", "pixel_x", "pixel_y", "exposure_index")
    return columns | {name: getattr(cloud, name) for name in scalars}


def _header(count: int) -> bytes:
    properties = [f"property {_NAMES[VERTEX[name].str[1:]]} {name}" for name in VERTEX.names or ()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in _COMMENTS),
        f"element vertex {count}",
        *properties,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def read_ply(path: Path) -> Mapping[str, Array]:
    """Read the vertices of a binary little-endian PLY file, one array per property.

    Raises
    ------
    InvalidCaptureError
        If the file isn't there, is of another kind (ASCII, lists, other elements before the vertices), or
        is shorter than its header says.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidCaptureError(f"{path} can't be read: {error.strerror}.") from None
    head, mark, body = data.partition(b"end_header\n")
    try:
        count, dtype = _parsed(head.decode("ascii").splitlines())
    except (UnicodeDecodeError, ValueError, KeyError):
        mark = b""
    if not mark:
        raise InvalidCaptureError(
            f"{path} isn't a binary little-endian PLY file that starts with vertices of plain numbers."
        )
    if len(body) < count * dtype.itemsize:
        raise InvalidCaptureError(
            f"{path} is truncated: {len(body)} bytes where {count} points need {count * dtype.itemsize}."
        )
    vertices = np.frombuffer(body, dtype, count)
    return {name: vertices[name] for name in dtype.names or ()}


def _parsed(lines: list[str]) -> tuple[int, np.dtype[Any]]:
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ValueError("another kind of file")
    told = [line.split() for line in lines[2:] if not line.startswith(("comment", "obj_info"))]
    element, *others = told
    if element[:2] != ["element", "vertex"]:
        raise ValueError("vertices don't come first")
    fields = []
    for words in others:
        if words[0] != "property":
            break
        kind, name = words[1:]
        fields.append((name, "<" + _TYPES[_alias(kind)]))
    return int(element[2]), np.dtype(fields)


def _alias(kind: str) -> str:
    aliases = {"float32": "float", "float64": "double", "uint8": "uchar", "int32": "int"}
    return aliases.get(kind, kind)
