"""How a camera answers light: ln(E dt) of every gray level, from pictures of one scene at several exposures."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Integer
from numpy.polynomial import legendre

from backend.numerics.errors import ResponseError

LEVELS_8_BIT = 256
"""Smoothness is counted per gray level of 8 bit, whatever the camera's depth."""

_SINGULAR = 1e-12
"""Singular values below this share of the largest are noise."""


def stratified_samples(
    frames_gray: Integer[np.ndarray, "exposure h w"],
    *,
    full_scale_gray: int,
    count: int = 400,
    region: Bool[np.ndarray, "h w"] | None = None,
) -> Int64[np.ndarray, "point exposure"]:
    """Pick pixels that cover the scene's brightness evenly.

    Parameters
    ----------
    frames_gray
        Pictures of a static scene, one per exposure.
    full_scale_gray
        The largest gray level; it and 0 count as clipped.
    count
        About how many pixels.
    region
        Pixels that may be picked; None: all.

    Returns
    -------
    samples_gray
        Gray levels of each point at every exposure, darkest point first, clipped samples included.

    Raises
    ------
    ResponseError
        If there are fewer than two exposures, or no pixel is unclipped in two of them.
    """
    if len(frames_gray) < 2:
        raise ResponseError(
            f"the stack has {len(frames_gray)} exposure: a response needs at least two, better six"
        )
    usable = unclipped(frames_gray, full_scale_gray).sum(axis=0) >= 2
    if region is not None:
        usable &= region
    if not usable.any():
        raise ResponseError(
            f"all pixels of the stack are clipped in all but at most one of its {len(frames_gray)} exposures: "
            f"choose exposures that lie closer together and within the camera's range"
        )
    chosen = frames_gray[:, usable].astype(np.int64)
    # The sum over exposures grows with the light, so equal steps of it cover all gray levels of all exposures.
    brightness = chosen.sum(axis=0)
    edges = np.linspace(brightness.min(), brightness.max() + 1, count + 1)
    order = np.argsort(brightness, kind="stable")
    first = np.unique(np.searchsorted(brightness[order], edges[:-1]))
    return chosen[:, order[first[first < order.size]]].T.copy()


def unclipped(
    gray: Integer[np.ndarray, "*shape"], full_scale_gray: int
) -> Bool[np.ndarray, "*shape"]:
    """Tell which gray levels are neither 0 nor full scale."""
    return (gray > 0) & (gray < full_scale_gray)


