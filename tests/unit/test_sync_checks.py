"""Residuals of sets that belong together: noise doesn't count, a frame of another pattern does."""

import numpy as np
import pytest

from backend.numerics.sync_checks import (
    Fields,
    FrameSample,
    common_part,
    drift,
    is_unchanged,
    marker_light,
    movement,
    pair_part,
    same,
    step_set,
)

SHAPE = (120, 160)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]
ALBEDO = 0.2 + 0.8 * ((X // 40 + Y // 30) % 2)


def seen(light: np.ndarray, *, noise: float = 1.0, seed: int = 0) -> np.ndarray:
    """Return what a camera makes of projected light in 0..1."""
    rng = np.random.default_rng(seed)
    gray = 8 + ALBEDO * (10 + 120 * light) + rng.normal(0, noise, SHAPE)
    return np.asarray(np.clip(np.rint(gray), 0, 255).astype(np.uint8))


def fringe(step: float, steps: int, *, periods: float = 10.0, gamma: float = 1.0) -> np.ndarray:
    phase = 2 * np.pi * (periods * X / SHAPE[1] + step / steps)
    return np.asarray((0.5 + 0.5 * np.cos(phase)) ** gamma)


def samples(grays: list[np.ndarray]) -> list[FrameSample]:
    return [FrameSample(gray, full_scale_gray=255.0) for gray in grays]


def shifts(steps: int) -> np.ndarray:
    return 2 * np.pi * np.arange(steps) / steps


def steps_seen(steps: int, *, noise: float = 1.0, gamma: float = 1.0) -> list[np.ndarray]:
    return [seen(fringe(k, steps, gamma=gamma), noise=noise, seed=k) for k in range(steps)]


def late(grays: list[np.ndarray]) -> list[np.ndarray]:
    return [*grays[:2], seen_again(grays[1]), *grays[3:]]


def seen_again(gray: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(99)
    return np.clip(np.rint(gray + rng.normal(0, 1, SHAPE)), 0, 255).astype(np.uint8)


def torn(grays: list[np.ndarray]) -> list[np.ndarray]:
    rows = SHAPE[0] // 5
    return [*grays[:2], np.vstack([grays[1][:rows], grays[2][rows:]]), *grays[3:]]


def swapped(grays: list[np.ndarray]) -> list[np.ndarray]:
    return [grays[0], grays[2], grays[1], *grays[3:]]


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("noise", [0.5, 3.0, 6.0])
@pytest.mark.parametrize("steps", [4, 5, 8, 12])
def test_noise_and_a_bent_response_are_no_deviation(steps: int, noise: float, gamma: float) -> None:
    found = step_set(samples(steps_seen(steps, noise=noise, gamma=gamma)), shifts(steps))
    assert found is None or found.share < 0.03


def dim(light: np.ndarray, amplitude_gray: float, noise: float, seed: int) -> np.ndarray:
    """Return what is seen of a smooth surface that hardly any light reaches."""
    gray = 3.3 + (0.6 + 0.4 * X / SHAPE[1]) * amplitude_gray * light
    noisy = gray + np.random.default_rng(seed).normal(0, noise, SHAPE)
    return np.asarray(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("amplitude_gray", [3.2, 5.0, 8.0])
@pytest.mark.parametrize("noise", [0.05, 0.2, 0.5, 1.0])
def test_rounding_is_no_deviation(noise: float, amplitude_gray: float) -> None:
    """Where noise doesn't hide its steps, neighbours are rounded alike: it looks like a picture."""
    for seed in range(4):

        def step(k: int, steps: int, periods: float = 3.0, *, seed: int = seed) -> np.ndarray:
            light = fringe(k + seed / 10, steps, periods=periods)
            return dim(light, amplitude_gray, noise, 100 * seed + 10 * int(periods) + k)

        found = [step_set(samples([step(k, n) for k in range(n)]), shifts(n)) for n in (4, 5, 8)]
        parts = [common_part(samples([step(k, 3, p) for k in range(3)]), shifts(3)) for p in (2, 3)]
        assert parts[0] is not None
        assert parts[1] is not None
        found.append(parts[1].against(parts[0]))
        assert max((f.share for f in found if f), default=0.0) < 0.03


def test_a_late_frame_stands_out_as_soon_as_there_is_light_enough_to_tell() -> None:
    for amplitude_gray in (2.0, 4.0, 6.0, 8.0, 16.0):
        grays = [dim(fringe(k, 4), amplitude_gray, 0.3, k) for k in range(4)]
        found = step_set(samples([*grays[:2], grays[1], grays[3]]), shifts(4))
        assert found is None or found.share > 0.1
        assert found is not None or amplitude_gray < 6


@pytest.mark.parametrize("wrong", [late, torn, swapped])
@pytest.mark.parametrize("steps", [4, 5, 8, 12])
def test_a_wrong_frame_stands_out(steps: int, wrong: object) -> None:
    assert callable(wrong)
    frames = samples(wrong(steps_seen(steps)))
    found = step_set(frames, shifts(steps), [None, *frames])
    assert found is not None
    assert found.share > 0.2
    assert not found.even
    if wrong is not swapped:
        assert (found.frame, found.repeats) == (2, True)


def test_the_deviation_of_a_late_frame_is_what_the_fit_leaves_of_it() -> None:
    """N = 4: the difference of two steps has amplitude sqrt(2) B, a quarter of it is left in each frame: B/4 rms."""
    found = step_set(samples(late(steps_seen(4, noise=0.2))), shifts(4))
    assert found is not None
    assert found.share == pytest.approx(0.25, rel=0.25)


@pytest.mark.parametrize("steps", [5, 8])
@pytest.mark.parametrize("lit", [0, 2])
def test_one_lit_frame_among_dark_ones_is_no_bent_response(steps: int, lit: int) -> None:
    """It has all harmonics, the same all over the picture: as a response would, but stronger than any."""
    dull = [seen(np.zeros(SHAPE), seed=k) for k in range(steps)]
    dull[lit] = seen(fringe(lit, steps), seed=50)
    found = step_set(samples(dull), shifts(steps))
    assert found is not None
    assert found.share > 0.2


@pytest.mark.parametrize("steps", [5, 8])
def test_light_is_told_from_a_pattern(steps: int) -> None:
    grays = steps_seen(steps)
    brighter = np.clip(grays[2] + 20 * ALBEDO, 0, 255).astype(np.uint8)
    found = step_set(samples([*grays[:2], brighter, *grays[3:]]), shifts(steps))
    assert found is not None
    assert (found.frame, found.even) == (2, True)
    shown = step_set(samples(swapped(grays)), shifts(steps))
    assert shown is not None
    assert not shown.even


@pytest.mark.parametrize("gamma", [1.0, 2.2, 3.0])
def test_a_gray_field_that_shows_the_one_before_is_told_whatever_the_gamma(gamma: float) -> None:
    fields = fields_of()
    codes = [48.0, 64.0, 96.0, 160.0, 224.0]
    grays = samples([seen(np.full(SHAPE, (c / 255) ** gamma), seed=int(c)) for c in codes])
    again = samples([seen(np.full(SHAPE, (c / 255) ** gamma), seed=7) for c in codes])
    for n in range(1, len(codes)):
        pair = (codes[n], codes[n - 1])
        assert not is_unchanged(grays[n], grays[n - 1], pair, fields, 1.0)
        assert is_unchanged(again[n - 1], grays[n - 1], pair, fields, 1.0)
    assert not is_unchanged(again[0], grays[0], (0.0, 255.0), fields, 1.0), "cut off, some displays"


@pytest.mark.parametrize(("x_px", "y_px"), [(0.0, 0.0), (0.5, 0.0), (0.0, -0.4), (0.3, 0.2)])
@pytest.mark.parametrize("brighter", [0.0, 0.1])
def test_a_movement_is_found_whatever_the_light_does(
    x_px: float, y_px: float, brighter: float
) -> None:
    def scene(dx: float, dy: float) -> np.ndarray:
        x, y = X - dx, Y - dy
        return np.asarray(0.6 + 0.2 * np.sin(x / 5) + 0.2 * np.cos(y / 6 + x / 17))

    def exposed(light: float, dx: float, dy: float, room: float, seed: int) -> FrameSample:
        rng = np.random.default_rng(seed)
        gray = 8 + scene(dx, dy) * 150 * light + room * (5 + X / 20) + rng.normal(0, 1, SHAPE)
        return samples([np.clip(np.rint(gray), 0, 255).astype(np.uint8)])[0]

    first = Fields(exposed(1.0, 0, 0, 0, 1), exposed(0.0, 0, 0, 0, 2), 1.0)
    room = 10 * brighter
    white = exposed(1.0 - brighter, x_px, y_px, room, 3)
    moved = movement(first, white, exposed(0.0, x_px, y_px, room, 4))
    assert moved is not None
    assert (moved.x_px, moved.y_px) == pytest.approx((x_px, y_px), abs=0.06)
    assert moved.share < 0.02


def test_an_even_scene_doesnt_tell_of_movement() -> None:
    white, black = samples([np.full(SHAPE, g, np.uint8) for g in (150, 8)])
    assert movement(Fields(white, black, 1.0), white, None) is None


@pytest.mark.parametrize("gray", [0, 255])
def test_what_cant_be_judged_isnt(gray: int) -> None:
    dull = [np.full(SHAPE, gray, np.uint8)] * 4
    assert step_set(samples(dull), shifts(4)) is None
    assert same(samples([np.zeros(SHAPE, np.uint8)] * 2)) is None


def test_three_steps_are_compared_with_another_set() -> None:
    sets = [
        [seen(fringe(k, 3, periods=p), seed=10 * k + int(p)) for k in range(3)] for p in (9.0, 10.0)
    ]
    parts = [common_part(samples(grays), shifts(3)) for grays in sets]
    assert parts[0] is not None
    assert parts[1] is not None
    right = parts[1].against(parts[0])
    assert right is not None
    assert right.share < 0.02
    wrong = common_part(samples([sets[0][2], *sets[1][1:]]), shifts(3))
    assert wrong is not None
    found = wrong.against(parts[0], before=samples([sets[0][2]]))
    assert found is not None
    assert found.share > 0.2
    assert (found.frame, found.repeats) == (0, True)


def test_pairs_add_up_to_the_same() -> None:
    bits = [(X // width % 2).astype(np.float64) for width in (40, 20, 5)]
    pairs = [[seen(bit, seed=n), seen(1 - bit, seed=n + 50)] for n, bit in enumerate(bits)]
    parts = [pair_part(samples(pair)) for pair in pairs]
    for part in parts[1:]:
        found = part.against(parts[0])
        assert found is not None
        assert found.share < 0.03
    late_pair = pair_part(samples([pairs[0][1], pairs[1][0]]))
    found = late_pair.against(parts[0])
    assert found is not None
    assert found.share > 0.5


def fields_of(exposure: float = 1.0) -> Fields:
    white, black = samples([seen(np.ones(SHAPE), seed=1), seen(np.zeros(SHAPE), seed=2)])
    return Fields(white, black, exposure)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_marker_has_the_light_that_it_was_given(share: float) -> None:
    bright = samples([seen(np.ones(SHAPE), seed=3)])
    marker = samples([seen(np.full(SHAPE, share), seed=4)])[0]
    found = marker_light(marker, bright, fields_of(), 1.0)
    assert found == pytest.approx(share, abs=0.01)


def test_the_black_level_needs_not_be_known() -> None:
    """At a tenth of the exposure a black field reads its black level still: no light for that."""
    bright = samples([seen(np.full(SHAPE, 0.1), seed=3)])
    marker = samples([seen(np.full(SHAPE, 0.0), seed=4)])[0]
    found = marker_light(marker, bright, fields_of(), 0.1)
    assert found is not None
    assert found < 0.03


def test_noise_isnt_light() -> None:
    white, black = samples([seen(np.zeros(SHAPE), noise=20.0, seed=n) for n in (1, 2)])
    assert not Fields(white, black, 1.0).seen


def test_drift_is_a_share_of_the_light() -> None:
    first, last = samples([seen(np.ones(SHAPE), seed=5), seen(np.full(SHAPE, 0.95), seed=6)])
    change = drift(first, last, fields_of())
    assert change == pytest.approx(-0.05, abs=0.003)
