"""Choose the quantity that fringes are read in: the one that answers to the control value along a line."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from backend.domain.checks import Check, at_most
from backend.domain.errors import StageFailedError, sentence_of
from backend.domain.hints import Curve, Table, Value
from backend.domain.params import Params, setting
from backend.domain.rig import RigFacts
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.camera_noise import gray_noise
from backend.numerics.errors import NumericsError
from backend.numerics.linearisation import (
    CONTROL_POINTS,
    inverse_table,
    optimised_response,
    predistortion,
    quoted_error,
)
from backend.numerics.linearisation import Interval as GrayInterval
from backend.numerics.phase_prediction import (
    Fringes,
    PhaseError,
    ScreenResponse,
    predict_phase_error,
)
from backend.numerics.screen_ramp import control_of_gray, gray_of_control
from backend.stages.camera_response import Response
from backend.stages.interval import Interval
from backend.stages.ramp import Ramp, monotone

Representation = Literal["raw_full", "raw", "log_plain", "log", "inverse", "predistorted"]
"""raw_full: gray levels, fringes over all control values. The others use the interval's control values and read
raw: gray levels; log_plain: ln E of equation 9; log: ln E of equations 10-13; inverse: the control value
looked up in the ramp; predistorted: gray levels of fringes that were bent the other way round."""

TITLES: Mapping[str, str] = {
    "raw_full": "gray levels, full range",
    "raw": "gray levels, interval",
    "log_plain": "ln E of equation 9",
    "log": "ln E of equations 10-13",
    "inverse": "inverse table of the ramp",
    "predistorted": "gray levels of pre-distorted fringes",
}

MORE_STEPS = (8, 12)
"""Numbers of steps that the table shows beside the one set."""

DEFAULT: Representation = "inverse"
_TIE = 1.03
"""The default is kept where nothing else is predicted to be better by more than the prediction's own error."""


class LineariseParams(Params):
    """How fringes are shown and read."""

    representation: Representation | None = setting(
        None, title="Fringes are read as", auto="representation"
    )
    """Automatic: the smallest predicted error at the number of steps."""
    steps: int = setting(4, title="Phase steps", ge=3, le=32)
    """More steps average noise and cancel harmonics: 8 make raw gray levels as good as any table."""


@dataclass(frozen=True)
class PredictedError:
    """What one representation is predicted to give."""

    representation: str
    error_mrad: float
    """Mean |phase error| over all phases at the number of steps set: shape and noise together."""
    systematic_mrad: float
    """The same without noise: what the shape of the response leaves."""
    with_8_steps_mrad: float
    with_12_steps_mrad: float
    """The error with more steps, to weigh time against them."""
    quoted_error_percent: float
    """Largest departure from the straight line over the range that the fringes use."""


@dataclass(frozen=True)
class Linear:
    """How gray levels of the fringes are read, and between which control values fringes are shown."""

    representation: str
    """One of `Representation`."""
    reason: Annotated[str, Value("Why")]
    steps: Annotated[int, Value("Phase steps")]
    values: Annotated[
        Float[np.ndarray, "level"], Curve("Linear value of each gray level", x_title="gray")
    ]
    """Fringes replace every gray level by this; NaN where a gray level can't be trusted."""
    gray_low: float
    gray_high: float
    """Gray levels between which the fringes lie."""
    control_low: Annotated[float, Value("Darkest control value")]
    control_high: Annotated[float, Value("Brightest control value")]
    """Fringes are shown as Y = control_high (1 + cos)/2 + control_low (1 - cos)/2, control values in [-1, 1]."""
    exposure_ms: Annotated[float | None, Value("Exposure of the fringes", unit="ms")]
    """Exposure for which `values` hold; None: an imported ramp that doesn't tell."""
    codes: Annotated[
        Float[np.ndarray, "shown"] | None, Curve("Display code, pre-distorted", unit="code")
    ] = None
    """Display code in [0, 255] for equidistant control values from -1 to 1; None: code = 127.5 (Y + 1)."""
    predicted_mrad: Annotated[float, Value("Predicted phase error", unit="mrad")] = float("nan")
    predicted: Annotated[tuple[PredictedError, ...], Table("Predicted phase error")] = ()
    control: Float[np.ndarray, "control"] | None = None
    quoted_percent: Annotated[
        Float[np.ndarray, "curve control"] | None,
        Curve(
            "Quoted error over the control value",
            x="control",
            x_title="control value",
            unit="%",
            names=("gray level", "ln E, equation 9", "ln E, equations 10-13", "inverse table"),
        ),
    ] = None
    """Over the interval; NaN where there is no exposure stack."""
    inverse: Float[np.ndarray, "level"] | None = None
    """Control value of every gray level by the ramp, whatever the fringes are read as: what its check reads."""


