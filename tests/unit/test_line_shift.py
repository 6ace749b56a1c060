"""Shifted stripes on pictures that are calculated: place, noise, mask, second reflections, and what is refused."""

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from backend.numerics.edge_positions import edge_positions
from backend.numerics.errors import CodeError, FrameError
from backend.numerics.line_shift import (
    LineShiftLimits,
    Stripes,
    decode_line_shift,
    reach_of,
)
from backend.numerics.mixed_light import separate_lights
from backend.numerics.reasons import Reason
from backend.numerics.uncertainty import NoiseModel

WIDTH_PX = 256
STRIPES = Stripes(0.0, 1.0, 8)
LIMITS = LineShiftLimits(coarse_error_px=3.5)


def scene(shape=(60, 200), low=20.0, high=230.0, seed=0):
    """Projector coordinates that fall anywhere within a pixel."""
    return np.random.default_rng(seed).uniform(low, high, shape)


def coarse(u_px, width=4):
    """What a Gray code with stripes of a width says."""
    return (np.floor((u_px + 0.5) / width) * width + (width - 1) / 2).astype(np.float32)


def pictures(
    u_px, *, gain=150.0, offset=10.0, blur=0.82, noise=0.0, mask=None, second=None, dtype=np.uint8,
    stripes=STRIPES, top=255,
) -> tuple[list[np.ndarray], list[np.ndarray]]:  # fmt: skip
    """Pattern and inverse at every shift; `second` = (share, distance in px) of a second reflection."""
    rng = np.random.default_rng(1)
    columns = np.arange(-40, WIDTH_PX + 40)
    light = np.ones(columns.size) if mask is None else np.pad(mask, 40, mode="edge")
    frames: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for shift in range(stripes.shifts):
        phase = (columns - stripes.first_edge_px - shift * stripes.step_px) % stripes.period_px
        for inverse in (0, 1):
            pattern = ((phase < stripes.period_px / 2) != inverse) * light
            seen = projected(pattern, u_px, blur)
            if second is not None:
                seen = seen + second[0] * projected(pattern, u_px + second[1], blur)
            gray = (
                offset + gain * seen + rng.normal(0, noise, u_px.shape)
                if noise
                else offset + gain * seen
            )
            frames[inverse].append(np.clip(np.rint(gray), 0, top).astype(dtype))
    return frames


def projected(pattern, u_px, blur):
    first = np.floor(u_px).astype(int)
    total = np.zeros_like(u_px)
    for away in range(-6, 8):
        column = first + away
        weight = ndtr((column + 0.5 - u_px) / blur) - ndtr((column - 0.5 - u_px) / blur)
        total += weight * pattern[column + 40]
    return total


def decode(frames, u_px, *, noise=0.0, stripes=STRIPES, **settings):
    patterns, inverses = frames
    arguments: dict[str, Any] = {"limits": LIMITS, **settings}
    return decode_line_shift(
        patterns, inverses, stripes, coarse(u_px), size_px=WIDTH_PX,
        noise=NoiseModel(noise, 0.0), **arguments,
    )  # fmt: skip


@pytest.mark.parametrize("blur", [0.7, 0.82, 1.3])
@pytest.mark.parametrize(("noise", "gain"), [(0.5, 60.0), (1.5, 200.0)])
def test_the_error_is_the_noise_that_is_predicted(blur, noise, gain):
    u_px = scene()
    found = decode(pictures(u_px, gain=gain, blur=blur, noise=noise), u_px, noise=noise)
    score = (found.projector_px - u_px) / found.sigma_px
    assert (found.reasons == 0).all()
    assert np.std(score) == pytest.approx(1, abs=0.04)
    assert abs(np.mean(score)) < 0.05


