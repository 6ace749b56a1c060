"""Scenes: names, parts, materials, mesh files; and what of them can be seen."""

import importlib
import json
import os
from typing import Any

import numpy as np
import pytest

from backend.devices.errors import RigConfigError
from backend.devices.sim import SCENES, create_rig
from backend.devices.sim.materials import Material
from backend.devices.sim.meshfile import scene_from_file
from backend.devices.sim.scenes import scene
from backend.devices.sim.shapes import Mesh, box, cylinder, face_normals, plate, sphere

SMALL = {"size": "160x120", "projector_size": "160x100"}


def volume_mm3(mesh: Mesh) -> float:
    """Signed volume by the divergence theorem: positive if every triangle faces outward."""
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (box(10, 20, 30), 6000.0),
        (cylinder(10, 20), np.pi * 100 * 20),
        (sphere(10), 4 / 3 * np.pi * 1000),
        (plate(100, 50, 4, [(-20, 0, 10), (20, 5, 8)]), 4 * (5000 - np.pi * (100 + 64))),
    ],
    ids=["box", "cylinder", "sphere", "plate with holes"],
)
def test_solids_are_closed_and_face_outward(mesh, volume):
    assert volume_mm3(mesh) == pytest.approx(volume, rel=2e-3)
    flat = face_normals(mesh.vertices_mm, mesh.triangles)
    assert np.einsum("tk,tck->tc", flat, mesh.corner_normals.astype(float)).min() > -1e-6


def test_moving_a_mesh_keeps_its_volume():
    moved = box(10, 20, 30, chamfer=2).moved(5, -3, 100, turn_deg=(20, -30, 70))
    assert volume_mm3(moved) == pytest.approx(volume_mm3(box(10, 20, 30, chamfer=2)), rel=1e-9)
    np.testing.assert_allclose(np.linalg.norm(moved.corner_normals, axis=-1), 1.0, atol=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_is_lit_and_seen_part_by_part(name):
    with create_rig({"scene": name, **SMALL}) as rig:
        truth = rig.truth("left")
        assert truth.lit_and_seen.mean() > 0.05
        for index, part in enumerate(truth.part_names):
            assert (truth.part[truth.base] == index).sum() > 100, part
        assert truth.part.min() >= -1
        np.testing.assert_array_equal(truth.part >= 0, np.isfinite(truth.points_mm[..., 2]))


def test_spraying_changes_light_and_no_point():
    plain, white = (create_rig({"scene": name, **SMALL}) for name in ("metal", "sprayed:metal"))
    a, b = plain.truth("left"), white.truth("left")
    np.testing.assert_array_equal(a.points_mm, b.points_mm)
    np.testing.assert_array_equal(a.lit_and_seen, b.lit_and_seen)
    assert {part.material.albedo for part in scene("sprayed:metal").parts} == {0.85}
    assert all(part.material.mirror == 0 for part in scene("sprayed:metal").parts)


def test_high_contrast_has_the_albedos_of_the_specification():
    assert [part.material.albedo for part in scene("high-contrast").parts] == [0.85, 0.36, 0.05]


def test_a_surface_cannot_reflect_more_than_it_gets():
    with pytest.raises(ValueError, match="can't reflect more than 1"):
        Material(albedo=0.8, mirror=0.3)


TETRAHEDRON = """o base
v 0 0 0
v 10 0 0
v 0 10 0
v 0 0 10
f 1 3 2
f 1 2 4
o top
f 1 4 3
f 2 3 4
"""


@pytest.fixture
def mesh_file(tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(TETRAHEDRON)
    return path


def test_a_mesh_file_is_placed_and_painted_by_its_table(mesh_file, tmp_path):
    table = tmp_path / "table.json"
    document = {
        "unit_mm": 2.0,
        "move_mm": [0, 0, 5],
        "materials": {"*": {"albedo": 0.3}, "top": {"albedo": 0.1, "mirror": 0.5}},
    }
    table.write_text(json.dumps(document))
    found = scene_from_file(mesh_file, table)
    assert {part.name: part.material.albedo for part in found.parts} == {"base": 0.3, "top": 0.1}
    corners = np.concatenate([part.mesh.vertices_mm for part in found.parts])
    np.testing.assert_allclose(np.ptp(corners, axis=0), 20.0)
    np.testing.assert_allclose((corners.min(0) + corners.max(0)) / 2, [0, 0, 5], atol=1e-6)


def test_a_mesh_file_becomes_a_scene_by_name(mesh_file):
    assert len(scene(f"sprayed:mesh:{mesh_file}").parts) == 2


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("{", "is no JSON"),
        ('{"materials": {"base": {"albedo": 0.3}}}', "no entry for 'top'"),
        ('{"materials": {"*": {"albedo": 2}}}', r"materials\.\*\.albedo"),
        ('{"colour": 1}', "colour"),
        (None, "can't be read"),
    ],
)
def test_a_bad_table_is_refused_in_one_sentence(mesh_file, tmp_path, table, sentence):
    path = tmp_path / "table.json"
    if table is not None:
        path.write_text(table)
    with pytest.raises(RigConfigError, match=sentence) as caught:
        scene_from_file(mesh_file, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("part.stl", None, "isn't there"),
        ("part.stl", "no mesh at all", "no triangles"),
        ("part.obj", "no mesh at all", "no triangles"),
        ("part.obj", "v 0 0 x", "no OBJ"),
        ("part.obj", "v 0 0 0\nf 1 2 3", "vertices that it doesn't have"),
    ],
)
def test_a_bad_mesh_file_is_refused(tmp_path, name, content, sentence):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    with pytest.raises(RigConfigError, match=sentence):
        scene_from_file(path)


def test_ply_and_stl_hold_one_mesh(tmp_path, mesh_file):
    open3d: Any = importlib.import_module("open3d")  # its type stubs are wrong

    mesh = open3d.io.read_triangle_mesh(str(mesh_file))
    mesh.compute_triangle_normals()
    for name in ("part.ply", "part.stl"):
        open3d.io.write_triangle_mesh(str(tmp_path / name), mesh)
        (part,) = scene_from_file(tmp_path / name).parts
        assert volume_mm3(part.mesh) == pytest.approx(1000 / 6, rel=1e-5)


def test_an_edited_mesh_file_is_read_again(mesh_file):
    options = {"scene": f"mesh:{mesh_file}", **SMALL, "cameras": 1}
    before = create_rig(options).truth("left").part.max()
    mesh_file.write_text(TETRAHEDRON.replace("o top\n", ""))
    os.utime(mesh_file, ns=(1, 1))
    assert (before, create_rig(options).truth("left").part.max()) == (1, 0)
