"""Find the longest exposure at which the white field saturates nothing, and the scene's brightness at it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

from backend.domain.checks import Check, at_least, at_most
from backend.domain.errors import StageFailedError
from backend.domain.frames import Frame, InMemory
from backend.domain.hints import Histogram, Mask, Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import BLACK, WHITE
from backend.domain.rig import CameraFacts, RigFacts
from backend.domain.shots import Exposed, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.histogram import dark_level, pooled_histogram
from backend.stages.camera_noise import noise_model
from backend.stages.intensity_mask import IntensityMask

MAX_CAPTURES = 10

GLARE_SHARE = 0.015
"""Less light than this share of the picture's mean is what the lens scatters, not what the part returns."""


class PreExposureParams(Params):
    """How the exposure of the preview is found."""

    exposure_ms: float | None = setting(
        None, title="Preview exposure", unit="ms", auto="t_pre_ms", gt=0, le=60_000
    )
    """Exposure of the white field; automatic: the longest without saturation."""
    saturated_share: float = setting(
        1e-4, title="Saturated pixels allowed", unit="", ge=0, le=0.1, advanced=True
    )
    """Share of lit pixels that may be saturated: dead and hot pixels must not decide."""
    snap: bool = setting(True, title="Whole projector frames", advanced=True)
    """Use multiples of the projector's frame period, so that its modulation averages out."""
    boost: float = setting(
        8.0, title="Long exposure for dark parts", unit="x", ge=1, le=64, advanced=True
    )
    """One more white field, so many times longer, tells the brightness of dark parts; 1 means none."""


@dataclass(frozen=True)
class LadderStep:
    """One exposure that was tried."""

    exposure_ms: float
    saturated_share: float
    brightest_gray: float


@dataclass(frozen=True)
class Preview:
    """The scene under a white field, at the longest exposure without saturation."""

    t_pre_ms: Annotated[float, Value("Preview exposure", unit="ms")]
    saturated_share: Annotated[float, Value("Saturated")]
    foreground_share: Annotated[float, Value("Lit share of the picture")]
    histogram: Annotated[
        Float[np.ndarray, "gray"], Histogram("Gray levels, lit pixels of all cameras")
    ]
    white: Annotated[
        Mapping[str, Integer[np.ndarray, "_h _w"]], Picture("White field", unit="gray")
    ]
    foreground: Annotated[Mapping[str, Bool[np.ndarray, "_h _w"]], Mask("Lit pixels", {1: "lit"})]
    rate_gray_per_ms: Annotated[
        Mapping[str, Float[np.ndarray, "_h _w"]],
        Picture("Brightness", unit="gray/ms", colormap="inferno"),
    ]
    """Signal of the white field above dark per ms, from the longest unsaturated picture of each pixel."""
    dark: Annotated[Mapping[str, Integer[np.ndarray, "_h _w"]], Picture("Black field", unit="gray")]
    dark_gray: Mapping[str, float]
    """Median of the black field."""
    ladder: Annotated[tuple[LadderStep, ...], Table("Exposures tried")]
    full_scale_gray: float


def _lit(preview: Preview, params: Params) -> Check:
    return at_least(
        "lit share", preview.foreground_share, warning=0.02, failure=0.001,
        sentence=f"{preview.foreground_share:.1%} of the picture is lit by the projector",
        remedy="move the part into the light, open the aperture or expose longer",
    )  # fmt: skip


def _saturation_sentence(preview: Preview, params: PreExposureParams) -> str:
    fact = f"{preview.saturated_share:.2%} of the lit pixels are saturated at {preview.t_pre_ms:.1f} ms"
    if preview.saturated_share <= params.saturated_share:
        return fact
    return f"{fact}: shorten the exposure, close the aperture or dim the projector"


def _unsaturated(preview: Preview, params: PreExposureParams) -> Check:
    return at_most(
        "saturation", preview.saturated_share, warning=params.saturated_share, failure=0.2,
        sentence=_saturation_sentence(preview, params),
    )  # fmt: skip


@stage(title="Preview", version=1, review=Review.ON_WARNING, checks=(_lit, _unsaturated))
def pre_exposure(
    facts: RigFacts, mask: IntensityMask | None, params: PreExposureParams, shoot: Shoot
) -> Preview:
    """Find the longest exposure at which the white field saturates no lit pixel in any camera."""
    grid = ExposureGrid.of(facts, snap=params.snap)
    search = shoot(search_plan(facts, params, grid, mask))
    return _summarise(search, facts)


