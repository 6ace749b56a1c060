"""The error of an extrapolated edge over the gap's width: against theory, and the paper's two figures."""

import numpy as np
import pytest

from backend.numerics.edge_tolerance import (
    covered_gap_px,
    extrapolation_errors,
    predicted_error_px,
)
from backend.services.edge_tolerance import edge_tolerance


def test_without_noise_the_edge_is_in_the_middle():
    assert np.abs(extrapolation_errors(np.array([1.0, 9.0, 30.0]), 0.0, draws=3)).max() < 1e-12


def test_errors_grow_with_gap_and_noise_as_predicted():
    gaps_px = np.array([2.0, 8.0, 25.0])
    for share in (0.02, 0.05, 0.1):
        errors = extrapolation_errors(gaps_px, share, draws=40_000)
        np.testing.assert_allclose(
            errors.std(axis=1), predicted_error_px(gaps_px, share), rtol=0.02
        )
        assert np.abs(errors.mean(axis=1)).max() < 0.02


def test_a_gap_that_is_never_too_wide_is_the_last_one():
    gaps_px = np.array([0.0, 5.0])
    assert covered_gap_px(gaps_px, np.array([0.0, 0.5])) == 5.0
    assert covered_gap_px(gaps_px, np.array([2.0, 3.0])) == 0.0


def test_the_report_has_the_papers_figures():
    found = edge_tolerance(draws=5000)
    covered = found.facts["covered_gap_px"]
    assert covered["10%"] > 20
    assert covered["20%"] == pytest.approx(12, abs=0.5)
    assert found.figures[0].picture.ndim == 3
    assert "more than 20 px" in found.findings[0]
