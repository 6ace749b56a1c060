from typing import Any

import numpy as np
import pytest

from backend.numerics.errors import FrameError
from backend.numerics.phasors import (
    NO_EXPOSURE,
    fuse_exposures,
    modulation_gray,
    sinusoid_misfit,
    wrapped_phase_rad,
)
from backend.numerics.reasons import Reason
from backend.numerics.sine_code import SineCode
from backend.numerics.uncertainty import NoiseModel
from tests.fringe_scenes import Scene, ramp

CODE = SineCode.equal_steps((5, 6), 4)
NOISE = NoiseModel(read_gray=0.5, gray_per_e=1 / 60)
X = ramp(4, 900)


def test_one_exposure_gives_the_sinusoid_in_its_own_gray_levels():
    scene = Scene(X, modulation_gray=70.0, mean_gray=100.0)
    code = SineCode((5.0, 6.5), ((0.3, 1.0, 2.9, 4.0, 5.1), (0.0, 2.0, 4.0)))
    phasors = fuse_exposures(
        [scene.frames(code)], code, exposure_ms=[8.0], noise=NOISE, saturation_gray=254
    )
    expected_rad = 2 * np.pi * np.array(code.periods)[:, np.newaxis, np.newaxis] * X
    error_rad = np.angle(np.exp(1j * (wrapped_phase_rad(phasors) - expected_rad)))
    # Rounding to whole gray levels, worst case of half a gray on every frame.
    assert np.abs(error_rad).max() < 0.02
    assert np.abs(modulation_gray(phasors) - 70).max() < 1.2
    assert np.abs(8.0 * phasors.light_gray_per_ms - 100).max() < 1.2
    assert (phasors.exposure_index == 0).all()
    assert (phasors.reasons == 0).all()
    assert np.allclose(phasors.sigma_gray, NOISE.sigma_gray(np.full(1, 100.0)), rtol=0.01)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fusion_agrees_with_its_formula_in_plain_numpy(dtype):
    full_scale = 255 if dtype == np.uint8 else 4095
    scene = Scene(X, modulation_gray=0.6 * full_scale / 255 * 60, mean_gray=full_scale / 255 * 60)
    exposure_ms = [1.0, 4.0, 2.0]
    exposures = [
        scene.frames(CODE, exposure_ms=t, sigma_gray=1.5, seed=i, dtype=dtype, full_scale_gray=full_scale, black_gray=3.0)
        for i, t in enumerate(exposure_ms)
    ]  # fmt: skip
    noise = NoiseModel(read_gray=0.5, gray_per_e=1 / 60, black_gray=3.0)
    fused = fuse_exposures(
        exposures, CODE, exposure_ms=exposure_ms, noise=noise, saturation_gray=full_scale - 1
    )
    weights, rates, means, valid = [], [], [], []
    for frames, t in zip(exposures, exposure_ms, strict=True):
        stack = np.array(frames, np.float64).reshape(2, 4, *X.shape)
        phasor = ((stack[:, 0] - stack[:, 2]) + 1j * (stack[:, 3] - stack[:, 1])) / 2
        light = stack.mean(axis=(0, 1)) - 3
        usable = stack.max(axis=(0, 1)) < full_scale - 1
        variance = 0.25 + 1 / 12 + np.maximum(light, 0) / 60
        weights.append(usable * t**2 / variance)
        rates.append(phasor / t)
        means.append(light / t)
        valid.append(usable)
    weight, total = np.array(weights), np.sum(weights, axis=0)
    index = weight.argmax(axis=0)
    best_ms = np.array(exposure_ms)[index]
    phasor = best_ms * np.einsum("ehw,ekhw->khw", weight, np.array(rates)) / total
    light = np.einsum("ehw,ehw->hw", weight, np.array(means)) / total
    assert (total > 0).all()
    assert not np.array(valid).all()
    assert (fused.exposure_index == index).all()
    rounding_gray = np.array(
        [fused.in_phase_gray - phasor.real, fused.quadrature_gray - phasor.imag]
    )
    assert fused.step_gray == pytest.approx(full_scale / 32767, rel=0.01)
    assert np.abs(rounding_gray).max() < 0.501 * fused.step_gray
    assert np.allclose(fused.light_gray_per_ms, light, rtol=1e-5)
    assert np.allclose(fused.sigma_gray, best_ms / np.sqrt(total), rtol=1e-5)
    assert (fused.reasons == 0).all()


