"""Find the exposure that serves the darkest parts: whatever it saturates, the intensity mask dims."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float32, Integer

from backend.domain.checks import Check, at_least, at_most
from backend.domain.errors import StageFailedError
from backend.domain.hints import Mask, Picture, Table, Value
from backend.domain.params import Params, setting
from backend.domain.patterns import BLACK, WHITE, Pattern, Stripe
from backend.domain.rig import CameraFacts, RigFacts
from backend.domain.shots import Exposed, Plan, Shoot, Shot
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.stages.camera_noise import noise_model
from backend.stages.pre_exposure import ExposureGrid

_STRIPE_PX = 16
"""Period of the stripes that tell direct light from what lens and scene scatter: coarse against any blur."""
_SIGMAS = 5.0
"""A pixel is lit where its stripes differ by so many standard deviations of the noise."""
_FIRST_MS = 60.0
_STEP = 6.0
"""Each further exposure of the search is so many times longer."""


class BaseExposureParams(Params):
    """How the exposure for dark parts is found."""

    exposure_ms: float | None = setting(
        None, title="Exposure", unit="ms", auto="exposure_ms", gt=0, le=60_000
    )
    """One exposure for everything that follows; automatic: dark parts reach the gray level below."""
    gain_db: float = setting(0.0, title="Camera gain", unit="dB", ge=0, le=48)
    """Analog gain of all cameras. More gain is more noise: lengthen the exposure first."""
    dark_target: float = setting(0.25, title="Dark parts reach", ge=0.02, le=0.9)
    """Share of the full scale that the darkest parts reach under full light."""
    dark_share: float = setting(
        0.02, title="Pixels that may be darker", ge=0, le=0.5, advanced=True
    )
    """Share of the lit pixels that needn't reach it: grazing faces and edges must not decide."""
    longest_ms: float = setting(1500.0, title="Longest exposure", unit="ms", gt=0, le=60_000)
    """The search stops here, however dark the parts are."""
    black_field_most: float = setting(0.2, title="Black field at most", gt=0, le=0.9, advanced=True)
    """Share of the full scale that the black field (ambient light, the projector's own black) may reach."""
    snap: bool = setting(True, title="Whole projector frames", advanced=True)
    """Use multiples of the projector's frame period, so that its modulation averages out."""


@dataclass(frozen=True)
class TriedExposure:
    """One exposure that was tried."""

    exposure_ms: float
    saturated_share: float
    """Of all pixels, under coarse stripes."""
    dark_signal_gray: float
    """What the darkest parts return of direct light."""


@dataclass(frozen=True)
class BaseExposure:
    """The exposure of everything that follows, and the scene at it."""

    exposure_ms: Annotated[float, Value("Exposure", unit="ms")]
    gain_db: Annotated[float, Value("Camera gain", unit="dB")]
    dark_signal_gray: Annotated[float, Value("Dark parts under full light", unit="gray")]
    black_field_gray: Annotated[float, Value("Black field, brightest camera", unit="gray")]
    saturated_share: Annotated[float, Value("Saturated without a mask")]
    lit_share: Annotated[float, Value("Lit share of the picture")]
    white: Annotated[
        Mapping[str, Integer[np.ndarray, "_h _w"]], Picture("White field", unit="gray")
    ]
    black: Annotated[
        Mapping[str, Integer[np.ndarray, "_h _w"]], Picture("Black field", unit="gray")
    ]
    lit: Annotated[Mapping[str, Bool[np.ndarray, "_h _w"]], Mask("Lit pixels", {1: "lit"})]
    """Pixels that see direct light of the projector, not only what lens and scene scatter."""
    tried: Annotated[tuple[TriedExposure, ...], Table("Exposures tried")]
    full_scale_gray: float
    """Of the camera with the lowest."""


def _lit_enough(result: BaseExposure, params: BaseExposureParams) -> Check:
    return at_least(
        "lit share", result.lit_share, warning=0.02, failure=0.001,
        sentence=f"{result.lit_share:.1%} of the picture returns light straight from the projector",
        remedy="move the parts into the light; a mirror-like part that sends its light elsewhere has to be turned or sprayed",
    )  # fmt: skip


def _dark_parts(result: BaseExposure, params: BaseExposureParams) -> Check:
    return at_least(
        "dark parts", result.dark_signal_gray, warning=8.0, failure=1.5, unit="gray",
        sentence=f"the darkest parts return {result.dark_signal_gray:.1f} gray at {result.exposure_ms:.0f} ms",
        remedy="allow a longer exposure, open the aperture or add gain",
    )  # fmt: skip


