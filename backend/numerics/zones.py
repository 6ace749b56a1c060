"""Brightness zones: peaks and valleys of a scene's gray-level histogram."""

from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Integer
from numpy.polynomial import Polynomial

from backend.numerics.errors import ZoneError
from backend.numerics.histogram import foreground_range, smoothed

FitKind = Literal["gaussian", "polynomial"]

_VALLEY_STEP = 1.0 / 32.0
"""Resolution of valleys and polynomial peaks, in histogram bins."""
_POLYNOMIAL_DEGREE = 6


class ZoneSettings(NamedTuple):
    """How a histogram is split; gray levels are those of an 8-bit camera."""

    sigma_gray: float = 3.5
    """Smoothing of the histogram before anything else. 0 means none."""
    gap_gray: float = 8.0
    """C: kept levels further apart than this start a new group."""
    floor_share: float = 0.05
    """Share of the highest count that is added to the average (equation 15)."""
    fit: FitKind = "gaussian"
    """Curve through each group."""
    valley_depth: float = 0.25
    """A dip by this share of the lower neighbour splits a group. 1 means never."""
    share_min: float = 0.01
    """Gray levels below the filter are searched again if they hold this share of pixels. 1 means never."""
    peak_ratio_min: float = 1.6
    """Zones whose peaks differ by a smaller factor are merged: one exposure serves both. 1 means never."""


class ZoneFit(NamedTuple):
    """Zones of a histogram, darkest first."""

    peaks_gray: Float[np.ndarray, "zone"]
    """Maximum of each zone's fitted curve, not rounded."""
    sigmas_gray: Float[np.ndarray, "zone"]
    """Width of each zone's Gaussian."""
    valleys_gray: Float[np.ndarray, "valley"]
    """First foreground gray, the minima between neighbours, last foreground gray."""
    shares: Float[np.ndarray, "zone"]
    """Share of the foreground pixels; zone i is valley i < gray <= valley i + 1, the lowest includes its lower end."""
    histogram: Float[np.ndarray, "gray"]
    """Smoothed counts."""
    curve: Float[np.ndarray, "gray"]
    """Fitted curve to draw over the histogram: the maximum of the zones' curves."""


