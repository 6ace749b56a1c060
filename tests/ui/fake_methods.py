"""Two measuring methods that exist only in tests: one like `hdr-fringe`, one with odd names and every kind of view.

Each stage is a settings model and a function from settings to (sentence, checks, fields). The second method
proves that the user interface knows no stage by name and escapes whatever it shows.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from backend.domain.arrays import ArrayHash
from backend.domain.params import Params, setting
from tests.ui.fake_scene import CAMERAS, EXPOSURES_MS, PERIODS, Array, scene

EVIL = '<img src=x onerror="document.title=1">'
"""A name that becomes an element wherever somebody forgot to escape it."""


@dataclass(frozen=True)
class FakeField:
    """One field of a result: a hint and a value, one array, or arrays per camera."""

    name: str
    hint: dict[str, Any]
    value: Any = None
    arrays: Mapping[str, Array] = field(default_factory=dict)
    frames: tuple[dict[str, Any], ...] = ()
    per_camera: bool = False


@dataclass(frozen=True)
class FakeResult:
    """What a stage made."""

    sentence: str
    fields: tuple[FakeField, ...]
    checks: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class FakeStage:
    """A stage that makes its result out of nothing."""

    name: str
    title: str
    doc: str
    params: type[Params]
    make: Callable[[dict[str, Any]], FakeResult]
    review: str = "on_warning"
    captures: bool = False


def _hint(kind: str, title: str, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "title": title, **more}


def _value(name: str, title: str, value: Any, unit: str = "", digits: int = 4) -> FakeField:
    return FakeField(name, _hint("value", title, unit=unit, digits=digits), value=value)


def _picture(name: str, title: str, make: Callable[[str], Array], **more: Any) -> FakeField:
    hint = {"unit": "", "colormap": "gray", "low": None, "high": None} | more
    return FakeField(
        name, _hint("picture", title, **hint), arrays={c: make(c) for c in CAMERAS}, per_camera=True
    )


def _mask(name: str, title: str, make: Callable[[str], Array], **more: Any) -> FakeField:
    hint = {"labels": {}, "bits": False, "edits": None} | more
    return FakeField(
        name, _hint("mask", title, **hint), arrays={c: make(c) for c in CAMERAS}, per_camera=True
    )


def _check(
    name: str, level: str, sentence: str, value: float, limit: float, unit: str = ""
) -> dict[str, Any]:
    return {
        "name": name,
        "level": level,
        "sentence": sentence,
        "value": value,
        "limit": limit,
        "unit": unit,
    }


def _histogram() -> Array:
    pooled = np.concatenate([scene().white(c, 41.7).ravel() for c in CAMERAS])
    counts = np.bincount(pooled, minlength=256).astype(np.float64)
    taps = np.exp(-0.5 * (np.arange(-12, 13) / 3.5) ** 2)
    return np.convolve(counts, taps / taps.sum(), mode="same")


# ---- the first method: as the real one


class Preview(Params):
    exposure_ms: float | None = setting(
        None, title="Preview exposure", unit="ms", auto="t_pre_ms", gt=0, le=60_000
    )
    """Exposure of the white field; automatic: the longest without saturation."""
    saturated_share: float = setting(
        1e-4, title="Saturated pixels allowed", ge=0, le=0.1, advanced=True
    )
    """Share of lit pixels that may be saturated."""
    snap: bool = setting(True, title="Whole projector frames", advanced=True)
    """Use multiples of the projector's frame period."""


