"""The tables of the comparison with and without the intensity mask, and what they say."""

from collections.abc import Sequence
from typing import Any

from backend.services.measured import WHOLE, Measured, known, ratio
from backend.services.report_document import Column, ReportTable

SHOWN = {
    "no_mask_middle": "no mask, middle",
    "no_mask_high": "no mask, high",
    "mask": "mask",
}
"""Variants beside the sprayed scene, in the order of the paper's columns, as the tables call them."""

DECODINGS = ("dual", "fixed")
"""Ways to read the same frames, beside the usual one."""


def points_table(reference: Measured, results: Sequence[Measured]) -> ReportTable:
    """Write the table as the paper has it: points of each part, and their share of the sprayed part's."""
    by_name = {m.variant.name: m for m in results}
    columns = [Column("part", "part"), Column("sprayed", "sprayed", "d")]
    for name, title in SHOWN.items():
        columns += [
            Column(name, title, "d"),
            Column(f"{name}_share", "of sprayed", ".1%"),
            Column(f"{name}_truth", "of truth", ".2%"),
        ]
    rows = []
    for part in reference.all_parts or by_name["mask"].all_parts:
        row: dict[str, Any] = {"part": part, "sprayed": reference.good_points(part)}
        for name in SHOWN:
            score = by_name[name].all_parts.get(part)
            row[name] = by_name[name].good_points(part)
            row[f"{name}_share"] = ratio(row[name], row["sprayed"])
            row[f"{name}_truth"] = known(score.completeness) if score else None
        rows.append(row)
    return ReportTable(
        "table_iv", "Good points of each part (the paper's Table IV)", tuple(columns), tuple(rows)
    )


def detail_table(reference: Measured, everything: Sequence[Measured]) -> ReportTable:
    """Write the figures of every measurement with the usual decoding, part by part."""
    columns: tuple[Column, ...] = (
        Column("variant", "frames"),
        Column("exposure_ms", "ms", ".0f"),
        Column("refinements", "rounds", "d"),
        Column("part", "part"),
        Column("points", "good points", "d"),
        Column("of_sprayed", "of sprayed", ".2%"),
        Column("completeness", "of truth", ".2%"),
        Column("outlier_share", "outliers", ".3%"),
        Column("over_exposed_share", "over-exp.", ".2%"),
        Column("mean_mm", "mean mm", ".4f"),
        Column("std_mm", "std mm", ".4f"),
        Column("rms_mm", "rms mm", ".4f"),
        Column("widening_px", "white - black px", "+.2f"),
        Column("error", "error"),
    )
    usual = [m for m in everything if m.variant.name in ("sprayed", *SHOWN)]
    rows = [row for measured in usual for row in _detail_rows(measured, reference)]
    if not any(row["error"] for row in rows):
        columns = columns[:-1]
    return ReportTable("measurements", "Every measurement in figures", columns, tuple(rows))


def decoding_table(results: Sequence[Measured]) -> ReportTable:
    """Write what naive and plain dual decoding make of the same frames."""
    by_name = {m.variant.name: m for m in results}
    columns = [Column("variant", "frames"), Column("part", "part")]
    for decoding in ("usual", *DECODINGS):
        columns += [
            Column(f"{decoding}_completeness", f"{decoding}, of truth", ".2%"),
            Column(f"{decoding}_outlier_share", "outliers", ".3%"),
        ]
    rows = []
    for name in SHOWN:
        names = {"usual": name} | {d: f"{name}_{d}" for d in DECODINGS}
        for part in by_name[name].all_parts:
            row: dict[str, Any] = {"variant": name, "part": part}
            for decoding, variant in names.items():
                figures = by_name[variant].figures(part) if variant in by_name else {}
                row[f"{decoding}_completeness"] = figures.get("completeness")
                row[f"{decoding}_outlier_share"] = figures.get("outlier_share")
            rows.append(row)
    return ReportTable("decoding", "Other decoding of the same frames", tuple(columns), tuple(rows))


def _detail_rows(measured: Measured, reference: Measured) -> list[dict[str, Any]]:
    common = {
        "variant": measured.variant.name,
        "exposure_ms": measured.exposure_ms,
        "refinements": measured.refinements,
        "error": measured.error,
    }
    if measured.scores is None:
        return [common]
    return [
        common
        | {
            "part": part,
            "points": measured.good_points(part),
            "of_sprayed": ratio(measured.good_points(part), reference.good_points(part)),
            "widening_px": known((measured.widening_px or {}).get(part)),
            **measured.figures(part),
        }
        for part in measured.all_parts
    ]


def findings(reference: Measured, results: Sequence[Measured]) -> tuple[str, ...]:
    """Say in a sentence each what the mask brought."""
    by_name = {m.variant.name: m for m in results}
    mask, middle = by_name["mask"], by_name["no_mask_middle"]
    found = []
    for part, score in mask.all_parts.items():
        if part == WHOLE:
            continue
        text = f"{part}: {score.completeness:.2%} of the truth under the mask"
        before = middle.all_parts.get(part)
        if before is not None:
            points = 100 * (score.completeness - before.completeness)
            text += f", {points:+.1f} points over no mask at a middle exposure"
        found.append(f"{text}.")
    total = mask.all_parts.get(WHOLE)
    if total is not None:
        found.append(
            f"Distance to the truth under the mask: mean {total.mean_mm:.4f} mm, standard deviation "
            f"{total.std_mm:.4f} mm; {total.outlier_share:.3%} outliers, after {mask.refinements} refinements."
        )
    if reference.error:
        found.append(f"The sprayed scene couldn't be measured: {reference.error}")
    return tuple(found)
