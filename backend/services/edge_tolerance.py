"""The paper's figure 13: the error of an edge that is extrapolated over a saturated gap, for 10 and 20 % of noise."""

import numpy as np
from jaxtyping import Float

from backend.numerics.edge_tolerance import (
    covered_gap_px,
    extrapolation_errors,
    predicted_error_px,
)
from backend.services.line_chart import Line, line_chart
from backend.services.report_document import Column, Figure, Report, ReportTable

NOISES = (0.1, 0.2)
_PAPERS_PX = {0.1: 20.0, 0.2: 12.0}
"""Gap that the paper covers within 1 px of error."""
_GAPS_PX = np.arange(0.0, 31.0)

_INTRODUCTION = (
    "Where pattern and inverse are both saturated, an edge's place is found by extending the rising and the falling line "
    "until they meet (equation 12). Only the intensity mask is made from such places, never a point. The figure says "
    "how wide the saturated gap may be: the two inner samples read 255, the outer ones 128 with uniform noise of so much "
    "of the full scale, and the error is the root mean square over random draws (the paper's figure 13).",
)


def edge_tolerance(*, draws: int = 20_000, seed: int = 0) -> Report:
    """Draw random edges and tell which gap they cover within 1 px."""
    errors_px = {p: _rms_px(p, draws, seed) for p in NOISES}
    return Report(
        name="edge-tolerance",
        title="Error of an extrapolated edge over the width of the saturated gap",
        introduction=_INTRODUCTION,
        tables=(_table(errors_px),),
        figures=(Figure("figure_13", "Error over the width of the gap", _chart(errors_px)),),
        findings=tuple(_finding(p, errors) for p, errors in errors_px.items()),
        facts={
            "covered_gap_px": {
                f"{p:.0%}": round(covered_gap_px(_GAPS_PX, errors), 2)
                for p, errors in errors_px.items()
            }
        },
    )


_Errors = dict[float, Float[np.ndarray, "gap"]]


def _rms_px(noise_share: float, draws: int, seed: int) -> Float[np.ndarray, "gap"]:
    errors = extrapolation_errors(_GAPS_PX, noise_share, draws=draws, seed=seed)
    return np.asarray(np.sqrt(np.mean(errors**2, axis=1)))


def _table(errors_px: _Errors) -> ReportTable:
    columns = [Column("gap_px", "gap, px", "g")]
    for p in NOISES:
        columns += [
            Column(f"error_{p:g}", f"error at {p:.0%} noise, px", ".3f"),
            Column(f"predicted_{p:g}", "to first order, px", ".3f"),
        ]
    rows = []
    for number, gap in enumerate(_GAPS_PX.tolist()):
        row = {"gap_px": gap}
        for p in NOISES:
            row[f"error_{p:g}"] = round(float(errors_px[p][number]), 4)
            predicted = predicted_error_px(_GAPS_PX[number : number + 1], p)
            row[f"predicted_{p:g}"] = round(float(predicted[0]), 4)
        rows.append(row)
    return ReportTable("figure_13", "Root mean square error", tuple(columns), tuple(rows))


def _chart(errors_px: _Errors) -> np.ndarray:
    lines = [Line(f"{p:.0%} noise", _GAPS_PX, errors) for p, errors in errors_px.items()]
    limit = Line("1 px", _GAPS_PX, np.ones_like(_GAPS_PX))
    return line_chart(
        "Error of an extrapolated edge",
        [*lines, limit],
        x_title="saturated gap, px",
        y_title="rms error, px",
    )


def _finding(noise_share: float, errors_px: Float[np.ndarray, "gap"]) -> str:
    covered = covered_gap_px(_GAPS_PX, errors_px)
    return (
        f"With {noise_share:.0%} of noise a gap of {covered:.1f} px is covered within 1 px of error "
        f"(the paper: {'more than ' if noise_share < 0.15 else ''}{_PAPERS_PX[noise_share]:g} px)."
    )