def test_noise_stays_near_its_bound():
    """Crossing of an edge with Gaussian blur s: no estimate is better than 0.94 sqrt(s) sigma_D / (2 A) per px."""
    u_px = scene()
    gain, blur, noise = 180.0, 0.82, 1.2
    found = decode(pictures(u_px, gain=gain, blur=blur, noise=noise), u_px, noise=noise)
    sigma_d = np.sqrt(2 * (noise**2 + 1 / 12))
    bound = sigma_d / gain * np.sqrt(np.sqrt(np.pi) * blur / 2)
    assert bound < np.std(found.projector_px - u_px) < 1.35 * bound


@pytest.mark.parametrize(
    ("gain", "offset"), [(150.0, 10.0), (60.0, 10.0), (150.0, 60.0), (20.0, 100.0)]
)
def test_gain_and_offset_do_not_move_an_edge(gain, offset):
    u_px = scene()
    found = decode(pictures(u_px, gain=gain, offset=offset), u_px)
    error = found.projector_px - u_px
    assert (found.reasons == 0).all()
    assert abs(error.mean()) < 1e-3
    assert error.std() < 0.6 / gain  # rounding to whole gray levels


def test_pictures_may_have_twelve_bits_and_steps_two_pixels():
    u_px = scene()
    stripes = Stripes(0.0, 2.0, 8)
    frames = pictures(u_px, gain=2500.0, dtype=np.uint16, stripes=stripes, top=4095)
    limits = LIMITS._replace(saturation_gray=4095.0)
    found = decode(frames, u_px, stripes=stripes, limits=limits)
    assert (found.reasons == 0).mean() > 0.999
    assert np.nanstd(found.projector_px - u_px) < 0.08  # a ripple: the blur is narrower than a step
    assert reach_of(stripes) == 1.0


