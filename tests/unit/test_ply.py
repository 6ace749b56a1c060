"""PLY files: what is written is read back, by our own reader and by Open3D."""

import cv2  # noqa: F401  before open3d: both bring an OpenMP runtime
import numpy as np
import open3d as o3d
import pytest

from backend.domain.errors import InvalidCaptureError
from backend.services.ply import VERTEX, ply_parts, read_ply, write_ply
from backend.stages.cloud import Cloud


def make_cloud(count: int) -> Cloud:
    rng = np.random.default_rng(count)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(
        points_mm=rng.uniform(-300, 900, (count, 3)).astype(np.float32),
        normals=normals.astype(np.float32),
        colour=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        sigma_mm=rng.uniform(0, 1, count).astype(np.float32),
        pixel_x=np.arange(count, dtype=np.float32) % 640,
        pixel_y=np.arange(count, dtype=np.float32) // 640,
        exposure_index=rng.integers(0, 4, count, dtype=np.uint8),
        depth_mm={},
        reasons={},
        removed=(),
        point_count=count,
        median_sigma_mm=0.5,
        kept_share=1.0,
    )


@pytest.fixture
def written(tmp_path):
    cloud, path = make_cloud(200_001), tmp_path / "cloud.ply"
    with path.open("wb") as file:
        write_ply(file, cloud)
    return cloud, path


def test_our_reader_gets_back_every_bit(written):
    cloud, path = written
    found = read_ply(path)
    assert tuple(found) == VERTEX.names
    np.testing.assert_array_equal(np.column_stack([found[n] for n in "xyz"]), cloud.points_mm)
    np.testing.assert_array_equal(
        np.column_stack([found[n] for n in ("nx", "ny", "nz")]), cloud.normals
    )
    np.testing.assert_array_equal(
        np.column_stack([found[n] for n in ("red", "green", "blue")]), cloud.colour
    )
    for name in ("sigma_mm", "pixel_x", "pixel_y", "exposure_index"):
        np.testing.assert_array_equal(found[name], getattr(cloud, name))


def test_open3d_reads_points_normals_and_colours(written):
    cloud, path = written
    found = o3d.io.read_point_cloud(path)
    np.testing.assert_array_equal(np.asarray(found.points), cloud.points_mm)
    np.testing.assert_allclose(np.asarray(found.normals), cloud.normals, atol=1e-7)
    np.testing.assert_allclose(np.asarray(found.colors) * 255, cloud.colour, atol=1e-6)


def test_open3d_reads_the_scalars_too(written):
    cloud, path = written
    found = o3d.t.io.read_point_cloud(path).point
    for name in ("sigma_mm", "pixel_x", "pixel_y", "exposure_index"):
        np.testing.assert_array_equal(found[name].numpy().ravel(), getattr(cloud, name))


def test_an_empty_cloud_is_a_file_too(tmp_path):
    path = tmp_path / "empty.ply"
    path.write_bytes(b"".join(ply_parts(make_cloud(0))))
    assert all(len(column) == 0 for column in read_ply(path).values())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-1], "truncated"),
        (lambda data: b"solid cube", "isn't a binary"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "isn't a binary"),
        (lambda data: data.replace(b"element vertex", b"element strips"), "isn't a binary"),
        (
            lambda data: data.replace(b"property float x", b"property list uchar int x"),
            "isn't a binary",
        ),
    ],
)
def test_what_cannot_be_read_is_refused(written, change, words):
    _, path = written
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InvalidCaptureError, match=words):
        read_ply(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InvalidCaptureError, match="can't be read"):
        read_ply(tmp_path / "none.ply")