@dataclass(frozen=True)
class ExposureGrid:
    """Exposures that may be used: whole steps within the cameras' common range."""

    step_ms: float
    lowest: int
    highest: int

    @classmethod
    def of(cls, facts: RigFacts, *, snap: bool) -> "ExposureGrid":
        """Use the projector's frame period as step, or 0.1 ms where it has none or `snap` is off."""
        period = facts.projector.frame_period_ms if facts.projector else None
        step = period if snap and period else 0.1
        low = max(c.exposure_min_ms for c in facts.cameras.values())
        high = min(c.exposure_max_ms for c in facts.cameras.values())
        lowest, highest = max(1, int(np.ceil(low / step - 1e-9))), int(np.floor(high / step + 1e-9))
        if highest < lowest:
            raise StageFailedError(
                f"No exposure between {low:g} and {high:g} ms is a multiple of {step:.3f} ms: switch off whole projector frames."
            )
        return cls(step, lowest, highest)

    def index(self, exposure_ms: float) -> int:
        """Return the step next below an exposure, within the range."""
        return int(np.clip(int(exposure_ms / self.step_ms + 1e-6), self.lowest, self.highest))

    def ms(self, index: int) -> float:
        """Return the exposure of a step."""
        return index * self.step_ms


@dataclass(frozen=True)
class Search:
    """What the plan brings home."""

    chosen: int
    """Index into `whites` of the picture at t_pre."""
    whites: tuple[Exposed, ...]
    dark: Exposed


def search_plan(
    facts: RigFacts,
    params: PreExposureParams,
    grid: ExposureGrid,
    mask: IntensityMask | None = None,
) -> Plan[Search]:
    """Bracket and bisect on the grid, then one long white field and the black field."""
    pixels = InMemory(mask.factor) if mask is not None else None
    take = partial(Shot, WHITE, role="white", mask=pixels)
    whites: list[Exposed] = []
    if params.exposure_ms is not None:
        whites += yield (take(_allowed(params.exposure_ms, facts)),)
        chosen = 0
    else:
        chosen = yield from _bisect(whites, facts, params, grid, take)
    t_pre_ms = _exposure(whites[chosen])
    long_ms = grid.ms(grid.index(t_pre_ms * params.boost))
    if long_ms > t_pre_ms:
        whites += yield (take(long_ms),)
    (dark,) = yield (Shot(BLACK, t_pre_ms, role="dark"),)
    return Search(chosen, tuple(whites), dark)


def _bisect(
    whites: list[Exposed],
    facts: RigFacts,
    params: PreExposureParams,
    grid: ExposureGrid,
    take: Callable[[float], Shot],
) -> Plan[int]:
    below, above = grid.lowest - 1, grid.highest + 1  # last good and first saturated step
    best, step = 0, grid.index(60.0)
    while above - below > 1 and len(whites) < MAX_CAPTURES - 2:
        whites += yield (take(grid.ms(step)),)
        if saturated_share(whites[-1], facts) <= params.saturated_share:
            below, best = step, len(whites) - 1
        else:
            above = step
        step = _next_step(whites[-1], facts, params, below, above, step)
    if below < grid.lowest and grid.lowest not in {grid.index(_exposure(w)) for w in whites}:
        whites += yield (take(grid.ms(grid.lowest)),)
        best = len(whites) - 1
    elif below < grid.lowest:
        best = min(range(len(whites)), key=lambda i: _exposure(whites[i]))
    return best