def make_preview(settings: dict[str, Any]) -> FakeResult:
    t_pre_ms = settings["exposure_ms"] or 41.6667
    ladder = [
        {"exposure_ms": t, "saturated_share": s, "brightest_gray": g}
        for t, s, g in ((58.3333, 0.0123, 255.0), (50.0, 0.0009, 255.0), (t_pre_ms, 0.00002, 252.0))
    ]
    s = scene()
    return FakeResult(
        f"The white field saturates nothing at {t_pre_ms:.1f} ms",
        (
            _value("t_pre_ms", "Preview exposure", t_pre_ms, "ms"),
            _value("saturated_share", "Saturated", 0.00002),
            _value("foreground_share", "Lit share of the picture", 0.9431),
            FakeField("histogram", _hint("histogram", "Gray levels, lit pixels of all cameras", x_title="gray"), arrays={"": _histogram()}),
            _picture("white", "White field", lambda c: s.white(c, t_pre_ms), unit="gray"),
            _mask("foreground", "Lit pixels", lambda c: s.albedo(c) > 0.04, labels={"1": "lit"}),
            _picture("rate", "Brightness", lambda c: (5.6 * s.albedo(c)).astype(np.float32), unit="gray/ms", colormap="inferno"),
            FakeField("ladder", _hint("table", "Exposures tried"), value=ladder),
        ),
        (
            _check("lit share", "ok", "94.3% of the picture is lit by the projector", 0.9431, 0.02),
            _check("saturation", "ok", f"0.00% of the lit pixels are saturated at {t_pre_ms:.1f} ms", 0.00002, 0.0001),
        ),
    )  # fmt: skip


class Zones(Params):
    valleys_gray: tuple[float, ...] | None = setting(
        None, title="Zone borders", unit="gray", auto="valleys_gray", min_length=2, max_length=12
    )
    """Both ends and each border between two zones. Automatic: fitted."""
    sigma_gray: float = setting(3.5, title="Histogram smoothing", unit="gray", ge=0, le=20)
    """Standard deviation of the smoothing Gaussian."""
    gap_gray: float = setting(8.0, title="Gap between groups", unit="gray", gt=0, le=64)
    """A larger step starts a new zone."""
    fit: Literal["gaussian", "polynomial"] = setting("gaussian", title="Curve", advanced=True)
    """Curve fitted to each group."""


def make_zones(settings: dict[str, Any]) -> FakeResult:
    valleys = np.array(settings["valleys_gray"] or (9.0, 48.0, 117.0, 238.0))
    peaks = (valleys[:-1] + valleys[1:]) / 2
    counts = _histogram()
    gray = np.arange(256)
    fit = np.zeros(256)
    for low, high in itertools.pairwise(valleys):
        inside = np.where((gray > low) & (gray <= high), counts, 0.0)
        mean = float((inside * gray).sum() / max(inside.sum(), 1.0))
        sigma = float(np.sqrt((inside * (gray - mean) ** 2).sum() / max(inside.sum(), 1.0))) + 1.0
        fit = np.maximum(
            fit, inside.sum() / (sigma * 2.5) * np.exp(-0.5 * ((gray - mean) / sigma) ** 2)
        )
    s = scene()
    label = np.searchsorted(valleys[1:-1], gray) + 1
    rows = [
        {"zone": i + 1, "peak_gray": float(p), "from_gray": float(a), "to_gray": float(b), "share": float(counts[int(a) : int(b)].sum() / counts.sum())}
        for i, (p, a, b) in enumerate(zip(peaks, valleys[:-1], valleys[1:], strict=True))
    ]  # fmt: skip
    hint = _hint(
        "histogram",
        "Gray levels",
        fit="curve",
        valleys="valleys_gray",
        peaks="peaks_gray",
        edits="valleys_gray",
        x_title="gray",
    )
    return FakeResult(
        f"{len(peaks)} zones fitted. Check the borders, then accept.",
        (
            FakeField("histogram", hint, arrays={"": counts}),
            FakeField("curve", _hint("curve", "Fitted zones", x=None, x_title="gray", unit="", log_y=False), arrays={"": fit}),
            FakeField("table", _hint("table", "Zones"), value=rows),
            _value("zone_count", "Zones", len(peaks)),
            _mask("zone_map", "Zone of each pixel", lambda c: label[s.white(c, 41.7)].astype(np.uint8)),
        ),
        (_check("zones", "ok", f"{len(peaks)} zones fitted", len(peaks), 5),),
    )  # fmt: skip