def _black_field(result: BaseExposure, params: BaseExposureParams) -> Check:
    share = result.black_field_gray / result.full_scale_gray
    return at_most(
        "black field", share, warning=2 * params.black_field_most, failure=0.9,
        sentence=f"the black field reaches {result.black_field_gray:.0f} of {result.full_scale_gray:.0f} gray",
    )  # fmt: skip


@stage(
    title="Base exposure",
    version=1,
    review=Review.ON_WARNING,
    checks=(_lit_enough, _dark_parts, _black_field),
)
def base_exposure(facts: RigFacts, params: BaseExposureParams, shoot: Shoot) -> BaseExposure:
    """Find the exposure at which dark parts reach a useful brightness; what it saturates will be dimmed."""
    if facts.projector is None:
        raise StageFailedError("The rig has no projector: an intensity mask needs one.")
    return shoot(search_plan(facts, params))


def search_plan(facts: RigFacts, params: BaseExposureParams) -> Plan[BaseExposure]:
    """Expose longer and longer until dark parts are bright enough, then white and black field."""
    grid = ExposureGrid.of(facts, snap=params.snap)
    light = _Light(facts)
    if params.exposure_ms is None:
        step = yield from _search(light, grid, facts, params)
        exposure_ms = grid.ms(step)
    else:
        exposure_ms = _allowed(params.exposure_ms, facts)
        yield from _look(light, exposure_ms, facts, params)
    fields = yield (_field(WHITE, exposure_ms, params), _field(BLACK, exposure_ms, params))
    longest_ms = _black_limit_ms(fields[1], exposure_ms, facts, params)
    if params.exposure_ms is None and longest_ms < exposure_ms:
        exposure_ms = grid.ms(grid.index(longest_ms))
        fields = yield (_field(WHITE, exposure_ms, params), _field(BLACK, exposure_ms, params))
    white, black = fields
    return _summarise(light, white, black, facts, params)


def _search(
    light: "_Light", grid: ExposureGrid, facts: RigFacts, params: BaseExposureParams
) -> Plan[int]:
    """Lengthen until dark parts are bright enough, and a longer look brings no more of them to light."""
    longest = grid.index(params.longest_ms)
    step = min(grid.index(_FIRST_MS), longest)
    lit_before = 0
    target_gray = params.dark_target * min(c.full_scale_gray for c in facts.cameras.values())
    while True:
        dark_rate = yield from _look(light, grid.ms(step), facts, params)
        wanted = longest if dark_rate <= 0 else grid.index(target_gray / dark_rate)
        wanted = min(wanted, longest)
        grown = light.lit_count() - lit_before > params.dark_share * light.lit_count()
        if step == longest or (wanted <= 1.1 * step and not grown):
            return wanted
        lit_before = light.lit_count()
        longer = min(grid.index(_STEP * grid.ms(step)), longest)
        step = longer if wanted <= 1.1 * step else min(wanted, longer)


def _look(
    light: "_Light", exposure_ms: float, facts: RigFacts, params: BaseExposureParams
) -> Plan[float]:
    """Capture coarse stripes and return what the darkest lit pixels bring, in [gray/ms]."""
    assert facts.projector is not None, "the stage refuses a rig without one"
    periods = facts.projector.width_px / _STRIPE_PX
    stripes: list[Pattern] = [
        Stripe(periods=periods, shift_periods=shift, inverse=inverse)
        for shift in (0.0, 0.25)
        for inverse in (False, True)
    ]
    shots = tuple(_field(pattern, exposure_ms, params) for pattern in stripes)
    light.add(exposure_ms, (yield shots))
    return light.darkest(params.dark_share)


def _field(pattern: Pattern, exposure_ms: float, params: BaseExposureParams) -> Shot:
    return Shot(pattern, exposure_ms, gain_db=params.gain_db, role="exposure")


