"""Learn the camera's response, the light of every gray level, from the exposure stack."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int64

from backend.domain.checks import Check, at_most
from backend.domain.errors import StageFailedError, sentence_of
from backend.domain.hints import Curve, Value
from backend.domain.params import Params, setting
from backend.domain.stage import stage
from backend.domain.states import Review
from backend.numerics.camera_response import LEVELS_8_BIT, ResponseProblem, opencv_response
from backend.numerics.errors import NumericsError
from backend.stages.stack import Stack

FALL_LIMIT = 0.05
"""A polynomial may fall by so much of the light: its own error where a linear camera's logarithm is nearly flat."""


class ResponseParams(Params):
    """How the response is fitted."""

    degree: int = setting(6, title="Degree", ge=3, le=8)
    """K of the polynomial (equation 8)."""
    smoothness: float = setting(1.0, title="Smoothness", ge=0, le=1e6, advanced=True)
    """gamma: weight of the curvature beside the samples (equation 9)."""
    lowest_gray: float = setting(
        10.0, title="Darkest sample", unit="gray", ge=1, le=64, advanced=True
    )
    """Darker samples are left out (8-bit scale): half a gray of rounding is 5 % of their light."""
    highest_gray: float = setting(
        251.0, title="Brightest sample", unit="gray", ge=128, le=254, advanced=True
    )
    """Brighter samples are left out: noise carries some of them over the edge."""


@dataclass(frozen=True)
class Response:
    """ln(E dt) of every gray level, 0 at mid gray, and the samples that it comes from."""

    log_light: Annotated[
        Float[np.ndarray, "curve level"],
        Curve(
            "ln(light) of each gray level", x_title="gray", names=("this fit", "OpenCV's Debevec")
        ),
    ]
    """First row: the polynomial of equation 9. Second: OpenCV's curve of the same samples, for comparison."""
    residual: Annotated[float, Value("Relative error of the light, rms")]
    """What samples above 1/8 of full scale depart from the curve; below, noise is what one would see."""
    difference: Annotated[float, Value("Distance from OpenCV's curve, rms")]
    """In ln(light), between the darkest and the brightest sample used."""
    samples_gray: Int64[np.ndarray, "point exposure"]
    exposures_ms: tuple[float, ...]
    full_scale_gray: float
    lowest_gray: int
    highest_gray: int
    """Samples outside aren't used."""
    smoothness: float

    @property
    def curve(self) -> Float[np.ndarray, "level"]:
        """g(G) of equation 9."""
        return np.asarray(self.log_light[0])

    def problem(self, degree: int) -> ResponseProblem:
        """Set up the least squares of the same samples with a polynomial of another degree."""
        return _problem(
            self.samples_gray, self.exposures_ms, self.full_scale_gray,
            degree, self.smoothness, self.lowest_gray, self.highest_gray,
        )  # fmt: skip


def _monotone(result: Response, params: ResponseParams) -> Check:
    inside = result.curve[result.lowest_gray : result.highest_gray + 1]
    fall = float((np.maximum.accumulate(inside) - inside).max())
    sentence = "the response grows with the gray level"
    if fall > FALL_LIMIT:
        sentence = f"the response falls by {fall:.0%} of the light: change the degree, or take more exposures"
    return at_most("monotone", fall, warning=FALL_LIMIT, failure=np.inf, sentence=sentence)


def _consistent(result: Response, params: ResponseParams) -> Check:
    sentence = f"the samples agree within {result.residual:.1%} of the light"
    if result.residual > 0.08:
        sentence += (
            ": did the scene or the room's light change, or is the camera's automatic exposure on?"
        )
    return at_most("residual", result.residual, warning=0.08, failure=0.5, sentence=sentence)


@stage(title="Response", version=1, review=Review.ON_WARNING, checks=(_monotone, _consistent))
def camera_response(stack: Stack, params: ResponseParams) -> Response:
    """Learn how the camera answers light, beside OpenCV's way of doing so."""
    levels = round(stack.full_scale_gray) + 1
    scale = levels / LEVELS_8_BIT
    lowest, highest = round(params.lowest_gray * scale), round(params.highest_gray * scale)
    problem = _problem(
        stack.samples_gray, stack.exposures_ms, stack.full_scale_gray,
        params.degree, params.smoothness, lowest, highest,
    )  # fmt: skip
    curve = problem.solve()
    other = _opencv(stack, levels)
    inside = slice(lowest, highest + 1)
    apart = (curve - other)[inside]
    return Response(
        log_light=np.stack([curve, other]),
        residual=problem.residual(curve, lowest_gray=levels // 8),
        difference=float(np.std(apart)),  # a constant is the unit of the light
        samples_gray=stack.samples_gray,
        exposures_ms=stack.exposures_ms,
        full_scale_gray=stack.full_scale_gray,
        lowest_gray=lowest,
        highest_gray=highest,
        smoothness=params.smoothness,
    )


def _problem(
    samples_gray: Int64[np.ndarray, "point exposure"],
    exposures_ms: tuple[float, ...],
    full_scale_gray: float,
    degree: int,
    smoothness: float,
    lowest_gray: int,
    highest_gray: int,
) -> ResponseProblem:
    try:
        return ResponseProblem(
            samples_gray,
            np.log(np.asarray(exposures_ms, np.float64)),
            levels=round(full_scale_gray) + 1,
            degree=degree,
            smoothness=smoothness,
            lowest_gray=lowest_gray,
            highest_gray=highest_gray,
        )
    except NumericsError as error:
        raise StageFailedError(sentence_of(error)) from error


def _opencv(stack: Stack, levels: int) -> Float[np.ndarray, "level"]:
    """Return OpenCV's curve; it knows 8 bit only."""
    shift = levels // LEVELS_8_BIT
    curve = opencv_response(stack.samples_gray // shift, np.asarray(stack.exposures_ms, np.float64))
    if shift == 1:
        return curve
    coarse = (np.arange(LEVELS_8_BIT) + 0.5) * shift - 0.5
    return np.asarray(np.interp(np.arange(levels), coarse, curve), np.float64)