def test_longest_unsaturated_takes_all_frequencies_from_the_longest_clean_exposure():
    modulation = np.broadcast_to(np.geomspace(4, 100, X.shape[1]), X.shape)
    scene = Scene(X, modulation_gray=modulation, mean_gray=1.2 * modulation)
    exposure_ms = [1.0, 9.0, 3.0]
    exposures = [scene.frames(CODE, exposure_ms=t) for t in exposure_ms]
    fused = fuse_exposures(
        exposures, CODE, exposure_ms=exposure_ms, noise=NOISE, saturation_gray=254,
        strategy="longest_unsaturated",
    )  # fmt: skip
    clean = np.array([np.array(frames).max(axis=0) < 254 for frames in exposures])
    expected = np.where(clean[1], 1, np.where(clean[2], 2, 0))
    assert clean[0].all()
    assert (fused.exposure_index == expected).all()
    assert len(np.unique(expected)) == 3
    chosen = np.take_along_axis(
        np.array(exposures, float), expected[np.newaxis, np.newaxis], axis=0
    )[0].reshape(2, 4, *X.shape)
    assert np.abs(fused.in_phase_gray - (chosen[:, 0] - chosen[:, 2]) / 2).max() < 4e-3


def test_masks_take_the_named_exposure_and_report_its_saturation():
    scene = Scene(X, modulation_gray=80.0, mean_gray=100.0)
    exposures = [scene.frames(CODE, exposure_ms=t) for t in (1.0, 2.0)]
    index = np.zeros(X.shape, np.uint8)
    index[1], index[2] = 1, NO_EXPOSURE
    fused = fuse_exposures(
        exposures, CODE, exposure_ms=[1.0, 2.0], noise=NOISE, saturation_gray=254,
        strategy="masks", exposure_index=index,
    )  # fmt: skip
    assert (fused.exposure_index == index).all()
    assert (fused.reasons[0] == 0).all()
    saturated = np.array(exposures[1])[:, 1].max(axis=0) >= 254
    assert saturated.any()
    assert (fused.reasons[1] == np.where(saturated, int(Reason.SATURATED), 0)).all()
    assert (fused.reasons[2] == int(Reason.DARK)).all()
    assert np.isnan(fused.sigma_gray[2]).all()
    assert (fused.in_phase[:, 2] == 0).all()
    assert (fused.light_gray_per_ms[2] == 0).all()


def test_a_pixel_saturated_everywhere_says_so():
    scene = Scene(X, modulation_gray=100.0, mean_gray=200.0)
    exposures = [scene.frames(CODE, exposure_ms=t) for t in (1.0, 2.0)]
    fused = fuse_exposures(
        exposures, CODE, exposure_ms=[1.0, 2.0], noise=NOISE, saturation_gray=254
    )
    assert (fused.reasons == int(Reason.SATURATED)).all()
    assert (fused.exposure_index == NO_EXPOSURE).all()


def test_misfit_is_the_noise_for_sinusoids_and_more_with_harmonics():
    code = SineCode.equal_steps((5, 6), 8)
    clean = sinusoid_misfit(Scene(X).frames(code, sigma_gray=2.0), code)
    expected = np.sqrt(2.0**2 + 1 / 12)
    assert np.sqrt((clean.astype(float) ** 2).mean()) == pytest.approx(expected, rel=0.02)
    bent = [(255 * (frame / 255.0) ** 1.5).astype(np.uint8) for frame in Scene(X).frames(code)]
    assert np.median(sinusoid_misfit(bent, code)) > 2.5


def test_maps_are_reused_when_given_and_have_to_fit():
    frames = Scene(X).frames(CODE)
    arguments: dict[str, Any] = {"exposure_ms": [1.0], "noise": NOISE, "saturation_gray": 254.0}
    first = fuse_exposures([frames], CODE, **arguments)
    expected = first.in_phase.copy()
    first.in_phase[:] = 0
    again = fuse_exposures([frames], CODE, out=first, **arguments)
    assert again.in_phase is first.in_phase
    assert (first.in_phase == expected).all()
    with pytest.raises(FrameError, match="give maps of this size"):
        fuse_exposures([[frame[:2] for frame in frames]], CODE, out=first, **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposures": []}, "0 sets of frames"),
        ({"exposure_ms": [1.0, 2.0]}, "2 exposure times"),
        ({"exposure_ms": [0.0]}, "times > 0"),
        ({"exposures": [[np.zeros((4, 5), np.uint8)] * 7]}, "7 frames but the code needs 8"),
        ({"noise": [NOISE, NOISE]}, "2 noise models for 1 exposures"),
        ({"strategy": "masks"}, "shape None"),
        (
            {"strategy": "masks", "exposure_index": np.full((4, 5), 3, np.uint8)},
            "names exposure 3 but there are 1",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_does_not_fit_together_is_refused(change, message):
    arguments: dict[str, Any] = {
        "exposures": [[np.zeros((4, 5), np.uint8)] * 8],
        "exposure_ms": [1.0],
        "noise": NOISE,
        "saturation_gray": 254.0,
        **change,
    }
    exposures = arguments.pop("exposures")
    with pytest.raises(FrameError, match=message):
        fuse_exposures(exposures, CODE, **arguments)


def test_misfit_needs_more_frames_than_unknowns():
    code = SineCode.equal_steps((5,), 3)
    with pytest.raises(FrameError, match="more than three steps"):
        sinusoid_misfit([np.zeros((4, 5), np.uint8)] * 3, code)