def _small(result: Linear, params: LineariseParams) -> Check:
    sentence = f"{result.predicted_mrad:.1f} mrad are predicted with {result.steps} steps"
    if result.predicted_mrad > 15:
        sentence += (
            ": take more steps, expose longer, or let the representation be chosen automatically"
        )
    return at_most(
        "phase error", result.predicted_mrad, warning=15.0, failure=500.0, sentence=sentence, unit="mrad"
    )  # fmt: skip


@stage(title="Linear quantity", version=1, review=Review.ALWAYS, checks=(_small,))
def linearise(
    ramp: Ramp,
    response: Response | None,
    interval: Interval,
    facts: RigFacts | None,
    params: LineariseParams,
) -> Linear:
    """Choose what fringes are read as: gray levels, ln E, or a table, by the phase error that each will have."""
    try:
        candidates = representations(ramp, response, interval)
        screen = _screen_response(ramp, response, facts)
        errors = {
            name: {
                steps: predict_phase_error(screen, shown.fringes, steps=steps)
                for steps in {params.steps, *MORE_STEPS}
            }
            for name, shown in candidates.items()
        }
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error
    at_steps = {name: by_steps[params.steps].all_rad for name, by_steps in errors.items()}
    chosen = params.representation or choose(at_steps)
    if chosen not in candidates:
        raise StageFailedError(
            f"{TITLES[chosen]} needs an exposure stack, and this scan has none: choose another representation."
        )
    rows = tuple(
        _row(name, shown, errors[name], params.steps) for name, shown in candidates.items()
    )
    return _result(chosen, candidates, rows, ramp, interval, params)


def choose(error_rad: Mapping[str, float]) -> str:
    """Return the representation with the smallest error, the default one where that is as good as equal."""
    finite = {name: error for name, error in error_rad.items() if np.isfinite(error)}
    if not finite:
        raise StageFailedError(
            "No representation gives a phase: the ramp and the interval don't overlap, measure the ramp again."
        )
    best = min(finite, key=lambda name: finite[name])
    as_good = finite.get(DEFAULT, np.inf) <= _TIE * finite[best]
    return DEFAULT if as_good else best


class Shown(NamedTuple):
    """How one representation shows and reads fringes."""

    fringes: Fringes
    quoted: Float[np.ndarray, "control"]
    """Quoted error over the control values that the fringes use."""


def representations(ramp: Ramp, response: Response | None, interval: Interval) -> dict[str, Shown]:
    """Make every representation that ramp, stack and interval allow, by name."""
    curve = monotone(ramp)
    levels = round(ramp.full_scale_gray) + 1
    control = control_of_gray(curve, levels)
    within = GrayInterval(
        round(interval.gray_low), round(interval.gray_high), interval.control_low, interval.control_high
    )  # fmt: skip
    raw = np.arange(levels, dtype=np.float64)
    shown = {
        "raw_full": Fringes(raw, -1.0, 1.0),
        "raw": Fringes(raw, within.control_low, within.control_high),
    }
    if response is not None:
        problem = response.problem(interval.degree)
        optimised = optimised_response(problem, problem.solve(), control, within)
        for name, values in (("log_plain", response.curve), ("log", optimised.values)):
            shown[name] = Fringes(values, within.control_low, within.control_high)
    table = inverse_table(curve, levels)
    shown["inverse"] = Fringes(table, within.control_low, within.control_high)
    shown["predistorted"] = Fringes(raw, -1.0, 1.0, predistortion(curve, within, levels))
    return {name: Shown(fringes, _quoted(ramp, fringes)) for name, fringes in shown.items()}