class Exposures(Params):
    strategy: Literal["planned", "hdrsia", "manual"] = setting("planned", title="Strategy")
    """How exposures are chosen."""
    exposures_ms: tuple[float, ...] | None = setting(
        None, title="Exposures", unit="ms", auto="exposures_ms", max_length=8
    )
    """Automatic: planned for the measured brightness."""
    budget_s: float = setting(5.0, title="Time budget", unit="s", gt=0, le=600)
    """Light time of all frames."""
    frequencies: tuple[float, ...] = setting(
        (70.0, 64.0, 59.0), title="Fringe periods", unit="periods", min_length=1, max_length=6
    )
    """Periods over the projector's width."""
    steps: int = setting(4, title="Phase steps", ge=3, le=32, advanced=True)
    """Pictures per frequency."""


def make_exposures(settings: dict[str, Any]) -> FakeResult:
    exposures = settings["exposures_ms"] or EXPOSURES_MS
    rows = [
        {"exposure_ms": float(t), "served_share": s, "sigma_rad": g, "frames": 12}
        for t, s, g in zip(
            exposures, (0.31, 0.52, 0.17, 0.0), (0.021, 0.024, 0.039, 0.04), strict=False
        )
    ]
    levels = np.geomspace(0.02, 6.0, 80)
    noise = np.stack(
        [0.02 / np.sqrt(levels * t / 40.0) + 0.01 * (levels * t > 240) for t in exposures]
    )
    return FakeResult(
        f"{len(exposures)} exposures proposed: {' / '.join(f'{t:.1f}' for t in exposures)} ms",
        (
            FakeField("table", _hint("table", "Exposures", edits="exposures_ms"), value=rows),
            _value("coverage", "Predicted coverage", 0.9997),
            _value("sigma", "Predicted phase noise", 0.0264, "rad"),
            _value("time_s", "Capture time", 12 * sum(exposures) / 1000 * 1.4, "s"),
            FakeField("noise", _hint("curve", "Predicted phase noise", x="levels", x_title="brightness [gray/ms]", unit="rad", log_y=True), arrays={"": noise}),
            FakeField("levels", _hint("curve", "Brightness", x=None, x_title="", unit="gray/ms", log_y=False), arrays={"": levels}),
        ),
        (
            _check("coverage", "ok", "99.97% of the lit pixels are served by an exposure", 0.9997, 0.99),
            _check("noise", "warning", "Predicted phase noise of the darkest zone is 0.039 rad", 0.039, 0.035, "rad"),
        ),
    )  # fmt: skip


class Capture(Params):
    gain_db: float = setting(0.0, title="Camera gain", unit="dB", ge=0, le=48)
    """Analog gain of all cameras."""


def _fringes(camera: str, exposure_ms: float, periods: float, step: int) -> Array:
    s = scene()
    phase = 2 * np.pi * periods * s.code(camera) + step * np.pi / 2
    gray = 5.6 * exposure_ms * s.albedo(camera) * (0.51 + 0.36 * np.cos(phase)) + 4
    return np.clip(gray, 0, 255).astype(np.uint8)


def make_capture(settings: dict[str, Any]) -> FakeResult:
    frames = tuple(
        {
            "camera": c, "exposure_ms": t, "gain_db": settings["gain_db"], "role": "fringe", "bit_depth": 8,
            "pattern": {"kind": "sine", "axis": "x", "periods": PERIODS, "shift_rad": k * np.pi / 2},
            "image": _fringes(c, t, PERIODS, k),
        }
        for t in EXPOSURES_MS for k in range(2) for c in CAMERAS
    )  # fmt: skip
    return FakeResult(
        "72 frames captured",
        (
            FakeField("frames", _hint("frames", "Captured fringes"), frames=frames),
            _value("frame_count", "Frames", 72),
            _value("exposure_time_s", "Exposure time in all", 2.0, "s"),
        ),
        (_check("frames", "ok", "72 frames captured", 72, 72),),
    )