def test_a_stepped_mask_drags_no_edge_along():
    u_px = scene()
    mask = np.where((np.arange(WIDTH_PX) // 9) % 2 == 0, 0.35, 0.9)
    frames = pictures(u_px, mask=mask)
    told = {"mask": np.tile(mask, (3, 1)), "across_px": np.ones(u_px.shape, np.float32)}
    error = {
        name: np.abs(decode(frames, u_px, **arguments).projector_px - u_px)
        for name, arguments in (("known", told), ("unknown", {}))
    }
    assert np.nanpercentile(error["unknown"], 95) > 0.2
    assert np.nanpercentile(error["known"], 95) < 0.05


def test_light_from_elsewhere_that_pattern_and_inverse_share_does_not_matter():
    u_px = scene()
    plain = decode(pictures(u_px), u_px).projector_px
    scattered = decode(pictures(u_px, offset=70.0), u_px).projector_px
    assert np.abs(plain - scattered).max() < 0.03


@pytest.mark.parametrize("away", [2.0, 3.0, -2.5])
def test_a_second_reflection_is_taken_off(away):
    u_px = np.tile(np.linspace(20, 200, 250), (40, 1))
    plain, mixed = pictures(u_px, noise=0.8), pictures(u_px, second=(0.4, away), noise=0.8)
    patterns, inverses = (
        [np.vstack([p, m[:9]]) for p, m in zip(*pair, strict=True)]
        for pair in zip(plain, mixed, strict=True)
    )
    u_px = np.vstack([u_px, u_px[:9]])
    located = decode((patterns, inverses), u_px, noise=0.8)
    found = separate_lights(patterns, inverses, STRIPES, located, noise=NoiseModel(0.8, 0.0))
    before = np.nanmedian(np.abs(located.projector_px - u_px)[41:])
    after = np.nanmedian(np.abs(found.projector_px - u_px)[41:])
    assert before > 0.15
    assert after < 0.03
    assert found.mixed[41:].mean() > 0.9
    assert found.mixed[:39].mean() < 0.01


def test_a_single_reflection_is_left_alone():
    u_px = np.tile(np.linspace(20, 200, 250), (40, 1))
    frames = pictures(u_px, noise=1.0)
    located = decode(frames, u_px, noise=1.0)
    found = separate_lights(*frames, STRIPES, located, noise=NoiseModel(1.0, 0.0))
    assert found.blur_px == pytest.approx(0.82, abs=0.06)
    assert found.mixed.mean() < 0.01
    np.testing.assert_array_equal(
        found.projector_px[~found.mixed], located.projector_px[~found.mixed]
    )


def reasons_of(frames, u_px, **settings):
    found = decode(frames, u_px, **settings)
    assert np.isnan(found.projector_px[found.reasons != 0]).all()
    return found.reasons


def test_every_missing_pixel_says_why():
    u_px = scene()
    dark = pictures(u_px, gain=3.0)
    assert (reasons_of(dark, u_px) == Reason.CODE_MARGIN).all()
    white = [[np.full(u_px.shape, 255, np.uint8)] * 8] * 2
    assert (reasons_of(white, u_px) == Reason.SATURATED).all()
    spilt = pictures(u_px, gain=900.0, offset=40.0)
    hidden = reasons_of(spilt, u_px)
    assert (hidden == Reason.HIDDEN_EDGE).mean() > 0.8
    elsewhere = decode_line_shift(
        *pictures(u_px), STRIPES, coarse(u_px) + np.float32(6), size_px=WIDTH_PX,
        noise=NoiseModel(0.0, 0.0), limits=LIMITS,
    )  # fmt: skip
    assert (elsewhere.reasons == Reason.ORDER_RESIDUAL).all()
    unread = np.full(u_px.shape, np.nan, np.float32)
    missing = decode_line_shift(
        *pictures(u_px), STRIPES, unread, size_px=WIDTH_PX, noise=NoiseModel(0.0, 0.0)
    )
    assert (missing.reasons == Reason.MISSING_DATA).all()


def test_white_stripes_widen_where_light_spills_over_and_nowhere_else():
    u_px = scene()
    assert np.abs(decode(pictures(u_px, gain=200.0), u_px).widening_px).max() < 0.5
    spilt = decode(pictures(u_px, gain=500.0), u_px).widening_px
    assert np.nanmedian(spilt) > 1.5


def test_edges_along_a_row_are_numbered_and_placed():
    x = np.arange(500)
    u_px = np.tile(10 + 0.4 * x, (20, 1)) + np.linspace(0, 1, 20)[:, None]
    frames = pictures(u_px, noise=1.0)
    located = decode(frames, u_px, noise=1.0)
    found = edge_positions(*frames, STRIPES, located.projector_px, size_px=WIDTH_PX)
    border = np.arange(WIDTH_PX + 1)
    expected = (border - 0.5 - 10 - np.linspace(0, 1, 20)[:, None]) / 0.4
    error = found.position_px - expected
    inner = (expected > 3) & (expected < 495)
    assert np.isfinite(error[inner]).all()
    assert abs(np.mean(error[inner])) < 0.005
    predicted = np.sqrt(2 * (1 + 1 / 12)) * np.sqrt(2 / 3) / found.slope_gray_per_px
    assert np.std((error / predicted)[inner]) == pytest.approx(1, abs=0.15)


def test_no_edge_is_placed_across_a_jump():
    u_px = np.tile(np.r_[np.linspace(20, 40, 50), np.linspace(120, 140, 50)], (3, 1))
    located = decode(pictures(u_px), u_px)
    found = edge_positions(*pictures(u_px), STRIPES, located.projector_px, size_px=WIDTH_PX)
    assert np.isnan(found.position_px[:, 43:118]).all()
    assert np.isfinite(found.position_px[:, 22:39]).all()


def test_what_does_not_fit_is_refused():
    u_px = scene((4, 5))
    frames = pictures(u_px)
    with pytest.raises(CodeError, match="8 patterns and 7 inverses"):
        decode([frames[0], frames[1][:-1]], u_px)
    with pytest.raises(CodeError, match="give 4 to 64"):
        decode([frames[0][:2], frames[1][:2]], u_px, stripes=Stripes(0.0, 1.0, 2))
    with pytest.raises(FrameError, match="decode both of one camera"):
        decode_line_shift(
            *frames, STRIPES, np.zeros((9, 9), np.float32), size_px=9, noise=NoiseModel(0.0, 0.0)
        )