class _Light:
    """Direct light of every pixel in [gray/ms], from its longest unsaturated exposure so far."""

    def __init__(self, facts: RigFacts) -> None:
        self._facts = facts
        self._rate: dict[str, Float32[np.ndarray, "h w"]] = {}
        self.lit: dict[str, Bool[np.ndarray, "h w"]] = {}
        self.exposure_ms = self._saturated = 0.0
        self.tried: list[TriedExposure] = []

    def add(self, exposure_ms: float, stripes: tuple[Exposed, ...]) -> None:
        """Take in one exposure, longer than those before."""
        saturated = pixels = 0
        for name, facts in self._facts.cameras.items():
            grays = [shot[name].gray for shot in stripes]
            direct = _direct(grays)
            brightest = np.maximum.reduce(grays)
            clean = brightest < facts.full_scale_gray - 1
            rate = self._rate.setdefault(name, np.zeros(direct.shape, np.float32))
            saturated += int(np.count_nonzero(~clean))
            pixels += clean.size
            take = clean | (rate == 0)
            rate[take] = direct[take] / np.float32(exposure_ms)
            known = self.lit.setdefault(name, np.zeros(direct.shape, bool))
            known |= direct > _SIGMAS * _pair_noise_gray(brightest, facts)
        self.exposure_ms = exposure_ms
        self._saturated = saturated / pixels

    def lit_count(self) -> int:
        """Return how many pixels have been found to be lit so far."""
        return sum(int(np.count_nonzero(m)) for m in self.lit.values())

    def darkest(self, share: float) -> float:
        """Return the rate that all but the darkest `share` of the lit pixels exceed; 0 if nothing is lit."""
        rates = np.concatenate([self._rate[name][lit] for name, lit in self.lit.items()])
        rate = float(np.quantile(rates, share)) if rates.size else 0.0
        self.tried.append(TriedExposure(self.exposure_ms, self._saturated, rate * self.exposure_ms))
        return rate


def _direct(grays: list[Integer[np.ndarray, "h w"]]) -> Float32[np.ndarray, "h w"]:
    """Return what a pixel gets of the stripes themselves: scattered light is the same in both of a pair."""
    pairs = [np.abs(a.astype(np.float32) - b) for a, b in zip(grays[::2], grays[1::2], strict=True)]
    return np.asarray(np.maximum.reduce(pairs))


def _pair_noise_gray(
    gray: Integer[np.ndarray, "h w"], facts: CameraFacts
) -> Float32[np.ndarray, "h w"]:
    """Return the noise of a difference of two pictures: read noise, shot noise, rounding."""
    sigma_gray = noise_model(facts).sigma_gray(gray.astype(np.float32))
    return np.asarray(np.sqrt(np.float32(2)) * sigma_gray, np.float32)


def _black_limit_ms(
    black: Exposed, exposure_ms: float, facts: RigFacts, params: BaseExposureParams
) -> float:
    """Return the exposure at which the black field reaches what it may; it grows with the exposure."""
    limits = []
    for name, frame in black.items():
        camera = facts.cameras[name]
        rate = (_black_level(frame.gray) - camera.black_level_gray) / exposure_ms
        allowed = params.black_field_most * camera.full_scale_gray - camera.black_level_gray
        limits.append(allowed / rate if rate > 0 else np.inf)
    return float(min(limits))


def _black_level(gray: Integer[np.ndarray, "h w"]) -> float:
    """Return the gray level that all but the brightest hundredth stay below: parts that gather ambient light."""
    return float(np.quantile(gray[::2, ::2], 0.99))


def _allowed(exposure_ms: float, facts: RigFacts) -> float:
    low = max(c.exposure_min_ms for c in facts.cameras.values())
    high = min(c.exposure_max_ms for c in facts.cameras.values())
    if not low <= exposure_ms <= high:
        raise StageFailedError(
            f"An exposure of {exposure_ms:g} ms isn't possible: the cameras allow {low:g} to {high:g} ms."
        )
    return exposure_ms


def _summarise(
    light: _Light, white: Exposed, black: Exposed, facts: RigFacts, params: BaseExposureParams
) -> BaseExposure:
    lit = light.lit_count()
    pixels = sum(m.size for m in light.lit.values())
    if lit == 0:
        raise StageFailedError(
            f"No stripe of the projector is seen at {light.exposure_ms:.0f} ms: open the lens cap or the aperture, "
            "move the parts into the light, and turn or spray a part that is black or mirror-like all over."
        )
    exposure_ms = next(iter(white.values())).exposure_ms
    assert exposure_ms is not None, "frames of a rig always carry their exposure"
    saturated = sum(
        int(np.count_nonzero(f.gray[light.lit[n]] >= f.full_scale_gray - 1))
        for n, f in white.items()
    )
    return BaseExposure(
        exposure_ms=exposure_ms,
        gain_db=params.gain_db,
        dark_signal_gray=light.tried[-1].dark_signal_gray * exposure_ms / light.exposure_ms,
        black_field_gray=max(_black_level(f.gray) for f in black.values()),
        saturated_share=saturated / lit,
        lit_share=lit / pixels,
        white={n: f.gray for n, f in white.items()},
        black={n: f.gray for n, f in black.items()},
        lit=light.lit,
        tried=tuple(light.tried),
        full_scale_gray=min(c.full_scale_gray for c in facts.cameras.values()),
    )
