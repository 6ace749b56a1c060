"""One code from two looks: a camera whose pixels get light from two places and that didn't look again is doubted."""

import numpy as np
import pytest

from backend.numerics.second_look import pulled_sigma
from backend.stages.edges import Codes
from backend.stages.joined_codes import joined_codes
from backend.stages.second_look import LABELS, SecondLook

SHAPE = (2, 3)
SECOND_LIGHT, TOLD_NOW = (
    next(n for n, text in LABELS.items() if word in text) for word in ("much of", "told by")
)


def maps(left: float, right: float) -> dict[str, np.ndarray]:
    return {
        name: np.full(SHAPE, value, np.float32)
        for name, value in (("left", left), ("right", right))
    }


def codes_of(columns: dict[str, np.ndarray], sigma_px: dict[str, np.ndarray]) -> Codes:
    return Codes(
        projector_px=columns,
        projector_row_px={name: np.zeros_like(m) for name, m in columns.items()},
        contrast_gray={name: np.full(SHAPE, 50, np.uint16) for name in columns},
        brightness={name: np.full(SHAPE, 100, np.float32) for name in columns},
        reasons={name: np.zeros(SHAPE, np.uint16) for name in columns},
        valid_share=1.0,
        weak_bits_used=0,
        codes=256,
        sigma_px=sigma_px,
        widening_px={name: np.zeros_like(m) for name, m in columns.items()},
    )


def second_look_of(second_codes: Codes | None) -> SecondLook:
    """Mark the same pixel of both cameras; the reference camera's is told by the second look."""
    marked = {"left": np.zeros(SHAPE, np.uint8), "right": np.zeros(SHAPE, np.uint8)}
    share = maps(0.0, np.nan)
    told = np.zeros(SHAPE, bool)
    told[0, 1] = True
    marked["left"][0, 1], marked["right"][0, 1] = TOLD_NOW, SECOND_LIGHT
    share["left"][0, 1] = share["right"][0, 1] = 0.5
    trusted = {} if second_codes is None else {"left": told}
    return SecondLook(marked, share, 0.1, 0.0, codes=second_codes, trusted=trusted)


def test_the_second_look_counts_and_a_camera_without_one_is_doubted() -> None:
    first = codes_of(maps(10.0, 20.0), maps(0.02, 0.02))
    again = codes_of({"left": maps(11.0, 0.0)["left"]}, {"left": maps(0.03, 0.0)["left"]})
    joined = joined_codes(first, second_look_of(again))
    assert joined.projector_px["left"][0].tolist() == [10.0, 11.0, 10.0]
    assert joined.sigma_px["left"][0, 1] == pytest.approx(0.03)
    # Half of the light from elsewhere may pull an edge by more than half a pixel.
    assert joined.sigma_px["right"][0, 1] > 0.5
    untouched = np.ones(SHAPE, bool)
    untouched[0, 1] = False
    for name in ("left", "right"):
        assert (joined.sigma_px[name][untouched] == np.float32(0.02)).all()
    # The doubted code stays: it fills in what the other camera can't see.
    assert (joined.projector_px["right"] == first.projector_px["right"]).all()
    assert (first.sigma_px["right"] == np.float32(0.02)).all()


def test_without_a_second_look_marked_pixels_of_both_cameras_are_doubted() -> None:
    first = codes_of(maps(10.0, 20.0), maps(0.02, 0.02))
    joined = joined_codes(first, second_look_of(None))
    assert joined.sigma_px["left"][0, 1] == joined.sigma_px["right"][0, 1] > 0.5
    assert (joined.projector_px["left"] == 10.0).all()


def test_more_light_from_elsewhere_is_never_less_doubt() -> None:
    share = np.linspace(0, 1, 21, dtype=np.float32)[None]
    sigma = np.full_like(share, 0.04)
    found = pulled_sigma(sigma, share, share > 0.06)
    assert (np.diff(found) >= 0).all()
    assert (found[share <= 0.06] == np.float32(0.04)).all()
    assert (pulled_sigma(sigma, np.full_like(share, np.nan), share >= 0) == sigma).all()