def _next_step(
    white: Exposed, facts: RigFacts, params: PreExposureParams, below: int, above: int, step: int
) -> int:
    """Jump where a linear camera would just saturate; after a jump too far, stay near its end."""
    if below == step:
        brightest = max(
            _brightest(f, facts.cameras[n], params.saturated_share) for n, f in white.items()
        )
        guess = max(int(step / max(brightest, 0.01)), below + max(1, below // 50))
    else:
        guess = max((below + above) // 2, int(0.95 * above)) if below > 0 else step // 4
    return int(np.clip(guess, below + 1, above - 1))


def _brightest(frame: Frame, facts: CameraFacts, allowed_share: float) -> float:
    """Return the share of full scale that the brightest lit pixels, without the allowed few, reach."""
    black = facts.black_level_gray
    level = float(np.quantile(frame.gray[::2, ::2], 1.0 - allowed_share / 2))
    return (level - black) / (facts.full_scale_gray - 1.0 - black)


def saturated_share(exposed: Exposed, facts: RigFacts) -> float:
    """Return the largest share of saturated among lit pixels of any camera; saturated is >= full scale - 1."""
    return max(_share(frame, facts.cameras[name]) for name, frame in exposed.items())


def _share(frame: Frame, facts: CameraFacts) -> float:
    gray = frame.gray
    dark_gray = facts.black_level_gray + 3.0 * max(1.0, noise_model(facts).read_gray)
    lit = int(np.count_nonzero(gray > dark_gray))
    return float(np.count_nonzero(gray >= facts.full_scale_gray - 1)) / max(lit, 1)


def _allowed(exposure_ms: float, facts: RigFacts) -> float:
    low = max(c.exposure_min_ms for c in facts.cameras.values())
    high = min(c.exposure_max_ms for c in facts.cameras.values())
    if not low <= exposure_ms <= high:
        raise StageFailedError(
            f"A preview exposure of {exposure_ms:g} ms isn't possible: the cameras allow {low:g} to {high:g} ms."
        )
    return exposure_ms


def _exposure(exposed: Exposed) -> float:
    exposure_ms = next(iter(exposed.values())).exposure_ms
    assert exposure_ms is not None, "frames of a rig always carry their exposure"
    return exposure_ms


def _summarise(search: Search, facts: RigFacts) -> Preview:
    chosen = search.whites[search.chosen]
    signals = {n: _Signal.of(n, search, facts.cameras[n]) for n in chosen}
    foreground = {n: s.foreground for n, s in signals.items()}
    lit = sum(int(np.count_nonzero(m)) for m in foreground.values())
    if lit == 0:
        raise StageFailedError(
            f"Nothing in the picture is lit by the projector at {max(map(_exposure, search.whites)):.0f} ms: "
            "open the lens cap or the aperture, and check that the projector shows white."
        )
    full_scale = int(max(c.full_scale_gray for c in facts.cameras.values()))
    dark = {n: dark_level(f.gray) for n, f in search.dark.items()}
    return Preview(
        t_pre_ms=_exposure(chosen),
        saturated_share=saturated_share(chosen, facts),
        foreground_share=lit / sum(int(m.size) for m in foreground.values()),
        histogram=pooled_histogram(
            [f.gray for f in chosen.values()],
            [dark[n].limit_gray for n in chosen],
            full_scale_gray=full_scale,
        ),
        white={n: f.gray for n, f in chosen.items()},
        foreground=foreground,
        rate_gray_per_ms={n: s.rate for n, s in signals.items()},
        dark={n: f.gray for n, f in search.dark.items()},
        dark_gray={n: level.level_gray for n, level in dark.items()},
        ladder=tuple(_step(w, facts) for w in search.whites),
        full_scale_gray=float(full_scale),
    )


def _step(white: Exposed, facts: RigFacts) -> LadderStep:
    brightest = max(float(f.gray.max()) for f in white.values())
    return LadderStep(_exposure(white), saturated_share(white, facts), brightest)


@dataclass(frozen=True)
class _Signal:
    """One camera's signal above dark."""

    rate: Float[np.ndarray, "h w"]
    foreground: Bool[np.ndarray, "h w"]

    @classmethod
    def of(cls, name: str, search: Search, facts: CameraFacts) -> "_Signal":
        dark, t_dark = search.dark[name].gray, _exposure(search.dark)
        # Ambient light is smooth against a pixel's noise, which the long exposure would magnify.
        ambient = (cv2.blur(dark.astype(np.float32), (9, 9)) - facts.black_level_gray) / t_dark
        limit_gray = 3.0 * dark_level(dark).sigma_gray
        rate = np.zeros(dark.shape, np.float32)
        foreground = np.zeros(dark.shape, bool)
        for white in sorted(search.whites, key=_exposure):  # the longest unsaturated one wins
            gray, t_ms = white[name].gray, _exposure(white)
            signal = gray - (facts.black_level_gray + ambient * t_ms)
            take = (gray < facts.full_scale_gray - 1) | (rate == 0)
            rate[take] = signal[take] / np.float32(t_ms)
            foreground |= signal > limit_gray
        rate = np.maximum(rate, 0.0)
        return cls(rate, foreground & (rate > GLARE_SHARE * rate.mean()))