class Fusion(Params):
    strategy: Literal["weighted", "longest-unsaturated", "hdrsia"] = setting(
        "weighted", title="Strategy"
    )
    """How the exposures of a pixel are combined."""
    saturation_gray: float | None = setting(
        None, title="Saturated from", unit="gray", ge=1, le=4095
    )
    """Automatic: one below full scale."""


def make_fusion(settings: dict[str, Any]) -> FakeResult:
    s = scene()
    labels = {"1": "8.3 ms", "2": "33.3 ms", "3": "125 ms"}
    return FakeResult(
        "Every pixel is served by at least one exposure",
        (
            _mask("exposure_index", "Longest exposure used", s.exposure_index, labels=labels),
            _picture("mean", "Fused brightness", lambda c: (5.0 * s.albedo(c)).astype(np.float32), unit="gray/ms", colormap="inferno"),
            _value("saturated_share", "Saturated at every exposure", 0.0004),
            _value("served", "Served pixels", 0.9996),
        ),
        (_check("saturation", "ok", "0.04% of the lit pixels are saturated at every exposure", 0.0004, 0.01),),
    )  # fmt: skip


class Phase(Params):
    unwrapping: Literal["maximum-likelihood", "cascade", "gray-code"] = setting(
        "maximum-likelihood", title="Unwrapping"
    )
    """How the fringe orders are found."""
    modulation_min_gray: float = setting(
        4.0, title="Modulation at least", unit="gray", ge=0, le=255
    )
    """Pixels with less are left out."""
    residual_max: float = setting(0.02, title="Residual at most", unit="cycles", gt=0, le=0.5)
    """Distance to the nearest lattice point."""


REASONS = {"1": "modulation too low", "2": "saturated", "4": "residual too large"}


def make_phase(settings: dict[str, Any]) -> FakeResult:
    s = scene()
    return FakeResult(
        "Phase unwrapped for both cameras",
        (
            _picture("absolute", "Absolute phase", s.absolute_phase_rad, unit="rad", colormap="turbo"),
            _picture("wrapped", "Wrapped phase", s.wrapped_phase_rad, unit="rad", colormap="twilight", low=-np.pi, high=np.pi),
            _picture("modulation", "Modulation", s.modulation_gray, unit="gray", colormap="viridis"),
            _mask("reasons", "Why a pixel is missing", s.reasons, labels=REASONS, bits=True),
            _value("valid_share", "Valid pixels", 0.9871),
            _value("sigma", "Median phase noise", 0.0212, "rad"),
            FakeField("reasons_table", _hint("table", "Missing pixels"), value={"modulation too low": 1201, "saturated": 84, "residual too large": 2043}),
        ),
        (
            _check("valid", "ok", "98.7% of the lit pixels have a phase", 0.987, 0.9),
            _check("order errors", "warning", "0.9% of the pixels lie far from every fringe order", 0.009, 0.005),
        ),
    )  # fmt: skip


class Cloud(Params):
    tolerance_px: float = setting(0.5, title="Left-right check", unit="px", gt=0, le=10)
    """Largest distance when matched back."""
    sigma_max_mm: float | None = setting(None, title="Noise at most", unit="mm", gt=0, le=10)
    """Automatic: no limit."""


def make_cloud(settings: dict[str, Any]) -> FakeResult:
    s = scene()
    valid = s.reasons("left") == 0
    points = s.points_mm("left")[valid]
    albedo = s.albedo("left")[valid]
    colour = np.repeat(np.clip(255 * albedo[:, None] ** 0.6, 0, 255), 3, axis=1).astype(np.uint8)
    return FakeResult(
        f"{len(points)} points",
        (
            FakeField("points_mm", _hint("points", "Point cloud", normals=None, colour="colour", scalars=("sigma_mm", "exposure_index")), arrays={"": points.astype(np.float32)}),
            FakeField("colour", _hint("data", ""), arrays={"": colour}),
            FakeField("sigma_mm", _hint("scalar", "Noise along the ray", unit="mm"), arrays={"": (0.012 / np.sqrt(albedo)).astype(np.float32)}),
            FakeField("exposure_index", _hint("scalar", "Exposure", unit=""), arrays={"": s.exposure_index("left")[valid].astype(np.float32)}),
            _value("n", "Points", len(points)),
            _value("sigma_median_mm", "Median noise", 0.0191, "mm"),
            FakeField("removed", _hint("table", "Removed points"), value={"left-right check": 1821, "jump": 402, "outlier": 57}),
        ),
        (_check("coverage", "ok", "98.6% of the valid pixels became points", 0.986, 0.8),),
    )  # fmt: skip


