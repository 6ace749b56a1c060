"""Stages of a reflection: what is shown, how it is read, what errors are counted against."""

import io
from typing import Any

import numpy as np
import pytest

from backend.domain.errors import InvalidCalibrationError, InvalidSettingError, StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.method import Method
from backend.domain.patterns import BLACK, WHITE, Sine
from backend.domain.rig import (
    CameraFacts,
    PinholeModel,
    Pose,
    ProjectorFacts,
    RigCalibration,
    RigFacts,
    ScreenModel,
)
from backend.domain.shots import Shot
from backend.jobs.rendering import render
from backend.methods.fringe_reflection import METHOD
from backend.stages.linearise import Linear
from backend.stages.mirror_files import result_npz
from backend.stages.ramp import ramp_from_table
from backend.stages.reflect_capture import (
    ReflectCaptureParams,
    capture_plan,
    reflect_capture,
    reflect_frames,
    reflect_patterns,
)
from backend.stages.screen_phase import ScreenPhaseParams, screen_phase
from backend.stages.slopes import SlopesParams, slopes
from backend.stages.surface import SurfaceParams, surface

SIZE = (60, 80)
FOCAL_MM = 900.0


def linear(**changes):
    values: dict[str, Any] = {
        "representation": "inverse", "reason": "", "steps": 8, "values": np.linspace(-1, 1, 256), "gray_low": 0.0,
        "gray_high": 255.0, "control_low": -0.5, "control_high": 0.8, "exposure_ms": 12.0,
    }  # fmt: skip
    return Linear(**(values | changes))


def facts():
    camera = CameraFacts(SIZE[1], SIZE[0], 8, 1.0, 100.0, 0.0, 10_000.0, 10.0)
    return RigFacts({"camera": camera}, "camera", ProjectorFacts(640, 400))


def silent(done, text=""):
    """Report to nobody."""


def nothing(array_hash):
    raise AssertionError("no array is asked for")


class TestCapture:
    def test_fringes_lie_between_the_chosen_control_values(self):
        shown = reflect_patterns(ReflectCaptureParams(), linear())
        assert len(shown) == 2 * 4 * 8
        first = shown[0]
        assert (first.axis, first.periods, first.shift_rad) == ("x", 0.9, 0.0)
        assert (first.low_gray, first.high_gray) == pytest.approx((63.75, 229.5))
        assert first.codes is None

    def test_without_a_linearisation_all_codes_are_used(self):
        shown = reflect_patterns(ReflectCaptureParams(periods_x=(4.0, 0.9)), None)
        assert len(shown) == 4 * (2 + 4)
        assert [p.periods for p in shown[:8:4]] == [0.9, 4.0]
        assert (shown[0].low_gray, shown[0].high_gray) == (0.0, 255.0)

    def test_pre_distorted_fringes_are_sinusoids_after_the_screen(self):
        bent = 255 * np.linspace(0, 1, 256) ** (1 / 2.2)
        (pattern, *_) = reflect_patterns(ReflectCaptureParams(), linear(codes=bent, steps=4))
        assert Sine.model_validate_json(pattern.model_dump_json()) == pattern
        picture = render(pattern, width_px=640, height_px=4)
        x = (np.arange(640) + 0.5) / 640
        wanted = 0.4 + 0.25 * 1.3 + 0.25 * 1.3 * np.cos(2 * np.pi * 0.9 * x) - 0.15
        assert np.abs((picture[0] / 255.0) ** 2.2 - wanted).max() < 0.006

    def test_plain_patterns_have_no_table_in_their_document(self):
        assert "codes" not in Sine(periods=4).model_dump()

    def test_the_plan_is_one_burst_with_fields_last(self):
        fringes = reflect_patterns(ReflectCaptureParams(), None)
        burst = next(capture_plan(fringes, 5.0, ReflectCaptureParams(gain_db=3.0)))
        assert isinstance(burst, tuple)
        assert all(isinstance(s, Shot) and (s.exposure_ms, s.gain_db) == (5.0, 3.0) for s in burst)
        assert [s.pattern for s in burst[-2:]] == [WHITE, BLACK]

    @pytest.mark.parametrize(
        ("params", "words"),
        [
            (ReflectCaptureParams(), "how long to expose"),
            (ReflectCaptureParams(exposure_ms=5, periods_x=(4.0, 16.0)), "the coarsest has 4 periods"),
            (ReflectCaptureParams(exposure_ms=5, periods_y=(0.9, 4.0, 4.0)), "one count twice"),
        ],
    )  # fmt: skip
    def test_what_cannot_be_unwrapped_is_not_captured(self, params, words):
        with pytest.raises(InvalidSettingError, match=words):
            reflect_capture(None, facts(), params, lambda plan: pytest.fail("nothing is shot"))


