import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backend.numerics.errors import HistogramError, ZoneError
from backend.numerics.zones import ZoneSettings, find_zones, zone_shares, zones_from_valleys


def counted(gray: np.ndarray, full_scale: int = 255, background: int = 3) -> np.ndarray:
    gray = np.clip(np.round(gray * full_scale / 255), 0, full_scale).astype(int)
    counts = np.bincount(gray, minlength=full_scale + 1).astype(float)
    counts[: background * full_scale // 255] = 0
    return counts


def hill(rng: np.random.Generator, peak: float, sigma: float, pixels: float) -> np.ndarray:
    return rng.normal(peak, sigma, int(pixels))


def high_contrast(
    seed: int, *, plaster: int = 200_000, blocks: int = 60_000, book: int = 100_000, flat: int = 0
) -> np.ndarray:
    """A shaded bright body (triangular histogram), some blocks' faces, a dark cover, a flat bright wall."""
    rng = np.random.default_rng(seed)
    body = 230 * np.sqrt(1 - rng.uniform(0, 0.9, plaster))
    faces = [hill(rng, m, rng.uniform(1.5, 6), blocks // 4) for m in rng.uniform(70, 105, 4)]
    cover = hill(rng, 13, rng.uniform(0.8, 3), book)
    return np.asarray(np.concatenate([body, *faces, cover, hill(rng, 222, 1.5, flat)]) + 2)


@pytest.mark.parametrize("full_scale", [255, 4095])
@pytest.mark.parametrize("fit", ["gaussian", "polynomial"])
def test_peaks_of_clean_hills_are_not_rounded(full_scale, fit):
    gray = np.arange(full_scale + 1) * 255 / full_scale
    hills = [(29.3, 5, 1.0), (123.4, 9, 0.8), (217.6, 6, 1.2)]
    counts = 1e5 * sum(h * np.exp(-0.5 * ((gray - p) / s) ** 2) for p, s, h in hills)
    counts[counts < 1] = 0
    zones = find_zones(counts, ZoneSettings(fit=fit))
    tolerance = 0.05 if fit == "gaussian" else 0.5
    assert zones.peaks_gray * 255 / full_scale == pytest.approx([29.3, 123.4, 217.6], abs=tolerance)
    assert zones.shares.sum() == pytest.approx(1)


def test_valley_is_the_crossing_of_the_two_hills():
    gray = np.arange(256.0)
    counts = 1e4 * (np.exp(-0.5 * ((gray - 60) / 8) ** 2) + np.exp(-0.5 * ((gray - 180) / 8) ** 2))
    zones = find_zones(np.where(counts < 1e-3, 0, counts))
    assert zones.valleys_gray[1] == pytest.approx(120, abs=0.1)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("flat", [0, 300_000])
@pytest.mark.parametrize("full_scale", [255, 4095])
def test_three_zones_on_high_contrast_scenes_without_touching_a_setting(seed, flat, full_scale):
    gray = high_contrast(seed, plaster=200_000 if flat == 0 else 60_000, flat=flat)
    zones = find_zones(counted(gray, full_scale))
    peaks = zones.peaks_gray * 255 / full_scale
    assert peaks.size == 3, peaks
    assert peaks[0] == pytest.approx(15, abs=2)
    assert 65 < peaks[1] < 120
    assert 200 < peaks[2] < 232


@pytest.mark.parametrize("seed", range(4))
def test_two_or_three_zones_on_metal(seed):
    rng = np.random.default_rng(seed)
    glare = rng.uniform(30, 254, 60_000)
    gray = np.concatenate([hill(rng, 17, 5, 2e5), hill(rng, 238, 8, 15_000), glare])
    zones = find_zones(counted(gray))
    assert zones.peaks_gray.size in (2, 3)
    assert zones.peaks_gray[0] == pytest.approx(17, abs=2)


@given(
    seed=st.integers(0, 1000),
    dark=st.floats(0.03, 0.6),
    middle=st.floats(0.05, 0.6),
    widths=st.tuples(st.floats(1, 4), st.floats(4, 14), st.floats(1, 12)),
)
@settings(max_examples=40, deadline=None)
def test_a_low_dark_hill_does_not_vanish_beside_a_spike(seed, dark, middle, widths):
    rng = np.random.default_rng(seed)
    parts = [(13, dark), (90, middle), (220, 1.0)]
    gray = np.concatenate(
        [hill(rng, p, w, 2e5 * n) for (p, n), w in zip(parts, widths, strict=True)]
    )
    zones = find_zones(counted(gray + 2))
    assert zones.peaks_gray == pytest.approx([15, 92, 222], abs=3)
    assert (np.diff(zones.valleys_gray) > 0).all()


def test_the_paper_alone_would_lose_the_dark_hill():
    """The extensions can be switched off, and then equation 15 discards what the test above finds."""
    rng = np.random.default_rng(0)
    gray = np.concatenate([hill(rng, 13, 4, 8e3), hill(rng, 90, 14, 2e4), hill(rng, 220, 1, 4e5)])
    paper = ZoneSettings(valley_depth=1, share_min=1, peak_ratio_min=1)
    assert find_zones(counted(gray), paper).peaks_gray.size == 1
    assert find_zones(counted(gray)).peaks_gray.size == 3


def test_shares_count_the_lower_end_and_each_valley_once():
    counts = np.zeros(256)
    counts[[10, 50, 51, 90]] = [1, 2, 3, 4]
    assert zone_shares(counts, np.array([10.0, 50.0, 90.0])) == pytest.approx([0.3, 0.7])


def test_given_valleys_are_kept():
    counts = counted(high_contrast(1))
    valleys = np.array([6.0, 60.0, 150.0, 240.0])
    zones = zones_from_valleys(counts, valleys)
    assert zones.valleys_gray.tolist() == valleys.tolist()
    assert zones.peaks_gray.size == 3
    assert ((zones.peaks_gray >= valleys[:-1] - 1) & (zones.peaks_gray <= valleys[1:] + 1)).all()
    assert zones.curve.shape == counts.shape


@pytest.mark.parametrize(
    ("valleys", "message"),
    [
        ([10.0], "at least both ends"),
        ([10.0, 60.0, 60.0], "don't increase"),
        ([10.0, np.nan], "don't increase"),
        ([10.0, 260.0], "keep them inside"),
        ([6.0, 240.0, 245.0, 250.0], "no pixel lies in zone 2"),
    ],
)
def test_impossible_valleys_are_refused(valleys, message):
    with pytest.raises(ZoneError, match=message):
        zones_from_valleys(counted(high_contrast(1)), np.array(valleys))


@pytest.mark.parametrize(("levels", "message"), [([], "is empty"), ([90], "same gray level 90")])
def test_scene_without_contrast_is_refused(levels, message):
    counts = np.zeros(256)
    counts[levels] = 100
    with pytest.raises(HistogramError, match=message):
        find_zones(counts)


@given(
    st.lists(st.integers(3, 255), min_size=2, max_size=300),
    st.sampled_from(["gaussian", "polynomial"]),
)
@settings(max_examples=100, deadline=None)
def test_any_histogram_of_two_levels_or_more_has_ordered_zones(levels, fit):
    counts = np.bincount(levels, minlength=256).astype(float)
    if np.count_nonzero(counts) < 2:
        return
    zones = find_zones(counts, ZoneSettings(fit=fit))
    ordered = np.concatenate([[zones.valleys_gray[0]], zones.valleys_gray[1:]])
    assert (np.diff(ordered) >= 0).all()
    assert (np.diff(zones.peaks_gray) > 0).all()
    assert zones.shares.sum() == pytest.approx(1)
    assert np.isfinite(zones.curve).all()
