import numpy as np
import pytest

from backend.numerics.absolute_phase import Limits, absolute_phase, decode_frames, empty_maps
from backend.numerics.errors import FrameError, FrequencyError
from backend.numerics.fringe_orders import cascade, code_aided, hierarchical, maximum_likelihood
from backend.numerics.phasors import fuse_exposures
from backend.numerics.reasons import Reason
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel
from tests.fringe_scenes import Scene, ramp

SIZE_PX = 1280
NOISE = NoiseModel(read_gray=1.0, gray_per_e=0.0)
X = ramp(8, 2300)
REAL = (1920 / 42, 1920 / 45, 1920 / 48)

WAYS = {
    "likelihood-paper": ((59, 64, 70), maximum_likelihood),
    "likelihood-unsorted": ((70, 59, 64), maximum_likelihood),
    "likelihood-real": (REAL, maximum_likelihood),
    "likelihood-equidistant": ((35, 36, 37), maximum_likelihood),
    "likelihood-two": ((13, 14), maximum_likelihood),
    "likelihood-four": ((17, 23, 29, 31), maximum_likelihood),
    "likelihood-five": ((1, 3, 9, 27, 50), maximum_likelihood),
    "likelihood-irrational": ((10 * np.sqrt(2), 17.3, 11.1), maximum_likelihood),
    "cascade-paper": ((59, 64, 70), cascade),
    "cascade-fused": ((59, 64, 70), lambda p: cascade(p, fuse=True)),
    "cascade-real": (REAL, cascade),
    "cascade-equal-beats": ((35, 36, 37), cascade),
    "cascade-two": ((15, 16), cascade),
    "hierarchical": ((1, 8, 64), hierarchical),
    "hierarchical-uneven": ((64, 0.9, 7.3), hierarchical),
    "hierarchical-highest": ((1, 8, 64), lambda p: hierarchical(p, fuse=False)),
}


@pytest.mark.parametrize("n_steps", [3, 4, 5, 8])
@pytest.mark.parametrize("way", WAYS)
def test_every_way_finds_the_position_of_every_pixel(way, n_steps):
    periods, prepare = WAYS[way]
    code = SineCode.equal_steps(periods, n_steps, direction=-1 if n_steps == 5 else 1)
    frames = Scene(X).frames(code)
    decoded = decode_frames(
        frames, code, prepare(code.periods), size_px=SIZE_PX, saturation_gray=254
    )
    assert (decoded.reasons == 0).all()
    error_px = decoded.projector_px - (X * SIZE_PX - 0.5)
    # Half a gray of rounding on each frame moves a phase by at most 0.75/B, the position by at most
    # that over the highest frequency, or over the mean of all when they are fused.
    f = np.array(periods)
    worst_rad = 0.75 / 70
    worst_px = worst_rad / (2 * np.pi) * max(f.sum() / (f @ f), 1 / f.max()) * SIZE_PX
    assert np.abs(error_px).max() < worst_px
    assert np.abs(decoded.modulation_gray - 70).max() < 1.5
    assert decoded.residual_cycles.max() < 0.01


def test_both_ways_in_give_the_same_maps():
    code = SineCode.equal_steps((59, 64, 70), 4)
    orders = maximum_likelihood(code.periods)
    frames = Scene(X).frames(code, sigma_gray=2.0)
    noise = NoiseModel(read_gray=2.0, gray_per_e=1 / 60, black_gray=2.0)
    direct = decode_frames(
        frames, code, orders, size_px=SIZE_PX, saturation_gray=254, noise=noise, with_margin=True
    )
    phasors = fuse_exposures([frames], code, exposure_ms=[5.0], noise=noise, saturation_gray=254)
    through = absolute_phase(phasors, code, orders, size_px=SIZE_PX, with_margin=True)
    assert (direct.reasons == through.reasons).all()
    assert np.nanmax(np.abs(direct.projector_px - through.projector_px)) < 1e-3
    for a, b in zip(direct[:6], through[:6], strict=True):
        assert a is not None
        assert b is not None
        # rounded phasors may fall into the next cell of the look-up table, which has another second candidate
        assert np.isclose(a, b, rtol=1e-3, atol=1e-4, equal_nan=True).mean() > 0.998


