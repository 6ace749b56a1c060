"""What the rig's page works out for itself: the exposure to try next, how sharp a picture is, who didn't answer."""

import numpy as np
import pytest

from app.exposing import advised
from app.panels.rig_devices import found_html
from app.views.sharpness import SharpnessAid
from backend.contract.rigs import Discovery, FoundCameraView

SCENE = np.random.default_rng(4).uniform(0.05, 1.0, 20_000)
PERIODS_MS = tuple(16.6667 * k for k in range(1, 61))


def histogram(gray_per_ms: float, exposure_ms: float) -> list[int]:
    """Return what a camera counts of the scene: black level 4, full scale 255."""
    gray = np.clip(np.rint(4 + gray_per_ms * exposure_ms * SCENE), 0, 255)
    return [int(count) for count in np.bincount(gray.astype(int), minlength=256)]


@pytest.mark.parametrize("first_ms", [16.6667, 333.0, 1000.0], ids=["short", "long", "longest"])
@pytest.mark.parametrize("gray_per_ms", [0.25, 0.7, 3.0, 11.0])
def test_an_exposure_is_found_from_wherever_it_starts(gray_per_ms: float, first_ms: float) -> None:
    exposure_ms = first_ms
    for _ in range(8):
        advice = advised([histogram(gray_per_ms, exposure_ms)], exposure_ms, PERIODS_MS)
        if np.isclose(advice.exposure_ms, exposure_ms, rtol=0.05):
            break
        exposure_ms = advice.exposure_ms
    found = histogram(gray_per_ms, exposure_ms)
    brightest = max(level for level, count in enumerate(found) if count)

    assert advice.remark == ""
    assert sum(found[254:]) == 0
    assert brightest > 180 or exposure_ms == PERIODS_MS[0]


def test_the_brightest_camera_decides() -> None:
    bright, dim = histogram(5.0, 16.6667), histogram(1.0, 16.6667)

    assert advised([dim, bright], 16.6667, PERIODS_MS) == advised([bright], 16.6667, PERIODS_MS)


def test_what_no_exposure_can_mend_is_said() -> None:
    assert "close the iris" in advised([histogram(99.0, 16.6667)], 16.6667, PERIODS_MS).remark
    assert "open the iris" in advised([histogram(0.01, 1000.0)], PERIODS_MS[-1], PERIODS_MS).remark


def test_sharpness_is_told_against_the_best_so_far() -> None:
    aid = SharpnessAid()
    assert (aid.share, "looking" in aid.html()) == (None, True)
    for number, sharpness in enumerate((0.1, 0.2, 0.4, 0.4, 0.4, 9.0, 0.4)):
        aid.note(number, sharpness)
        aid.note(number, sharpness)  # looked at twice
    assert aid.share == 1.0, "a single picture is no best"
    for number in range(10, 13):
        aid.note(number, 0.2)
    assert aid.share == pytest.approx(0.5)
    aid.note(13, 5.0, saturated_share=0.2)
    assert "too bright to tell" in aid.html()
    for number in range(14, 17):
        aid.note(number, 0.4)
    assert aid.share == 1.0, "what was cut off is no best"
    aid.forget_best()
    assert aid.share is None


def test_addresses_without_an_answer_are_named() -> None:
    camera = FoundCameraView(
        driver="aravis", rig_line="{driver: aravis}", vendor="", model="", serial="7",
        address="10.0.0.2", controlled_by=None, used_in=(),
    )  # fmt: skip
    silent = "no camera answers at 10.0.0.3; check cable, power and the address."
    html = found_html(Discovery(cameras=(camera,), problems=(silent,)))

    assert silent in html
    assert silent in found_html(Discovery(cameras=(), problems=(silent,)))
    assert "No camera answered." in found_html(Discovery(cameras=()))