class _Curve(NamedTuple):
    """One group's fitted curve over first..last."""

    first: int
    last: int
    peak: float
    sigma: float
    height: float
    polynomial: Polynomial | None

    def at(self, gray: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        if self.polynomial is None:
            return self.height * np.exp(-0.5 * ((gray - self.peak) / self.sigma) ** 2)
        inside = (gray >= self.first) & (gray <= self.last)
        values = self.polynomial(np.clip(gray, self.first, self.last))
        return np.where(inside, np.maximum(values, 0.0), 0.0)


_Group = tuple[int, int]
_DEFAULTS = ZoneSettings()


def find_zones(
    counts: Float[np.ndarray, "gray"],
    settings: ZoneSettings = _DEFAULTS,
    *,
    black_gray: float = 0.0,
) -> ZoneFit:
    r"""Split a scene's gray levels into zones that one exposure each can serve.

    Parameters
    ----------
    counts
        Foreground pixels per gray level 0..full scale, any bit depth.
    settings
        Smoothing, thresholds and curve.
    black_gray
        Black level in [gray of this histogram]; brightness ratios of peaks count from here.

    Returns
    -------
    The zones, darkest first; gray levels in the histogram's own units, float64.

    Raises
    ------
    HistogramError
        If the histogram is empty or holds one gray level only.

    Notes
    -----
    Filtration, segmentation and fitting follow [1]_, section D: levels are kept where
    the smoothed count exceeds

    .. math:: V = \operatorname{avg}(h) + 0.05 \max(h)

    (equation 15), a step above C starts a group, and an isolated last level is dropped.
    Each group gets a Gaussian by least squares on :math:`\ln h`, weighted with
    :math:`h^2` [2]_, or a polynomial.

    Three things go beyond the paper, as a scene's peaks differ in width by ten times:
    a group is split at a clear dip (two materials above V); what lies outside all groups
    but holds `share_min` of the pixels is filtered once more by its own average (a wide or
    dark zone isn't lost because a flat bright surface makes a spike); neighbours
    closer than `peak_ratio_min` are merged.

    References
    ----------
    .. [1] "High dynamic range saturation intelligence avoidance for three-dimensional
       shape measurement" (HDRSIA), section III D.
    .. [2] H. Guo, "A simple algorithm for fitting a Gaussian function", IEEE Signal
       Processing Magazine 28(5), 134 (2011), doi:10.1109/MSP.2011.941846.
    """
    first, last = foreground_range(counts)
    histogram = smoothed(counts, sigma_gray=settings.sigma_gray)
    groups = _all_groups(histogram, counts, first, last, settings)
    curves = [_fit(histogram, group, settings.fit) for group in groups]
    curves = _merged(histogram, curves, settings, black_gray)
    inner = [_valley(a, b, histogram) for a, b in pairwise(curves)]
    valleys = np.array([float(first), *inner, float(last)])
    return _zone_fit(counts, histogram, curves, valleys)


def zones_from_valleys(
    counts: Float[np.ndarray, "gray"],
    valleys_gray: Float[np.ndarray, "valley"],
    settings: ZoneSettings = _DEFAULTS,
) -> ZoneFit:
    """Fit the zones between valleys that an operator has set.

    Parameters
    ----------
    counts
        Foreground pixels per gray level 0..full scale.
    valleys_gray
        Both ends and every border between two zones in [gray], increasing.
    settings
        Smoothing and curve; the thresholds aren't used.

    Returns
    -------
    The zones with exactly these valleys.

    Raises
    ------
    HistogramError
        If the histogram is empty or holds one gray level only.
    ZoneError
        If fewer than two valleys are given, they don't increase, are outside of the
        histogram, or a zone between them holds no pixel.
    """
    foreground_range(counts)
    _check_valleys(valleys_gray, counts.size - 1)
    shares = zone_shares(counts, valleys_gray)
    if not shares.all():
        empty = int(np.flatnonzero(shares == 0)[0])
        raise ZoneError(
            f"no pixel lies in zone {empty + 1} ({valleys_gray[empty]:.1f} to"
            f" {valleys_gray[empty + 1]:.1f} gray); move its valleys apart or remove one"
        )
    histogram = smoothed(counts, sigma_gray=settings.sigma_gray)
    curves = [
        _fit(
            histogram,
            (int(np.ceil(low)), max(int(np.floor(high)), int(np.ceil(low)))),
            settings.fit,
        )
        for low, high in pairwise(valleys_gray)
    ]
    return _zone_fit(counts, histogram, curves, valleys_gray.astype(np.float64))


def zone_shares(
    counts: Float[np.ndarray, "gray"], valleys_gray: Float[np.ndarray, "valley"]
) -> Float[np.ndarray, "zone"]:
    """Return the share of foreground pixels in each zone.

    Zone i holds valley i < gray <= valley i + 1, the lowest also its lower end.
    """
    cumulative = np.concatenate([[0.0], np.cumsum(counts)])
    upper = np.clip(np.floor(valleys_gray).astype(np.int64) + 1, 0, counts.size)
    upper[0] = np.clip(int(np.ceil(valleys_gray[0])), 0, counts.size)
    return np.asarray(np.diff(cumulative[upper]) / max(cumulative[-1], 1.0))


def _check_valleys(valleys_gray: Float[np.ndarray, "valley"], full_scale: int) -> None:
    listed = ", ".join(f"{v:g}" for v in valleys_gray)
    if valleys_gray.size < 2:
        raise ZoneError(f"valleys ({listed}) don't enclose a zone; give at least both ends")
    if not (np.isfinite(valleys_gray).all() and (np.diff(valleys_gray) > 0).all()):
        raise ZoneError(f"valleys ({listed}) don't increase; give them from dark to bright")
    if valleys_gray[0] < 0 or valleys_gray[-1] > full_scale:
        raise ZoneError(f"valleys ({listed}) leave 0..{full_scale} gray; keep them inside")


def _zone_fit(
    counts: Float[np.ndarray, "gray"],
    histogram: Float[np.ndarray, "gray"],
    curves: list[_Curve],
    valleys_gray: Float[np.ndarray, "valley"],
) -> ZoneFit:
    gray = np.arange(counts.size, dtype=np.float64)
    return ZoneFit(
        peaks_gray=np.array([c.peak for c in curves]),
        sigmas_gray=np.array([c.sigma for c in curves]),
        valleys_gray=valleys_gray,
        shares=zone_shares(counts, valleys_gray),
        histogram=histogram,
        curve=np.max([c.at(gray) for c in curves], axis=0),
    )


# ---------------------------------------------------------------- filtration and segmentation


def _all_groups(
    histogram: Float[np.ndarray, "gray"],
    counts: Float[np.ndarray, "gray"],
    first: int,
    last: int,
    settings: ZoneSettings,
) -> list[_Group]:
    groups = _kept_groups(histogram, (0, histogram.size - 1), settings)
    groups = [part for group in groups for part in _split(histogram, group, settings.valley_depth)]
    found: list[_Group] = groups
    while found:
        found = _overlooked(histogram, counts, groups, (first, last), settings)
        groups = sorted(groups + found)
    return groups


def _kept_groups(
    histogram: Float[np.ndarray, "gray"], span: _Group, settings: ZoneSettings
) -> list[_Group]:
    """Filter and segment the levels of a span, ends included."""
    part = histogram[span[0] : span[1] + 1]
    # A histogram with equal counts everywhere has nothing above V: then all levels are one group.
    valid = min(part.mean() + settings.floor_share * part.max(), 0.999 * part.max())
    return _segments(np.flatnonzero(part > valid) + span[0], settings.gap_gray * _scale(histogram))


def _segments(levels: Integer[np.ndarray, "n"], gap: float) -> list[_Group]:
    starts = np.flatnonzero(np.diff(levels) > gap) + 1
    groups = [(int(part[0]), int(part[-1])) for part in np.split(levels, starts)]
    isolated_last = len(groups) > 1 and groups[-1][0] == groups[-1][1]
    return groups[:-1] if isolated_last else groups


def _split(histogram: Float[np.ndarray, "gray"], group: _Group, depth: float) -> list[_Group]:
    """Cut a group at its deepest clear dip, and the parts again."""
    part = histogram[group[0] : group[1] + 1]
    lower_peak = np.minimum(np.maximum.accumulate(part), np.maximum.accumulate(part[::-1])[::-1])
    dip = 1.0 - part / np.maximum(lower_peak, np.finfo(np.float64).tiny)
    cut = int(np.argmax(dip))
    if depth >= 1 or dip[cut] < depth:
        return [group]
    left, right = (group[0], group[0] + cut - 1), (group[0] + cut, group[1])
    return _split(histogram, left, depth) + _split(histogram, right, depth)


def _overlooked(
    histogram: Float[np.ndarray, "gray"],
    counts: Float[np.ndarray, "gray"],
    groups: list[_Group],
    ends: _Group,
    settings: ZoneSettings,
) -> list[_Group]:
    """Find groups among the levels that the filter has discarded."""
    borders = [ends[0] - 1, *(edge for group in groups for edge in group), ends[1] + 1]
    found: list[_Group] = []
    for left, right in zip(borders[::2], borders[1::2], strict=True):
        span = (left + 1, right - 1)
        if span[1] - span[0] < 2 or not _has_share(counts, span, settings.share_min):
            continue
        candidates = [
            part
            for group in _kept_groups(histogram, span, settings)
            for part in _split(histogram, group, settings.valley_depth)
        ]
        found += [c for c in candidates if _stands_alone(histogram, counts, c, span, settings)]
    return found


def _has_share(counts: Float[np.ndarray, "gray"], span: _Group, share: float) -> bool:
    return bool(share < 1 and counts[span[0] : span[1] + 1].sum() >= share * counts.sum())


def _stands_alone(
    histogram: Float[np.ndarray, "gray"],
    counts: Float[np.ndarray, "gray"],
    group: _Group,
    span: _Group,
    settings: ZoneSettings,
) -> bool:
    """Tell a hill of its own from the foot of a neighbour."""
    peak = group[0] + int(np.argmax(histogram[group[0] : group[1] + 1]))
    dip = (1.0 - settings.valley_depth) * histogram[peak]
    falls_left = histogram[max(span[0] - 1, 0) : peak + 1].min() <= dip or span[0] == 0
    falls_right = histogram[peak : span[1] + 2].min() <= dip
    # What exceeds the filter is the upper part of the hill only: half the share is enough.
    share = settings.share_min / 2
    return bool(falls_left and falls_right and _has_share(counts, group, share))


def _scale(histogram: Float[np.ndarray, "gray"]) -> float:
    """Histogram bins per gray level of an 8-bit camera."""
    return (histogram.size - 1) / 255.0


# ---------------------------------------------------------------- fitting


def _fit(histogram: Float[np.ndarray, "gray"], group: _Group, kind: FitKind) -> _Curve:
    if kind == "polynomial" and group[1] - group[0] >= 2:
        return _polynomial(histogram, group)
    return _gaussian(histogram, group)


def _gaussian(histogram: Float[np.ndarray, "gray"], group: _Group) -> _Curve:
    """Fit ln h = a + b x + c x^2 with weights h^2; fall back on moments if it isn't a hill."""
    gray = np.arange(group[0], group[1] + 1, dtype=np.float64)
    height = histogram[group[0] : group[1] + 1]
    used = height > 1e-6 * max(height.max(), np.finfo(np.float64).tiny)
    gray, height = gray[used], height[used]
    if gray.size == 0:
        return _Curve(*group, 0.5 * (group[0] + group[1]), 1.0, 0.0, None)
    centre, span = gray.mean(), max(float(np.ptp(gray)) / 2, 1.0)
    if gray.size >= 3:
        # polyfit's weights multiply the residuals: sqrt of h^2
        c, b, a = np.polyfit((gray - centre) / span, np.log(height), 2, w=height / height.max())
        peak = centre - span * b / (2 * c) if c < 0 else np.nan
        if group[0] - 1 <= peak <= group[1] + 1:
            top = float(np.exp(a - b * b / (4 * c)))
            return _Curve(*group, float(peak), float(span / np.sqrt(-2 * c)), top, None)
    return _moments(gray, height, group)


def _moments(gray: Float[np.ndarray, "n"], height: Float[np.ndarray, "n"], group: _Group) -> _Curve:
    """Describe a group that is no hill by its highest level and its spread about it."""
    peak = float(gray[np.argmax(height)])
    sigma = float(np.sqrt(np.average((gray - peak) ** 2, weights=height)))
    return _Curve(*group, peak, max(sigma, 0.5), float(height.max()), None)


def _polynomial(histogram: Float[np.ndarray, "gray"], group: _Group) -> _Curve:
    gray = np.arange(group[0], group[1] + 1, dtype=np.float64)
    height = histogram[group[0] : group[1] + 1]
    fit = Polynomial.fit(gray, height, min(_POLYNOMIAL_DEGREE, gray.size - 1))
    fine = np.arange(group[0], group[1] + _VALLEY_STEP / 2, _VALLEY_STEP)
    values = fit(fine)
    width = _moments(gray, np.maximum(height, np.finfo(np.float64).tiny), group).sigma
    best = int(np.argmax(values))
    return _Curve(*group, float(fine[best]), width, float(values[best]), fit)


def _merged(
    histogram: Float[np.ndarray, "gray"],
    curves: list[_Curve],
    settings: ZoneSettings,
    black_gray: float,
) -> list[_Curve]:
    """Merge the closest neighbours until all peaks are a clear factor apart."""
    curves = sorted(curves, key=lambda c: c.peak)
    while len(curves) > 1:
        signal = np.maximum(np.array([c.peak for c in curves]) - black_gray, 0.5)
        ratios = signal[1:] / signal[:-1]
        closest = int(np.argmin(ratios))
        if ratios[closest] >= settings.peak_ratio_min:
            return curves
        low, high = curves[closest : closest + 2]
        group = (min(low.first, high.first), max(low.last, high.last))
        curves[closest : closest + 2] = [_fit(histogram, group, settings.fit)]
        curves.sort(key=lambda c: c.peak)
    return curves


def _valley(low: _Curve, high: _Curve, histogram: Float[np.ndarray, "gray"]) -> float:
    """Return the minimum of the two curves' maximum between their peaks."""
    step = _VALLEY_STEP * max(_scale(histogram), 1.0)
    gray = np.arange(low.peak, high.peak, step)[1:]
    if gray.size == 0:
        return 0.5 * (low.peak + high.peak)
    values = np.maximum(low.at(gray), high.at(gray))
    lowest = np.flatnonzero(values <= values.min() * (1 + 1e-12))
    valley = float(gray[lowest].mean())
    if 0 < lowest[0] and lowest[-1] < gray.size - 1:
        return valley
    # One wide curve covers the other's peak: the histogram itself says where the dip is.
    first, last = int(np.ceil(low.peak)), int(np.floor(high.peak))
    return float(first + np.argmin(histogram[first : last + 1])) if last > first else valley