FRINGE = (
    FakeStage("pre_exposure", "Preview", "Find the longest exposure at which the white field saturates nothing.", Preview, make_preview, captures=True),
    FakeStage("zones", "Zones", "Split the scene's gray levels into zones that one exposure each can serve.", Zones, make_zones, review="always"),
    FakeStage("exposures", "Exposures", "Choose the exposures for the measured brightness within the time budget.", Exposures, make_exposures),
    FakeStage("fringe_capture", "Fringes", "Project the fringes and capture them at every exposure.", Capture, make_capture, captures=True),
    FakeStage("fusion", "Fusion", "Combine the exposures of each pixel.", Fusion, make_fusion),
    FakeStage("fringe_phase", "Phase", "Unwrap the phase and say why pixels are missing.", Phase, make_phase),
    FakeStage("stereo_cloud", "Point cloud", "Match the cameras and triangulate.", Cloud, make_cloud, review="always"),
)  # fmt: skip


# ---- the second method: odd names, every kind of view, settings of every type


class Odd(Params):
    flag: bool = setting(False, title=f"Flag {EVIL}")
    """A switch."""
    number: int = setting(
        3, title="A whole number with a rather long title", unit="km/h", ge=-5, le=5
    )
    """Between."""
    word: str = setting("tea & <b>cake</b>", title="Word")
    """Free text."""
    choice: Literal["<one>", "two"] = setting("<one>", title="Choice")
    """One of."""
    pair: tuple[float, float] = setting((1.0, 2.5), title="Pair", unit="mm")
    """Two numbers."""
    maybe: int | None = setting(None, title="Maybe", auto="chosen")
    """May be automatic."""
    table: dict[str, float] = setting({"a": 1.0}, title="Anything", advanced=True)
    """A document."""


