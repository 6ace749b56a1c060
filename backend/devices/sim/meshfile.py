"""Scenes from mesh files (STL, OBJ, PLY, OFF, glTF) with a material table.

A table is a JSON file, or a YAML file where PyYAML is installed::

    {"unit_mm": 1.0,
     "turn_deg": [0, 0, 0], "move_mm": [0, 0, 0], "centre": true,
     "materials": {"*": {"albedo": 0.3}, "rim": {"albedo": 0.1, "specular": 0.2, "roughness": 0.2}}}

Lengths in the file times `unit_mm` are mm. With `centre` the middle of the bounding box is put where the
devices look; then the mesh is turned about x, y, z and moved. `materials` goes by the names of the objects
in the file (in an OBJ file of materials, groups or objects, whichever was named last); `*` is for all others.
"""

import importlib
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from backend.devices.errors import RigConfigError
from backend.devices.sim.materials import Material
from backend.devices.sim.scene import Part, Scene
from backend.devices.sim.shapes import Mesh, flat, smooth


class MaterialTable(BaseModel):
    """How a mesh file is placed and what it is made of."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    unit_mm: float = Field(1.0, gt=0)
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    move_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    centre: bool = True
    smooth: bool = False
    """Whether normals are interpolated over the facets."""
    materials: dict[str, Material] = Field(default_factory=lambda: {"*": Material(albedo=0.5)})

    def of(self, name: str) -> Material | None:
        """Return the material of an object of the file, None if the table has none."""
        return self.materials.get(name, self.materials.get("*"))


def scene_from_file(path: Path, table_path: Path | None = None) -> Scene:
    """Read a mesh file as a scene.

    Raises
    ------
    RigConfigError
        If the file or the table is missing or can't be used; one sentence says why.
    """
    table = MaterialTable() if table_path is None else read_table(table_path)
    objects = _read_objects(path)
    middle = np.zeros(3)
    if table.centre:
        corners = np.concatenate([vertices for _, vertices, _ in objects]) * table.unit_mm
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return Scene(
        f"mesh:{path}", tuple(_part(name, v, t, table, middle, path) for name, v, t in objects)
    )


def read_table(path: Path) -> MaterialTable:
    """Read and check a material table."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RigConfigError(
            f"material table {path} can't be read ({error}); give a JSON file"
        ) from None
    try:
        return MaterialTable.model_validate(_parsed(text, path))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the table"
        raise RigConfigError(f"material table {path}: {place}: {first['msg']}") from None


def _parsed(text: str, path: Path) -> Any:
    if path.suffix.lower() in (".yaml", ".yml"):
        try:
            import yaml
        except ImportError:
            raise RigConfigError(
                f"material table {path}: PyYAML isn't installed; install it or write the table as JSON"
            ) from None
        try:
            return yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise RigConfigError(f"material table {path} is no YAML: {error}") from None
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise RigConfigError(f"material table {path} is no JSON: {error}") from None


_Object = tuple[
    str,
    np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    np.ndarray[tuple[int, ...], np.dtype[np.int32]],
]


def _read_objects(path: Path) -> list[_Object]:
    if not path.is_file():
        raise RigConfigError(f"mesh file {path} isn't there; check the path after mesh:")
    objects = _read_obj(path) if path.suffix.lower() == ".obj" else _read_other(path)
    objects = [
        (name, vertices, triangles) for name, vertices, triangles in objects if len(triangles)
    ]
    if not objects:
        raise RigConfigError(
            f"mesh file {path} holds no triangles that could be read; export it as STL, OBJ or PLY"
        )
    return objects


def _read_obj(path: Path) -> list[_Object]:
    """Read an OBJ file ourselves: the general reader merges objects that have no material file."""
    vertices: list[list[float]] = []
    faces: dict[str, list[tuple[int, int, int]]] = {}
    name = "mesh"
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            word, *rest = line.split() or [""]
            if word == "v":
                vertices.append([float(value) for value in rest[:3]])
            elif word in ("o", "g", "usemtl"):
                name = " ".join(rest) or name
            elif word == "f":
                corners = [_corner(item, len(vertices)) for item in rest]
                fan = pairwise(corners[1:])
                faces.setdefault(name, []).extend((corners[0], b, c) for b, c in fan)
        points = np.array(vertices, np.float64).reshape(-1, 3)
        objects: list[_Object] = [
            (key, points, np.array(f, np.int32).reshape(-1, 3)) for key, f in faces.items()
        ]
    except (ValueError, OSError) as error:
        raise RigConfigError(
            f"mesh file {path} is no OBJ file ({error}); export it again"
        ) from None
    if any(len(f) and not 0 <= f.min() <= f.max() < len(points) for _, _, f in objects):
        raise RigConfigError(
            f"mesh file {path} names vertices that it doesn't have; export it again"
        )
    return objects


def _corner(item: str, count: int) -> int:
    """Return the vertex of a face's corner such as 7/2/3; negative numbers count from the end."""
    index = int(item.split("/")[0])
    return index - 1 if index > 0 else count + index


def _read_other(path: Path) -> list[_Object]:
    o3d: Any = importlib.import_module("open3d")  # slow, and its type stubs are wrong
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        model = o3d.io.read_triangle_model(str(path))
        pairs = [(info.mesh_name, info.mesh) for info in model.meshes]
        if not pairs:  # formats that only the plain reader knows, e.g. PLY
            pairs = [("mesh", o3d.io.read_triangle_mesh(str(path)))]
    return [
        (
            name or f"object-{index + 1}",
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.triangles, np.int32),
        )
        for index, (name, mesh) in enumerate(pairs)
    ]


def _part(
    name: str,
    vertices: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    triangles: np.ndarray[tuple[int, ...], np.dtype[np.int32]],
    table: MaterialTable,
    middle_mm: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    path: Path,
) -> Part:
    material = table.of(name)
    if material is None:
        raise RigConfigError(
            f"material table has no entry for {name!r} of {path}; add it, or '*' for all others"
        )
    points_mm = vertices * table.unit_mm - middle_mm
    mesh: Mesh = (smooth if table.smooth else flat)(points_mm, triangles)
    return Part(name, mesh.moved(*table.move_mm, turn_deg=table.turn_deg), material)