def _quoted(ramp: Ramp, fringes: Fringes) -> Float[np.ndarray, "control"]:
    control = np.linspace(fringes.control_low, fringes.control_high, CONTROL_POINTS)
    shown = control
    if fringes.codes is not None:
        codes = np.interp(control, np.linspace(-1.0, 1.0, len(fringes.codes)), fringes.codes)
        shown = codes / 127.5 - 1.0
    gray = gray_of_control(ramp.control, ramp.gray, shown)
    values = np.interp(gray, np.arange(len(fringes.values), dtype=np.float64), fringes.values)
    return quoted_error(values, control)


def _screen_response(
    ramp: Ramp, response: Response | None, facts: RigFacts | None
) -> ScreenResponse:
    """Take the noise that the ramp measured, else what the camera's data say."""
    noise = ramp.noise_gray
    if not np.isfinite(noise).all():
        camera = facts.cameras.get(ramp.camera or facts.reference) if facts else None
        noise = gray_noise(
            ramp.gray,
            full_scale_gray=ramp.full_scale_gray,
            full_well_e=camera.full_well_e if camera else None,
            read_noise_e=camera.read_noise_e if camera else 0.0,
            log_light=response.curve if response else None,
        )
    return ScreenResponse(ramp.control, ramp.gray, noise, ramp.full_scale_gray)


def _row(name: str, shown: Shown, errors: Mapping[int, PhaseError], steps: int) -> PredictedError:
    return PredictedError(
        representation=TITLES[name],
        error_mrad=1e3 * errors[steps].all_rad,
        systematic_mrad=1e3 * errors[steps].shape_rad,
        with_8_steps_mrad=1e3 * errors[8].all_rad,
        with_12_steps_mrad=1e3 * errors[12].all_rad,
        quoted_error_percent=float(np.abs(shown.quoted).max()),
    )


def _result(
    chosen: str,
    candidates: Mapping[str, Shown],
    rows: tuple[PredictedError, ...],
    ramp: Ramp,
    interval: Interval,
    params: LineariseParams,
) -> Linear:
    fringes = candidates[chosen].fringes
    errors = {row.representation: row.error_mrad for row in rows}
    full = chosen == "raw_full"
    missing = np.full(CONTROL_POINTS, np.nan)
    quoted = [
        candidates[n].quoted if n in candidates else missing
        for n in ("raw", "log_plain", "log", "inverse")
    ]
    return Linear(
        representation=chosen,
        reason=_reason(chosen, errors, params),
        steps=params.steps,
        values=fringes.values,
        gray_low=float(ramp.gray.min()) if full else interval.gray_low,
        gray_high=float(ramp.gray.max()) if full else interval.gray_high,
        control_low=fringes.control_low,
        control_high=fringes.control_high,
        exposure_ms=ramp.exposure_ms,
        codes=fringes.codes,
        predicted_mrad=errors[TITLES[chosen]],
        predicted=rows,
        control=np.linspace(interval.control_low, interval.control_high, CONTROL_POINTS),
        quoted_percent=np.stack(quoted),
        inverse=candidates["inverse"].fringes.values,
    )


def _reason(chosen: str, errors: Mapping[str, float], params: LineariseParams) -> str:
    own = errors[TITLES[chosen]]
    raw, best = errors[TITLES["raw_full"]], min(errors.values())
    how = "set by hand" if params.representation else "chosen"
    text = f"{TITLES[chosen]}, {how}: {own:.1f} mrad predicted with {params.steps} steps"
    others = f"gray levels over the full range {raw:.1f}, the best {best:.1f} mrad"
    return f"{text}; {others}"