class ResponseProblem:
    r"""Least squares for the response curve, prepared once and solved for many weights.

    Notes
    -----
    With :math:`g(G) = \sum_k a_k p_k(G)` of degree K it minimises [1]_ (equations 9 and 10)

    .. math:: \sum_{ij} w^2(G_{ij}) \left( g(G_{ij}) - \ln E_i - \ln t_j + \epsilon(G_{ij}) \right)^2
              + \gamma \sum_G g''(G)^2, \qquad g(\text{mid gray}) = 0.

    :math:`\ln E_i` is linear and on its own in point i, so it is eliminated: what stays are the
    samples less their point's weighted mean. The :math:`p_k` are orthonormal over all gray levels: powers of
    G would cost ten digits. :math:`\epsilon` has to depend on each *sample's* gray level: one number
    per point would go into :math:`\ln E_i` and change nothing. One solution costs some 10 us per 100 points.

    References
    ----------
    .. [1] F. Hu et al., "Precise phase measurement for fringe reflection technique through optimized camera
       response", Sensors 23(23), 9299 (2023), doi:10.3390/s23239299.
    """

    def __init__(
        self,
        samples_gray: Integer[np.ndarray, "point exposure"],
        log_exposure: Float[np.ndarray, "exposure"],
        *,
        levels: int,
        degree: int = 6,
        smoothness: float = 1.0,
        lowest_gray: int = 1,
        highest_gray: int | None = None,
    ) -> None:
        highest = levels - 2 if highest_gray is None else highest_gray
        used = (samples_gray >= lowest_gray) & (samples_gray <= highest)
        points = used.sum(axis=1) >= 2
        if len(np.unique(log_exposure)) < 2:
            raise ResponseError(
                "the stack has one exposure: a response needs at least two, better six"
            )
        if not points.any():
            raise ResponseError(
                f"no point of the stack is within gray {lowest_gray} to {highest} at two exposures: "
                f"choose exposures that lie closer together and within the camera's range"
            )
        self.levels, self.degree = levels, degree
        self._basis, curvature = _basis(levels, degree)
        self._smoothness = smoothness * (LEVELS_8_BIT / levels) * (curvature.T @ curvature)
        self._gray = samples_gray[points]
        self._used = used[points].astype(np.float64)
        self._log_exposure = np.asarray(log_exposure, np.float64)
        self._rows = self._basis[self._gray]

    def solve(
        self,
        weight: Float[np.ndarray, "level"] | None = None,
        offset: Float[np.ndarray, "level"] | None = None,
    ) -> Float64[np.ndarray, "level"]:
        r"""Return g of every gray level, 0 at mid gray.

        Parameters
        ----------
        weight
            w of each gray level; None: 1.
        offset
            :math:`\epsilon` of each gray level; None: 0.
        """
        squared = self._used if weight is None else self._used * (weight**2)[self._gray]
        target = np.broadcast_to(self._log_exposure, squared.shape)
        if offset is not None:
            target = target - offset[self._gray]
        total = np.maximum(squared.sum(axis=1), np.finfo(float).tiny)
        # Points that are left with one sample have residual 0 by themselves: they don't count.
        row_mean = np.matmul(squared[:, None, :], self._rows)[:, 0] / total[:, None]
        target_mean = (squared * target).sum(axis=1) / total
        rows = (self._rows - row_mean[:, None]).reshape(-1, self.degree)
        weighted = rows * squared.reshape(-1, 1)
        normal = weighted.T @ rows + self._smoothness
        right = weighted.T @ (target - target_mean[:, None]).ravel()
        coefficients = np.linalg.lstsq(normal, right, rcond=_SINGULAR)[0]  # by SVD
        curve = self._basis @ coefficients
        return np.asarray(curve - curve[mid_gray(self.levels)], np.float64)

    def determined(self, lowest_gray: int, highest_gray: int) -> bool:
        """Tell whether samples between two gray levels determine a curve: twice as many points as its degree."""
        inside = (self._gray >= lowest_gray) & (self._gray <= highest_gray) & (self._used > 0)
        return int((inside.sum(axis=1) >= 2).sum()) >= 2 * self.degree

    def residual(self, curve: Float[np.ndarray, "level"], *, lowest_gray: int = 0) -> float:
        """Return the rms of g(G) - ln E - ln dt over the samples used, i.e. the relative error of the light."""
        used = self._used * (self._gray >= lowest_gray)
        difference = curve[self._gray] - self._log_exposure
        total = np.maximum(used.sum(axis=1, keepdims=True), 1.0)
        mean = (used * difference).sum(axis=1, keepdims=True) / total
        freedom = used.sum() - int((used.sum(axis=1) > 0).sum())
        squares = float((used * (difference - mean) ** 2).sum())
        return float(np.sqrt(squares / max(freedom, 1.0)))


def mid_gray(levels: int) -> int:
    """Return the gray level at which responses are 0: 128 of 256."""
    return levels // 2


class _Basis(NamedTuple):
    values: Float64[np.ndarray, "level k"]
    second_derivative: Float64[np.ndarray, "level k"]


def _basis(levels: int, degree: int) -> _Basis:
    """Give Legendre polynomials 1..K over all gray levels, orthonormal, and their g'' per gray level of 8 bit."""
    x = np.linspace(-1.0, 1.0, levels)
    per_gray = 2.0 / (LEVELS_8_BIT - 1)
    norm = np.sqrt(np.arange(1, degree + 1) + 0.5)
    values = legendre.legvander(x, degree)[:, 1:] * norm
    coefficients = np.eye(degree + 1)[:, 1:]
    second = legendre.legval(x, legendre.legder(coefficients, 2)).T * norm * per_gray**2
    return _Basis(values, second.reshape(levels, degree))


def opencv_response(
    samples_gray: Integer[np.ndarray, "point exposure"],
    exposures_ms: Float[np.ndarray, "exposure"],
    *,
    smoothness: float = 10.0,
    points: int = 100,
) -> Float64[np.ndarray, "256"]:
    """Fit OpenCV's Debevec curve to the same samples, for comparison; 0 at mid gray, 8 bit only.

    Clipped samples are in it, as OpenCV wants them: it weights them down instead.
    """
    import cv2

    side = int(np.sqrt(min(points, len(samples_gray))))
    chosen = np.linspace(0, len(samples_gray) - 1, side * side).round().astype(int)
    pictures = [
        np.repeat(column.reshape(side, side, 1), 3, axis=2)
        for column in samples_gray[chosen].T.astype(np.uint8)
    ]
    calibrate = cv2.createCalibrateDebevec(side * side, smoothness, False)
    times = np.asarray(exposures_ms, np.float32)
    light = calibrate.process(pictures, times)[:, 0, 0].astype(np.float64)
    curve = np.log(np.maximum(light, np.finfo(float).tiny))
    return np.asarray(curve - curve[mid_gray(LEVELS_8_BIT)], np.float64)
