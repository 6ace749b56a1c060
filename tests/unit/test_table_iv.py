"""What the comparison with the paper's Table IV says of figures that are known."""

import numpy as np
import pytest

from backend.numerics.scoring import Score, Scores
from backend.services.measured import Measured, ratio
from backend.services.table_iv_tables import decoding_table, detail_table, findings, points_table
from backend.services.variants import Variant, touched_fields

NAN = float("nan")


def measured(name: str, black: float, shiny: float, *, outliers: float = 0.0) -> Measured:
    """Measure 1000 pixels of each part, so completely."""

    def score(share: float) -> Score:
        accepted = round(1000 * share / (1 - outliers))
        return Score(1000, accepted, share, outliers, 0.04, 0.03, 0.02, 0.0, 0.01, 0.001)

    parts = {"black": score(black), "shiny": score(shiny)}
    scores = Scores(score((black + shiny) / 2), parts, 0, 0, 0)
    return Measured(
        Variant(name, name, {}),
        exposure_ms=100.0,
        refinements=2,
        scores=scores,
        widening_px={"shiny": 0.2},
    )


SPRAYED = measured("sprayed", 1.0, 0.8)
RESULTS = [
    measured("mask", 0.99, 0.8, outliers=0.1),
    measured("no_mask_middle", 0.4, 0.7),
    measured("mask_fixed", 0.2, 0.3),
    Measured(Variant("no_mask_high", "no mask, high exposure", {}), "The lamp is broken."),
]


def test_points_are_compared_with_the_sprayed_part():
    rows = {row["part"]: row for row in points_table(SPRAYED, RESULTS).rows}
    assert list(rows) == ["all", "black", "shiny"]
    assert rows["shiny"]["sprayed"] == 800
    assert rows["shiny"]["mask"] == pytest.approx(800, abs=1)  # outliers don't count
    assert rows["shiny"]["mask_share"] == pytest.approx(1.0, abs=2e-3)
    assert rows["black"]["no_mask_middle_share"] == 0.4
    assert rows["black"]["no_mask_high"] is None
    assert rows["black"]["no_mask_high_share"] is None


def test_every_measurement_has_its_rows_and_a_failed_one_its_reason():
    rows = detail_table(SPRAYED, [SPRAYED, *RESULTS]).rows
    assert len(rows) == 3 * 3 + 1
    assert rows[-1] == {
        "variant": "no_mask_high",
        "exposure_ms": None,
        "refinements": None,
        "error": "The lamp is broken.",
    }
    shiny = next(r for r in rows if r["variant"] == "mask" and r["part"] == "shiny")
    assert shiny["widening_px"] == 0.2
    assert shiny["outlier_share"] == 0.1
    assert shiny["of_sprayed"] == pytest.approx(1.0, abs=2e-3)


def test_other_decodings_stand_beside_the_usual_one():
    rows = {(r["variant"], r["part"]): r for r in decoding_table(RESULTS).rows}
    black = rows["mask", "black"]
    assert (black["usual_completeness"], black["fixed_completeness"]) == (0.99, 0.2)
    assert black["dual_completeness"] is None
    assert ("no_mask_high", "black") not in rows


def test_findings_say_what_the_mask_brought():
    said = findings(SPRAYED, RESULTS)
    assert said[0].startswith("black: 99.00% of the truth under the mask, +59.0 points")
    assert "mean 0.0300 mm, standard deviation 0.0100 mm" in said[2]
    broken = Measured(Variant("sprayed", "sprayed", {}), "No spray left.")
    assert "No spray left." in findings(broken, RESULTS)[-1]
    assert points_table(broken, RESULTS).rows[0]["mask_share"] is None


def test_a_share_of_nothing_is_not_known():
    assert ratio(5, 0) is None
    assert ratio(None, 5) is None
    assert Measured(Variant("a", "a", {})).headline == "a: no points"
    empty = Score(0, 0, *[NAN] * 8)
    nothing = Measured(Variant("a", "a", {}), scores=Scores(empty, {}, 0, 0, 0))
    assert nothing.good_points("all") == 0
    assert nothing.figures("all")["rms_mm"] is None
    assert np.isnan(empty.rms_mm)


def test_fields_of_all_variants_are_reset():
    touched = touched_fields([{"a": {"x": 1}}, {"a": {"y": 2}, "b": {}}])
    assert touched == {"a": {"x", "y"}, "b": set()}