def test_the_fast_path_for_three_frequencies_agrees_with_the_general_one():
    three = SineCode.equal_steps((17, 23, 29), 4)
    scene = Scene(X)
    fast = decode_frames(
        scene.frames(three, sigma_gray=4.0, seed=1), three, maximum_likelihood(three.periods),
        size_px=SIZE_PX, saturation_gray=254, with_margin=True,
    )  # fmt: skip
    # A fourth frequency that never has any light changes nothing but the search: compare in numpy.
    f = np.array(three.periods)
    stack = np.array(scene.frames(three, sigma_gray=4.0, seed=1), float).reshape(3, 4, *X.shape)
    w = np.arctan2(stack[:, 3] - stack[:, 1], stack[:, 0] - stack[:, 2]) / (2 * np.pi) % 1
    best, second = np.full(X.shape, np.inf), np.full(X.shape, np.inf)
    position = np.zeros(X.shape)
    for order in range(-1, 31):
        coarse = (w[2] + order) / f[2]
        orders = np.rint(f[:, None, None] * coarse - w)
        x = (f[:, None, None] * (w + orders)).sum(axis=0) / (f @ f)
        misfit = np.sqrt(((f[:, None, None] * x - w - orders) ** 2).sum(axis=0))
        x = x % 1
        better = misfit < best - 1e-9
        second = np.where(
            better, best, np.where(misfit > best + 1e-9, np.minimum(second, misfit), second)
        )
        position = np.where(better, x, position)
        best = np.minimum(best, misfit)
    assert np.abs(fast.residual_cycles - best).max() < 2e-4
    valid = fast.reasons == 0
    assert np.abs(fast.projector_px - (position * SIZE_PX - 0.5))[valid].max() < 2e-2
    assert fast.margin_cycles is not None
    assert np.median(np.abs(fast.margin_cycles - (second - best))) < 1e-3


@pytest.mark.parametrize("codes", [128, 256, SIZE_PX])
def test_a_complementary_code_forgives_edges_a_fifth_of_a_period_off(codes):
    code = SineCode.equal_steps((64,), 4)
    frames = Scene(X).frames(code)
    shifted = np.clip(X + 0.2 / 64 * np.sin(np.arange(X.shape[1]) / 30.0), 0, 1 - 1e-9)
    coarse_px = ((np.floor(shifted * codes) + 0.5) / codes * SIZE_PX - 0.5).astype(np.float32)
    decoded = decode_frames(
        frames, code, code_aided(code.periods, codes=codes), size_px=SIZE_PX,
        saturation_gray=254, coarse_px=coarse_px, limits=Limits(max_residual_cycles=0.5),
    )  # fmt: skip
    assert np.abs(decoded.projector_px - (X * SIZE_PX - 0.5)).max() < 0.1
    assert decoded.residual_cycles.max() < 0.21


def test_a_plain_code_errs_by_a_period_where_its_edges_are_off():
    code = SineCode.equal_steps((64,), 4)
    shifted = np.clip(X + 0.1 / 64, 0, 1 - 1e-9)
    coarse_px = ((np.floor(shifted * 64) + 0.5) / 64 * SIZE_PX - 0.5).astype(np.float32)
    decoded = decode_frames(
        Scene(X).frames(code), code, code_aided(code.periods, codes=64), size_px=SIZE_PX,
        saturation_gray=254, coarse_px=coarse_px, limits=Limits(max_residual_cycles=0.5, guard_band=0.0),
    )  # fmt: skip
    wrong = np.abs(decoded.projector_px - (X * SIZE_PX - 0.5)) > SIZE_PX / 128
    assert 0.05 < wrong.mean() < 0.15


def test_pixels_without_a_code_are_missing():
    code = SineCode.equal_steps((64,), 4)
    coarse_px = (X * SIZE_PX - 0.5).astype(np.float32)
    coarse_px[0] = np.nan
    decoded = decode_frames(
        Scene(X).frames(code), code, code_aided(code.periods, codes=SIZE_PX), size_px=SIZE_PX,
        saturation_gray=254, coarse_px=coarse_px,
    )  # fmt: skip
    assert (decoded.reasons[0] == int(Reason.MISSING_DATA)).all()
    assert (decoded.reasons[1:] == 0).all()
    assert np.isnan(decoded.projector_px[0]).all()


def test_each_reason_is_named_where_it_applies():
    code = SineCode.equal_steps((59, 64, 70), 4)
    x = X.copy()
    x[4] = 0.001
    modulation, mean = np.full(X.shape, 70.0), np.full(X.shape, 100.0)
    modulation[1], mean[1] = 2.0, 100.0
    modulation[2], mean[2] = 2.0, 3.0
    mean[3] = 230.0
    frames = Scene(x, modulation, mean).frames(code)
    for frame in frames[8:]:
        frame[5] = np.roll(frame[5], 3)
    limits = Limits(min_modulation_gray=5.0, guard_band=0.002)
    decoded = decode_frames(
        frames,
        code,
        maximum_likelihood(code.periods),
        size_px=SIZE_PX,
        saturation_gray=254,
        limits=limits,
    )
    assert (decoded.reasons[0] == 0).all()
    assert (decoded.reasons[1] == int(Reason.LOW_MODULATION)).all()
    assert (decoded.reasons[2] == int(Reason.DARK)).all()
    assert (decoded.reasons[3] == int(Reason.SATURATED)).all()
    assert (decoded.reasons[4] == int(Reason.GUARD_BAND)).all()
    assert (decoded.reasons[5] == int(Reason.ORDER_RESIDUAL)).mean() > 0.9
    assert np.isnan(decoded.projector_px[1:6]).mean() > 0.98
    assert (np.isnan(decoded.projector_px) == (decoded.reasons != 0)).all()


