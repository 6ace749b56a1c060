"""Measured phase noise against what was predicted, and against the bound that no decoder can beat.

Needs a rig that knows the truth, and a scene that is smooth: `plane`.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from backend.domain.errors import StageUnavailableError
from backend.domain.rig import RigCalibration, RigFacts
from backend.jobs.loading import load_scan
from backend.numerics.camera_model import project
from backend.numerics.phasors import modulation_gray
from backend.numerics.scoring import Truth
from backend.services.context import Context
from backend.services.reporting import rig_truth
from backend.services.variants import given_result, present_result
from backend.stages.camera_noise import noise_model
from backend.stages.fringe_phase import AbsolutePhase
from backend.stages.fusion import AxisPhasors, Phasors
from backend.stages.rig_geometry import pinhole, projector_from_reference

TOLERANCE = 0.1
_WILD = 8.0
"""Deviations beyond so many sigma are wrong fringes, not noise; they are counted apart."""


@dataclass(frozen=True)
class NoiseReport:
    """Noise of the decoded projector column over all pixels that the truth counts."""

    pixels: int
    wild: int
    """Pixels off by more than 8 sigma, left out."""
    bias_px: float
    """Median of measured minus true column."""
    measured_px: float
    """Root mean square of measured minus true column, bias taken off."""
    predicted_px: float
    """Root mean square of the predicted standard deviations."""
    bound_px: float
    """Root mean square of the Cramer-Rao bounds."""
    over_predicted: float
    """Root mean square of (measured - true) / predicted."""
    over_bound: float
    """Root mean square of (measured - true) / bound."""

    @property
    def is_as_predicted(self) -> bool:
        """True if the noise is within 10 % of the prediction and of the bound."""
        return max(abs(self.over_predicted - 1), abs(self.over_bound - 1)) <= TOLERANCE

    def document(self) -> dict[str, Any]:
        """Write the figures as JSON values."""
        return {**asdict(self), "within_10_percent": self.is_as_predicted}


def measure_noise(context: Context, scan: str) -> NoiseReport:
    """Compare a finished scan's phase with the truth.

    Raises
    ------
    StageUnavailableError
        If the scan has no phase of a calibrated rig, or its rig doesn't know the truth.
    """
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        phase = present_result(context, repositories, loaded, AbsolutePhase)
        phasors = present_result(context, repositories, loaded, Phasors)
        facts = given_result(context, loaded, RigFacts)
        calibration = given_result(context, loaded, RigCalibration)
    truth = rig_truth(context, loaded, calibration.reference, (calibration.reference,))
    if truth is None:
        raise StageUnavailableError(
            f"The rig of {loaded.title!r} doesn't know the truth: measure noise with the simulated one."
        )
    name = calibration.reference
    axis = next(s for s in phasors.sets if s.camera == name and s.axis == "x")
    error_px = phase.projector_px[name] - true_columns_px(truth, calibration)
    bound_px = column_bound_px(axis, phasors.exposures_ms, facts)
    return _compared(error_px, phase.sigma_px[name], bound_px, truth.base)


def true_columns_px(truth: Truth, calibration: RigCalibration) -> Float[np.ndarray, "h w"]:
    """Project the true surface into the projector: the column that lights each pixel."""
    projector_from_camera = projector_from_reference(calibration)
    if calibration.projector is None or projector_from_camera is None:
        raise StageUnavailableError("The projector isn't calibrated: noise needs its place.")
    projector = pinhole(calibration.projector)
    points = truth.points_mm.reshape(-1, 3).astype(np.float64)
    seen = np.isfinite(points).all(axis=1)
    columns = np.full(len(points), np.nan)
    columns[seen] = project(points[seen], projector, projector_from_camera)[:, 0]
    return columns.reshape(truth.part.shape)


def column_bound_px(
    axis: AxisPhasors, exposures_ms: tuple[float, ...], facts: RigFacts
) -> Float[np.ndarray, "h w"]:
    r"""Give the Cramer-Rao bound of every pixel's column from all its unsaturated exposures.

    Notes
    -----
    .. math:: \sigma_u \ge \frac{W}{2\pi} \left(\sum_e \sum_f \frac{N_f f^2 B_e^2}{2 \sigma_I^2(A_e)}\right)^{-1/2}

    with mean A and modulation B scaled from the exposure that dominates the pixel to exposure e.
    """
    camera = facts.cameras[axis.camera]
    noise = noise_model(camera)
    times = np.array([*exposures_ms, *[np.nan] * (256 - len(exposures_ms))])
    own_ms = times[axis.exposure_index]
    mean = axis.light_gray_per_ms
    modulation = modulation_gray(axis.phasors).mean(axis=0) / own_ms
    weight = sum(len(s) / 2 * f**2 for s, f in zip(axis.shifts_rad, axis.periods, strict=True))
    information = np.zeros(own_ms.shape)
    for time_ms in exposures_ms:
        gray = axis.black_gray + mean * time_ms
        serves = gray + modulation * time_ms < camera.full_scale_gray - 1
        sigma_gray = noise.sigma_gray(gray.astype(np.float64))
        information += np.where(serves, weight * (modulation * time_ms / sigma_gray) ** 2, 0.0)
    assert facts.projector is not None, "fringes had a projector"
    with np.errstate(divide="ignore"):
        return np.asarray(facts.projector.width_px / (2 * math.pi) / np.sqrt(information))


def _compared(
    error_px: Float[np.ndarray, "h w"],
    predicted_px: Float[np.ndarray, "h w"],
    bound_px: Float[np.ndarray, "h w"],
    base: Bool[np.ndarray, "h w"],
) -> NoiseReport:
    counted = base & np.isfinite(error_px) & np.isfinite(predicted_px) & np.isfinite(bound_px)
    if not counted.any():
        raise StageUnavailableError(
            "No pixel has both a phase and a true column: look at the phase."
        )
    error = error_px[counted].astype(np.float64)
    predicted = predicted_px[counted].astype(np.float64)
    bound = bound_px[counted]
    bias_px = float(np.median(error))
    error -= bias_px
    tame = np.abs(error) <= _WILD * predicted
    return NoiseReport(
        pixels=int(np.count_nonzero(tame)),
        wild=int(np.count_nonzero(~tame)),
        bias_px=bias_px,
        measured_px=_rms(error[tame]),
        predicted_px=_rms(predicted[tame]),
        bound_px=_rms(bound[tame]),
        over_predicted=_rms(error[tame] / predicted[tame]),
        over_bound=_rms(error[tame] / bound[tame]),
    )


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))
