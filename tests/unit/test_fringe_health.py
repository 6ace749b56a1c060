"""What fringes say of themselves: closure, the defective frame by name, and whether a ramp belongs to them."""

import os
from pathlib import Path

import numpy as np
import pytest

from backend.devices.sim.chains import CHAINS
from backend.numerics.errors import FrameError
from backend.numerics.fringe_health import (
    closures,
    judge_ramp,
    learn_response,
    name_defective_frame,
    suspect_sets,
)
from backend.numerics.linearisation import inverse_table
from backend.numerics.screen_ramp import monotone_ramp

PERIODS = (0.9, 3.9, 15.9, 63.9)


def fringes(steps: int = 4, noise: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """Linear fringes of four numbers of periods, and their phases: set x step x pixel, set x pixel."""
    rng = np.random.default_rng(4)
    share = rng.uniform(0.1, 0.9, 4000)
    phase = 2 * np.pi * np.array(PERIODS)[:, None] * share
    shifts = 2 * np.pi * np.arange(steps) / steps
    clean = 120 + 80 * np.cos(phase[:, None] + shifts[:, None])
    return np.rint(clean + noise * rng.standard_normal(clean.shape)), phase


@pytest.mark.parametrize("steps", [4, 5, 8])
def test_good_sets_close_within_their_noise(steps: int) -> None:
    frames, _ = fringes(steps)

    found = closures(frames)

    expected = np.sqrt(1.5**2 + 1 / 12) / 80 * np.sqrt((steps - 3) / steps)
    np.testing.assert_allclose(found, expected, rtol=0.05)
    assert suspect_sets(found).size == 0


def test_three_steps_always_close() -> None:
    assert np.isnan(closures(fringes(3)[0])).all()
    assert suspect_sets(closures(fringes(3)[0])).size == 0


DEFECTS = {
    "dropped": lambda frame: 0 * frame,
    "dimmed": lambda frame: 0.9 * frame,
    "brighter": lambda frame: frame + 12,
    "blurred": lambda frame: 120 + 0.7 * (frame - 120),
}


@pytest.mark.parametrize("steps", [4, 8])
@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("kind", DEFECTS)
def test_a_defective_frame_is_found_and_named(kind: str, which: int, steps: int) -> None:
    frames, phase = fringes(steps)
    defective = (which + 1) % steps
    frames[which, defective] = DEFECTS[kind](frames[which, defective])

    suspects = suspect_sets(closures(frames))
    named = name_defective_frame(frames[which], phase[which])

    assert suspects.tolist() == [which]
    assert named.step == defective
    assert named.clear
    assert named.departure > 0.05


def test_a_good_set_names_no_frame() -> None:
    frames, phase = fringes()

    assert not name_defective_frame(frames[1], phase[1]).clear


def test_three_frames_or_few_pixels_name_nothing() -> None:
    frames, phase = fringes()

    with pytest.raises(FrameError, match="at least four"):
        name_defective_frame(frames[0, :3], phase[0])
    with pytest.raises(FrameError, match="100 pixels"):
        name_defective_frame(frames[0, :, :100], phase[0, :100])
    with pytest.raises(FrameError, match="100 pixels"):
        learn_response(frames[0, :, :100], phase[0, :100])


@pytest.mark.parametrize("letter", ["B", "D", "E"])
@pytest.mark.parametrize("own", [True, False])
def test_a_ramp_belongs_to_the_fringes_of_its_own_chain(letter: str, own: bool) -> None:
    chain, rng = CHAINS[letter], np.random.default_rng(8)
    phase = rng.uniform(0, 2 * np.pi, 5000)
    control = 0.9 * np.cos(phase + np.arange(4)[:, None] * np.pi / 2)
    frames = chain.gray(chain.luminance(chain.code(control)), 1.0, rng)
    measured = chain if own else CHAINS["A"]
    y = np.linspace(-1, 1, 33)
    ramp = monotone_ramp(y, measured.gray(measured.luminance(measured.code(y)), quantised=False))

    verdict = judge_ramp(learn_response(frames, phase), inverse_table(ramp, 256))

    assert verdict.belongs is own


@pytest.mark.skipif(
    "UNGLARE_DATA" not in os.environ, reason="UNGLARE_DATA names no folder of real captures"
)
@pytest.mark.parametrize("axis", [0, 1])
def test_the_ramp_beside_the_facet_doesnt_belong_to_its_frames(axis: int) -> None:
    """The frames are straight to 1 % by themselves; the ramp shipped beside them would bend them by 8 %."""
    data = np.load(Path(os.environ["UNGLARE_DATA"]) / "sofast-facet" / "facet_input.npz")
    frames = data["fringe_images"].reshape(2, 4, 4, *data["mask_processed"].shape)
    sets = frames[axis][:, :, data["mask_processed"]].astype(np.float64)
    ramp = monotone_ramp(data["ramp_display"] / 127.5 - 1, data["ramp_camera"])
    table = inverse_table(ramp, 256)
    share = np.zeros(sets.shape[2])
    for fringe, p in zip(sets, PERIODS, strict=True):
        turns = np.arctan2(fringe[1] - fringe[3], fringe[0] - fringe[2]) / (2 * np.pi)
        share = (turns + np.round(share * p - turns)) / p if p > 1 else (turns % 1.0) / p

    shifts = -np.arange(4) * np.pi / 2
    verdict = judge_ramp(
        learn_response(sets[1], 2 * np.pi * PERIODS[1] * share, shifts_rad=shifts), table
    )

    assert not verdict.belongs
    assert verdict.table_error_percent > 5
    assert verdict.raw_error_percent < 1.5
    assert closures(sets).max() < 0.02
    assert suspect_sets(closures(sets)).size == 0