def test_positions_off_the_projector_are_named_where_the_code_is_longer_than_it():
    code = SineCode.equal_steps((*REAL,), 4)
    decoded = decode_frames(
        Scene(np.full((2, 30), 1.05)).frames(code), code, hierarchical_like(code.periods),
        size_px=SIZE_PX, saturation_gray=254,
    )  # fmt: skip
    assert (decoded.reasons == int(Reason.OUTSIDE_PROJECTOR)).all()


def hierarchical_like(periods):
    """A cascade: it knows all of the code's 2.6 widths, while likelihood looks on the projector only."""
    return cascade(periods)


def test_phasors_without_length_are_invalid_and_nothing_crashes():
    code = SineCode.equal_steps((59, 64, 70), 4)
    phasors = fuse_exposures(
        [Scene(X).frames(code)], code, exposure_ms=[1.0], noise=NOISE, saturation_gray=254
    )
    phasors.in_phase[:, 0] = phasors.quadrature[:, 0] = 0
    phasors.in_phase[1, 1] = phasors.quadrature[1, 1] = 0
    phasors.light_gray_per_ms[1, 5:9] = np.nan
    decoded = absolute_phase(phasors, code, maximum_likelihood(code.periods), size_px=SIZE_PX)
    assert (decoded.reasons[:2] != 0).all()
    assert np.isnan(decoded.projector_px[:2]).all()
    assert (decoded.reasons[2:] == 0).all()


def test_the_wrapped_phase_is_that_of_the_highest_frequency():
    code = SineCode.equal_steps((59, 70, 64), 4)
    phasors = fuse_exposures(
        [Scene(X).frames(code)], code, exposure_ms=[1.0], noise=NOISE, saturation_gray=254
    )
    phasors.reasons[3] = int(Reason.SATURATED)
    decoded = absolute_phase(
        phasors, code, maximum_likelihood(code.periods), size_px=SIZE_PX, with_wrapped=True
    )
    assert decoded.wrapped_rad is not None
    assert np.isnan(decoded.wrapped_rad[3]).all()
    wrapped_rad, expected_rad = (
        np.delete(m, 3, axis=0) for m in (decoded.wrapped_rad, 2 * np.pi * 70 * X)
    )
    assert np.abs(np.angle(np.exp(1j * (wrapped_rad - expected_rad)))).max() < 0.02
    assert np.abs(wrapped_rad).max() <= np.float32(np.pi)


def test_maps_are_reused_when_given():
    code = SineCode.equal_steps((59, 64, 70), 4)
    maps = empty_maps(X.shape)
    decoded = decode_frames(
        Scene(X).frames(code), code, maximum_likelihood(code.periods),
        size_px=SIZE_PX, saturation_gray=254, out=maps,
    )  # fmt: skip
    assert decoded is maps
    assert decoded.sigma_px is None


@pytest.mark.parametrize("height_width", [(1, 1), (1, 2047), (3, 683), (9, 1821), (0, 5)])
def test_any_size_works(height_width):
    x = np.full(height_width, 0.4)
    code = SineCode.equal_steps((59, 64, 70), 4)
    decoded = decode_frames(
        Scene(x).frames(code),
        code,
        maximum_likelihood(code.periods),
        size_px=SIZE_PX,
        saturation_gray=254,
    )
    assert decoded.projector_px.shape == height_width
    assert np.abs(decoded.projector_px - (0.4 * SIZE_PX - 0.5)).max(initial=0.0) < 0.1


def test_what_does_not_fit_together_is_refused():
    code = SineCode.equal_steps((59, 64, 70), 4)
    orders = maximum_likelihood(code.periods)
    frames = [np.zeros((3, 4), np.uint8)] * 12
    with pytest.raises(FrameError, match="11 frames"):
        decode_frames(frames[:11], code, orders, size_px=8, saturation_gray=254)
    with pytest.raises(FrequencyError, match="prepare them"):
        decode_frames(
            frames, code, maximum_likelihood((70, 64, 59)), size_px=8, saturation_gray=254
        )
    with pytest.raises(FrameError, match=r"maps of shape \(5, 4\)"):
        decode_frames(frames, code, orders, size_px=8, saturation_gray=254, out=empty_maps((5, 4)))
    with pytest.raises(FrameError, match="noise model"):
        decode_frames(
            frames, code, orders, size_px=8, saturation_gray=254,
            out=empty_maps((3, 4), with_sigma=True),
        )  # fmt: skip
    with pytest.raises(FrameError, match="shape None"):
        decode_frames(
            frames, code, code_aided(code.periods, codes=128), size_px=8, saturation_gray=254
        )
