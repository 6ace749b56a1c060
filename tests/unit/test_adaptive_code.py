"""The decoding stages of adaptive-code on a plane whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from backend.domain.errors import InvalidCaptureError, StageFailedError
from backend.domain.frames import InMemory
from backend.domain.patterns import Gray
from backend.methods.adaptive_code import METHOD
from backend.numerics.camera_model import project
from backend.numerics.reasons import Reason
from backend.stages.code_cloud import CodeCloudParams, code_cloud
from backend.stages.code_frames import CodeFrames, import_code_frames
from backend.stages.edges import EdgesParams, edges
from tests.unit import procam


def silent(done, text=""):
    """Report to nobody."""


def decode(frames, **settings):
    return edges(import_code_frames(frames), None, procam.facts(), EdgesParams(**settings), silent)


def cloud_of(codes, calibration=None, **settings):
    rig = calibration or procam.calibration()
    return code_cloud(codes, rig, CodeCloudParams(**settings), silent)


@pytest.mark.parametrize(
    "frames",
    [procam.gray_frames(), procam.gray_frames(inverses=False) + procam.fields()],
    ids=["inverses", "white and black"],
)
def test_every_lit_pixel_gets_its_column_and_row(frames):
    codes = decode(frames)
    true_px = np.floor(procam.scene().projector_px + 0.5)
    valid = codes.reasons["main"] == 0
    assert valid.mean() > 0.5
    np.testing.assert_array_equal(codes.projector_px["main"][valid], true_px[valid][:, 0])
    np.testing.assert_array_equal(codes.projector_row_px["main"][valid], true_px[valid][:, 1])
    assert np.isnan(codes.projector_px["main"][~valid]).all()


def test_unlit_pixels_say_why():
    reasons = decode(procam.gray_frames()).reasons["main"]
    unlit = np.isnan(procam.scene().projector_px).any(axis=-1) | (reasons != 0)
    assert (reasons[unlit] & Reason.CODE_MARGIN).all()


def weaken(frames, bits):
    """Let the optics swallow the finest bits."""
    return tuple(
        replace(f, pixels=InMemory((f.gray // 16 + 60).astype(np.uint8)))
        if isinstance(f.pattern, Gray) and f.pattern.bit < bits
        else f
        for f in frames
    )


@pytest.mark.parametrize("bits", [0, 1, 2])
def test_bits_that_the_optics_do_not_resolve_are_found(bits):
    assert decode(weaken(procam.gray_frames(), bits)).weak_bits_used == bits


def test_weak_bits_are_read_all_the_same():
    strict = decode(weaken(procam.gray_frames(), 2), weak_bits=0, min_contrast_gray=20.0)
    lenient = decode(weaken(procam.gray_frames(), 2), min_contrast_gray=20.0)
    assert strict.valid_share == 0
    assert lenient.valid_share > 0.5
    valid = lenient.reasons["main"] == 0
    true_px = np.floor(procam.scene().projector_px[..., 0] + 0.5)
    np.testing.assert_array_equal(lenient.projector_px["main"][valid], true_px[valid])


def test_ignored_bits_make_wider_stripes():
    codes = decode(procam.gray_frames(), ignored_bits=2)
    found = codes.projector_px["main"]
    np.testing.assert_array_equal(np.unique(found[np.isfinite(found)] % 4), [1.5])


def test_more_bits_than_there_are_cannot_be_ignored():
    with pytest.raises(StageFailedError, match="7 bits, of which 7"):
        decode(procam.gray_frames(), ignored_bits=7)


def test_the_size_of_the_pattern_has_to_be_known():
    facts = replace(procam.facts(), projector=None)
    with pytest.raises(StageFailedError, match="add the projector"):
        edges(import_code_frames(procam.gray_frames()), None, facts, EdgesParams(), silent)


def depth_error_mm(cloud):
    x, y, z = cloud.points_mm.T
    return z - (600.0 + 0.3 * x - 0.1 * y)


def test_the_cloud_is_the_plane():
    cloud = cloud_of(decode(procam.gray_frames()))
    assert cloud.point_count > 5000
    error = depth_error_mm(cloud)
    assert abs(np.median(error)) < 0.2
    assert np.percentile(np.abs(error), 95) < 3 * cloud.median_sigma_mm
    plane_normal = np.array([0.3, -0.1, -1.0]) / np.linalg.norm([0.3, -0.1, -1.0])
    inner = np.linalg.norm(cloud.normals, axis=1) > 0.5
    assert np.median(cloud.normals[inner] @ plane_normal) > 0.99


def test_points_stand_on_the_rays_of_their_pixels_in_the_order_of_the_picture():
    cloud = cloud_of(decode(procam.gray_frames()))
    seen_px = project(cloud.points_mm, procam.devices()[0])
    np.testing.assert_allclose(seen_px, np.column_stack([cloud.pixel_x, cloud.pixel_y]), atol=0.01)
    assert (np.diff(np.round(cloud.pixel_y)) >= 0).all()


def test_each_projector_pixel_becomes_one_point():
    codes = decode(procam.gray_frames())
    valid = codes.reasons["main"] == 0
    pairs = np.column_stack(
        [codes.projector_px["main"][valid], codes.projector_row_px["main"][valid]]
    )
    cloud = cloud_of(codes)
    assert cloud.point_count <= len(np.unique(pairs, axis=0)) <= cloud.point_count * 1.05


def test_a_row_that_contradicts_the_column_is_rejected():
    codes = decode(procam.gray_frames())
    rows = codes.projector_row_px["main"].copy()
    rows[40:60, 60:90] += 10
    cloud = cloud_of(replace(codes, projector_row_px={"main": rows}))
    assert (cloud.reasons["main"][40:60, 60:90] == Reason.EPIPOLAR).all()
    assert np.isnan(cloud.depth_mm["main"][40:60, 60:90]).all()
    assert not np.isnan(cloud.depth_mm["main"][70:80, 60:90]).any()


def test_columns_alone_give_a_point_per_pixel():
    codes = decode(procam.gray_frames("x"))
    cloud = cloud_of(codes)
    valid = codes.reasons["main"] == 0
    assert cloud.point_count == np.count_nonzero(valid)
    np.testing.assert_array_equal(cloud.pixel_x, np.nonzero(valid)[1])
    assert abs(np.median(depth_error_mm(cloud))) < 0.5


def test_distance_limits_clip():
    codes = decode(procam.gray_frames())
    cloud = cloud_of(codes, far_mm=600.0)
    assert 0 < cloud.point_count < cloud_of(codes).point_count
    assert cloud.points_mm[:, 2].max() < 601
    assert (cloud.reasons["main"] == Reason.CLIPPED).any()


def test_points_need_a_calibrated_projector():
    rig = replace(procam.calibration(), projector=None, projector_from_world=None)
    with pytest.raises(StageFailedError, match="projector isn't calibrated"):
        cloud_of(decode(procam.gray_frames()), rig)


def test_points_need_columns():
    with pytest.raises(StageFailedError, match="no column code"):
        cloud_of(decode(procam.gray_frames("y")))


def _without(bit):
    return tuple(
        f for f in procam.gray_frames() if isinstance(f.pattern, Gray) and f.pattern.bit != bit
    )


def _recoded(**change):
    first, *others = procam.gray_frames()
    return (replace(first, pattern=first.pattern.model_copy(update=change)), *others)


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (procam.fields(), "no Gray code"),
        (_without(3), r"lack bits \[3\] of 7"),
        (procam.gray_frames()[1:], r"patterns of camera 'main', axis x lack bits \[6\]"),
        (procam.gray_frames() + procam.gray_frames()[:1], "more than once"),
        (procam.gray_frames(inverses=False), "neither inverse patterns nor"),
        (procam.gray_frames(inverses=False) + procam.fields()[:1], "neither inverse patterns nor"),
        (_recoded(codes=64), "different numbers of codes"),
        (_recoded(bits=8), "different numbers of bits"),
        ((replace(procam.gray_frames()[0], bit_depth=12), *procam.gray_frames()[1:]), "bit depths"),
    ],
)
def test_incomplete_codes_are_refused_in_one_sentence(frames, words):
    with pytest.raises(InvalidCaptureError, match=words):
        import_code_frames(frames)


def test_other_patterns_are_passed_over():
    frames = procam.gray_frames() + procam.fields()
    assert import_code_frames(frames) == CodeFrames(frames, len(frames))


def test_the_method_ends_with_the_code_and_starts_from_imported_frames():
    names = [s.name for s in METHOD.stages]
    assert names[names.index("code_capture") + 1] == "edges"
    assert names[-1] == "code_cloud"
    assert METHOD.importers["code_capture"] is import_code_frames