def captured(periods=(0.9, 4.0, 16.0), bend=1.0, noise=0.3):
    """A paraboloid seen from above, its screen beside the camera: frames, calibration, true slopes."""
    height, width = SIZE
    K = np.array([[400.0, 0, width / 2], [0, 400, height / 2], [0, 0, 1]])
    middle = np.array([0.0, 0.0, 600.0])
    facing = np.diag([1.0, -1.0, -1.0])
    y, x = np.mgrid[:height, :width]
    rays = np.stack([(x - width / 2) / 400, (y - height / 2) / 400, np.ones(x.shape)], -1) * [
        1,
        -1,
        -1,
    ]
    at = 600.0 * rays[..., :2]
    for _ in range(30):
        at = (600.0 - (at**2).sum(-1, keepdims=True) / (4 * FOCAL_MM)) * rays[..., :2]
    points = np.concatenate([at, (at**2).sum(-1, keepdims=True) / (4 * FOCAL_MM)], -1)
    true = at / (2 * FOCAL_MM)
    normals = np.concatenate([-true, np.ones((*SIZE, 1))], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    inwards = points - [0, 0, 600.0]
    inwards /= np.linalg.norm(inwards, axis=-1, keepdims=True)
    outwards = inwards - 2 * (inwards * normals).sum(-1, keepdims=True) * normals
    hit = points + (500.0 - points[..., 2:]) / outwards[..., 2:] * outwards
    share = hit[..., :2] / [400.0, 300.0] + 0.5
    share[..., 1] = 1 - share[..., 1]
    rng = np.random.default_rng(0)
    frames = []
    for axis in (0, 1):
        for p in periods:
            for k in range(4):
                wave = 0.5 + 0.5 * np.cos(2 * np.pi * p * share[..., axis] + k * np.pi / 2)
                gray = 20 + 200 * wave**bend + rng.normal(0, noise, SIZE)
                pattern = Sine(axis="xy"[axis], periods=p, shift_rad=k * np.pi / 2)
                frames.append(
                    Frame("camera", pattern, 5.0, InMemory(np.rint(gray).astype(np.uint8)))
                )
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    screen = np.column_stack([400 * corners[:, 0] - 200, 300 * corners[:, 1] - 150, np.zeros(4)])
    calibration = RigCalibration(
        cameras={"camera": PinholeModel(width, height, K)},
        camera_from_world={"camera": Pose(np.eye(3), np.zeros(3))},
        reference="camera",
        screen=ScreenModel(corners, screen),
        screen_from_world=Pose(np.eye(3), -np.array([0.0, 0.0, 100.0])),
        mirror_from_world=Pose(facing, -facing @ middle),
    )
    return reflect_frames(tuple(frames)), calibration, true


def phase_of(frames, params=None, linear_=None, ramp=None):
    params = params or ScreenPhaseParams()
    return screen_phase(frames, linear_, ramp, facts(), params, nothing, silent)


class TestReading:
    def test_a_ramp_that_belongs_is_used_and_one_that_does_not_is_not(self):
        bent = captured(bend=1.5)[0]
        codes = np.linspace(0, 255, 33)
        good = ramp_from_table(codes, 20 + 200 * (codes / 255) ** 1.5)
        bad = ramp_from_table(codes, 20 + 200 * (codes / 255) ** 0.4)
        assert (phase_of(bent, ramp=good).reading, phase_of(bent, ramp=bad).reading) == (
            "ramp",
            "gray",
        )
        levels = {
            c.name: c.level.value
            for c in screen_phase.check(phase_of(bent, ramp=bad), ScreenPhaseParams())
        }
        assert levels["ramp"] == "warning"
        kept = phase_of(bent, ScreenPhaseParams(reading="ramp"), ramp=bad)
        levels = {
            c.name: c.level.value
            for c in screen_phase.check(kept, ScreenPhaseParams(reading="ramp"))
        }
        assert levels["ramp"] == "failure"

    def test_reading_through_what_is_not_there_is_refused(self):
        frames = captured()[0]
        for reading, words in (("linear", "no linearisation"), ("ramp", "no ramp on file")):
            with pytest.raises(InvalidSettingError, match=words):
                phase_of(frames, ScreenPhaseParams(reading=reading))

    def test_one_direction_is_a_phase_and_no_slopes(self):
        frames, calibration, _ = captured()
        along_x = reflect_frames(tuple(f for f in frames.frames if f.pattern.axis == "x"))
        phase = phase_of(along_x)
        assert list(phase.share_y) == []
        with pytest.raises(StageFailedError, match="no fringes along y"):
            slopes(phase, calibration, SlopesParams(), nothing, silent)
        written = np.load(io.BytesIO(result_npz(phase, None)))
        assert written["wrapped_x"].shape == (3, *SIZE)
        assert written["frac_y"].size == 0


class TestShape:
    def measured(self, **settings):
        frames, calibration, true = captured()
        params = SlopesParams(**settings)
        arrays = {"0" * 64: self.design_map()}
        return slopes(phase_of(frames), calibration, params, arrays.__getitem__, silent), true

    def design_map(self):
        y, x = np.meshgrid(np.arange(60, -61, -2.0), np.arange(-80, 81, 2.0), indexing="ij")
        return (x**2 + y**2) / (4 * FOCAL_MM)

    def test_slopes_are_the_true_ones(self):
        found, true = self.measured()
        measured = 1e-3 * np.stack([found.slope_x_mrad["camera"], found.slope_y_mrad["camera"]], -1)
        assert np.sqrt(np.nanmean((measured - true) ** 2)) < 1e-4
        assert found.focal_x_m == pytest.approx(1e-3 * FOCAL_MM, rel=2e-3)
        assert np.nanmedian(found.curvature_per_m["camera"]) == pytest.approx(
            500 / FOCAL_MM, rel=0.02
        )

    @pytest.mark.parametrize(
        "design",
        [
            {"design": "fit"},
            {"design": "parabola", "focal_x_mm": FOCAL_MM},
            {"design": "map", "height_map": "0" * 64, "height_map_pitch_mm": 2.0},
        ],
    )
    def test_a_mirror_as_designed_has_no_error(self, design):
        found, _ = self.measured(**design)
        assert found.error_rms_mrad < 0.15
        assert surface(found, SurfaceParams(), silent).error_rms_um < 1.0

    def test_a_mirror_that_should_be_flat_has_its_own_slopes_as_error(self):
        found, _ = self.measured(design="plane")
        rms = np.hypot(found.rms_x_mrad, found.rms_y_mrad) / np.sqrt(2)
        assert found.error_rms_mrad == pytest.approx(rms, rel=1e-6)

    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"design": "parabola"}, "needs its focal length"),
            ({"design": "map"}, "needs one: hand it over"),
            ({"pose": "markers"}, "needs markers"),
            ({"pose": "outline"}, "Nothing says where the mirror is"),
        ],
    )
    def test_settings_that_lack_something_say_what(self, settings, words):
        with pytest.raises(InvalidSettingError, match=words):
            self.measured(**settings)

    def test_calibrations_that_do_not_fit_say_why(self):
        frames, calibration, _ = captured()
        phase = phase_of(frames)
        from dataclasses import replace

        screen = calibration.screen
        assert screen is not None
        holes = replace(screen, points_mm=screen.points_mm * np.array([[np.nan], [1], [1], [1]]))
        small = {"camera": PinholeModel(40, 30, calibration.cameras["camera"].K)}
        for changed, words in (
            (replace(calibration, screen=holes), "aren't finite"),
            (replace(calibration, cameras=small), "80x60 px, but it was calibrated at 40x30"),
        ):
            with pytest.raises(InvalidCalibrationError, match=words):
                slopes(phase, changed, SlopesParams(), nothing, silent)
        with pytest.raises(StageFailedError, match="has no screen"):
            slopes(phase, replace(calibration, screen=None), SlopesParams(), nothing, silent)


def test_files_are_wired_like_stages():
    sources = {w.input.name: w.source for w in METHOD.file_wires("surface.csv")}
    assert sources == {"slopes": "slopes", "surface": "surface"}

    def wrong(capture: ReflectCaptureParams) -> bytes:
        return b""

    with pytest.raises(TypeError, match="file 'wrong' reads 'capture', a ReflectCaptureParams"):
        Method("m", "M", METHOD.stages, METHOD.given, files={"wrong": wrong})