def make_odd(settings: dict[str, Any]) -> FakeResult:
    x = np.linspace(0, 10, 50)
    box = np.array([[i, j, k] for i in (0, 60) for j in (0, 40) for k in (600, 640)], np.float32)
    faces = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )
    values = np.stack([np.exp(-x), np.exp(-x / 3)])
    values[0, 7] = np.nan  # a gap in a curve
    return FakeResult(
        f"Done & {EVIL}",
        (
            _value("text", f"A text {EVIL}", f"so & so {EVIL}"),
            _value("nothing", "Nothing", None),
            _value("nan", "Not a number", "nan"),
            FakeField("per_camera", _hint("value", "Per camera", unit="gray", digits=3), value={"left": 1.23456, "right": 2.0}, per_camera=True),
            FakeField("decay", _hint("curve", "Decay", x="time", x_title="t [s]", unit="V", log_y=True), arrays={"": values}),
            FakeField("time", _hint("curve", "Time", x=None, x_title="", unit="s", log_y=False), arrays={"": x}),
            FakeField("hologram", _hint("hologram", "A kind that nobody knows")),
            FakeField("vertices", _hint("mesh", "Box", faces="faces"), arrays={"": box}),
            FakeField("faces", _hint("data", ""), arrays={"": faces}),
            FakeField("empty", _hint("table", "Empty table"), value=[]),
            _mask("labels", "Labels", lambda c: (np.indices((48, 64))[1] // 16).astype(np.uint8), labels={"1": EVIL, "2": "two"}),
        ),
        (_check("odd", "failure", f"Everything is odd {EVIL}", 1.0, 0.5, "odd"),),
    )  # fmt: skip


ODD = tuple(
    FakeStage(name, title, f"What {title} does.", Odd, make_odd, review="on_failure")
    for name, title in (
        ("zq7", "Alpha & <b>omega</b>"), ("x-1", "Antidisestablishment"), ("__", "δ"), ("n3", "Third of nine"),
        ("n4", "Four"), ("n5", "Five & six"), ("n6", "A very long title of a stage"), ("n7", "Seven"), ("n8", "Ninth"),
    )
)  # fmt: skip

# ---- the third method: results that are painted on, picked in, and handed over


class Levels(Params):
    count: int = setting(8, title="Levels", ge=2, le=16)
    """Uniform fields that are projected."""


def make_levels(settings: dict[str, Any]) -> FakeResult:
    s = scene()
    light = np.linspace(20.0, 250.0, settings["count"])
    slope = {c: (1.6 * s.albedo(c)).astype(np.float32) for c in CAMERAS}
    offset = {c: np.full(slope[c].shape, 6.0, np.float32) for c in CAMERAS}
    frames = tuple(
        {
            "camera": c, "exposure_ms": 20.0, "gain_db": 0.0, "role": "level", "bit_depth": 8,
            "pattern": {"kind": "uniform", "gray": float(v)},
            "image": np.clip(slope[c] * v + offset[c], 0, 255).astype(np.uint8),
        }
        for v in light for c in CAMERAS
    )  # fmt: skip
    return FakeResult(
        f"{len(light)} levels captured",
        (
            FakeField("frames", _hint("frames", "Uniform fields", x="light", slope="slope", offset="offset"), frames=frames),
            FakeField("light", _hint("data", ""), arrays={"": light}),
            _picture("slope", "Slope", slope.__getitem__, unit="gray", colormap="viridis"),
            FakeField("offset", _hint("data", ""), arrays=offset, per_camera=True),
        ),
    )  # fmt: skip


class Mask(Params):
    paint: ArrayHash | None = setting(None, title="Painted mask")
    """Replaces the mask where it is painted."""
    interval_gray: tuple[float, float] | None = setting(
        None, title="Interval", unit="gray", auto="chosen_gray"
    )
    """Darkest and brightest gray level."""


def make_mask(settings: dict[str, Any]) -> FakeResult:
    y, x = np.mgrid[:200, :320]
    factor = (1.0 - 0.8 * np.exp(-((x - 200.0) ** 2 + (y - 90.0) ** 2) / 1500.0)).astype(np.float32)
    axis = np.arange(5.0, 256.0, 10.0)
    low, high = np.meshgrid(axis, axis)
    cost = np.where(high > low + 20, np.hypot(low - 45.0, high - 205.0) / 20 + 1.0, np.nan)
    chosen = list(settings["interval_gray"] or (45.0, 205.0))
    painted = "with paint" if settings["paint"] else "by itself"
    return FakeResult(
        f"Mask found, {painted}",
        (
            FakeField("factor", _hint("picture", "Intensity mask", unit="", colormap="gray", low=0.0, high=1.0, edits="paint"), arrays={"": factor}),
            FakeField("cost", _hint("picture", "U over darkest and brightest gray level", unit="%", colormap="viridis", low=None, high=None, x="axis_gray", y="axis_gray", point="chosen_gray", edits="interval_gray"), arrays={"": cost}),
            FakeField("axis_gray", _hint("data", ""), arrays={"": axis}),
            FakeField("chosen_gray", _hint("data", ""), value=chosen),
        ),
    )  # fmt: skip


MASKED = (
    FakeStage("levels", "Response", "Capture uniform fields.", Levels, make_levels, captures=True),
    FakeStage("mask", "Mask", "Find the mask.", Mask, make_mask, review="always"),
)

METHODS = {
    "hdr-fringe": (
        "Multi-exposure phase shifting",
        "Fringes at several exposures, two cameras.",
        FRINGE,
    ),
    "odd-one": (f"Odd {EVIL}", "Every kind of view.", ODD),
    "painted": ("Painted mask", "Levels, and a mask that is painted on.", MASKED),
}
