"""The paper's Table IV: a scene without mask at two exposures, and under the mask, against the sprayed scene and the truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from backend.contract.requests import CreateScan, StartRun
from backend.domain.errors import StageUnavailableError
from backend.domain.rig import RigFacts
from backend.domain.shots import Progress
from backend.jobs.loading import load_scan
from backend.numerics.scoring import DEFINITION, Truth
from backend.services import running, scans
from backend.services.contact_sheet import Panel, Row, contact_sheet, drawn
from backend.services.context import Context
from backend.services.measured import Measured
from backend.services.report_document import Figure, Report
from backend.services.reporting import compare_with_truth, error_map, reference_camera, rig_truth
from backend.services.table_iv_tables import (
    DECODINGS,
    SHOWN,
    decoding_table,
    detail_table,
    findings,
    points_table,
)
from backend.services.variants import (
    SettingsOfStages,
    Variant,
    present_result,
    run_variant,
    touched_fields,
)
from backend.stages.base_exposure import BaseExposure
from backend.stages.cloud import Cloud
from backend.stages.edges import Codes
from backend.stages.intensity_mask import IntensityMask
from backend.stages.pre_exposure import Preview

METHOD = "adaptive-code"
_WHO = "report"
_REFINEMENTS = ("refine_1", "refine_2", "refine_3")
_ERROR_MM = 0.2
"""At the ends of the colours of the error."""

_INTRODUCTION = (
    "The same scene without an intensity mask at a middle exposure, without one at the exposure that the method takes for "
    "black parts, and under the mask that the rig found by itself; in the manner of the paper's Table IV. The reference "
    "is the same scene sprayed matte white, measured without a mask at the longest exposure that saturates nothing.",
    "Middle exposure: the geometric mean of the longest exposure that saturates nothing of the unsprayed scene and the "
    "high one. Completeness against the sprayed scan: good points of a part over good points of the same part when "
    "sprayed; a point is good if it is off by at most 0.5 mm. White - black: by how many projector pixels white stripes "
    "are wider than black ones, median of the part (the paper's figures 17 and 19). Decoding beside the usual one: dual compares pattern and "
    "inverse without a margin, fixed compares each pattern with half of the full scale.",
    DEFINITION,
)


class _Exposures(NamedTuple):
    """Exposures of the variants in [ms]."""

    middle_ms: float
    high_ms: float
    sprayed_ms: float


def table_iv(
    context: Context,
    scene_options: Mapping[str, Any],
    *,
    rig: str = "simulated",
    progress: Progress | None = None,
) -> Report:
    """Measure a scene with and without the mask, and sprayed.

    Parameters
    ----------
    context
        Its runner has to return from `start` when the job has ended.
    scene_options
        Options of the rig: scene, size, seed ... The scene is one that can be sprayed.
    rig
        Has to know the truth.
    progress
        Is told what is measured.

    Raises
    ------
    UnglareError
        If the scan can't be made, or the mask's scan fails; what goes wrong otherwise is said in its row.
    """
    tell = progress or _say_nothing
    scene = str(scene_options.get("scene", "workpieces"))
    options = {**scene_options, "scene": scene}
    sprayed = {**options, "scene": f"sprayed:{scene}"}
    tell(0.0, "under the mask")
    work = _Scan.begin(context, rig, options)
    masked = work.measure(Variant("mask", "under the intensity mask", {}))
    if masked.error is not None:
        raise StageUnavailableError(masked.error)
    tell(0.3, "exposures")
    exposures = _exposures(context, rig, options, sprayed, masked)
    results = [masked]
    variants = _variants(work.no_mask, exposures)
    for number, variant in enumerate(variants):
        tell(0.4 + 0.5 * number / len(variants), variant.name)
        results.append(work.measure(variant))
    tell(0.9, "sprayed")
    reference = _Scan.begin(context, rig, sprayed).measure_without_mask(
        "sprayed", "sprayed, no mask", exposures.sprayed_ms
    )
    return _report(scene, options, exposures, reference, results)


def _say_nothing(done: float, text: str = "") -> None:
    """Tell nobody."""


def _variants(no_mask: SettingsOfStages, exposures: _Exposures) -> tuple[Variant, ...]:
    """List what is measured beside the mask; naive decoding uses the same frames."""

    def fixed(settings: SettingsOfStages, decoding: str) -> SettingsOfStages:
        return {**settings, "edges": {"decoding": decoding}}

    middle = {**no_mask, "base_exposure": {"exposure_ms": exposures.middle_ms}}
    found: list[Variant] = []
    for name, title, settings in (
        ("no_mask_middle", "no mask, middle exposure", middle),
        ("no_mask_high", "no mask, high exposure", no_mask),
        ("mask", "under the intensity mask", {}),
    ):
        if name != "mask":
            found.append(Variant(name, title, settings))
        found += [
            Variant(
                f"{name}_{decoding}", f"{title}, {decoding} decoding", fixed(settings, decoding)
            )
            for decoding in DECODINGS
        ]
    return tuple(found)


@dataclass(frozen=True)
class _Scan:
    """One scan of a scene, measured in several ways."""

    context: Context
    id: str
    no_mask: SettingsOfStages
    touched: Mapping[str, set[str]]

    @classmethod
    def begin(cls, context: Context, rig: str, options: Mapping[str, Any]) -> "_Scan":
        """Make the scan, and a mask that changes nothing."""
        name = f"Completeness on {options['scene']}"
        request = CreateScan(method=METHOD, rig=rig, rig_options=dict(options), name=name)
        scan = scans.create_scan(context, request, _WHO).id
        facts = context.rigs.given(rig, options).facts
        no_mask = _no_mask(context, facts)
        beside = {"base_exposure": {"exposure_ms": None}, "edges": {"decoding": None}}
        return cls(context, scan, no_mask, touched_fields([no_mask, beside]))

    def measure_without_mask(self, name: str, title: str, exposure_ms: float) -> Measured:
        """Measure with full light at an exposure."""
        settings = {**self.no_mask, "base_exposure": {"exposure_ms": exposure_ms}}
        return self.measure(Variant(name, title, settings))

    def measure(self, variant: Variant) -> Measured:
        """Run one variant and collect what it reached."""
        if error := run_variant(self.context, self.id, variant, self.touched, _WHO):
            return Measured(variant, error)
        with self.context.database.reading() as repositories:
            loaded = load_scan(repositories, self.context.registry, self.id)
            base = present_result(self.context, repositories, loaded, BaseExposure)
            mask = present_result(self.context, repositories, loaded, IntensityMask)
            codes = present_result(self.context, repositories, loaded, Codes)
            cloud = present_result(self.context, repositories, loaded, Cloud)
        truth = rig_truth(self.context, loaded, reference_camera(cloud), cloud.cameras)
        if truth is None:
            raise StageUnavailableError(
                f"The rig of {loaded.title!r} doesn't know the truth: make this report with the simulated one."
            )
        return Measured(
            variant,
            exposure_ms=base.exposure_ms,
            refinements=mask.round,
            scores=compare_with_truth(cloud, truth),
            widening_px=_widening_px(codes, truth, reference_camera(cloud)),
            panels=_panels(base, mask, codes, cloud, truth),
        )


def _no_mask(context: Context, facts: RigFacts) -> SettingsOfStages:
    """Paint the mask white, and leave it so."""
    if facts.projector is None:
        raise StageUnavailableError("The rig has no projector: a mask needs one.")
    white = np.ones((facts.projector.height_px, facts.projector.width_px), np.float32)
    painted = context.store.put(white).hash
    return {"flat_mask": {"paint": painted}, **{name: {"run": "no"} for name in _REFINEMENTS}}


def _exposures(
    context: Context,
    rig: str,
    options: Mapping[str, Any],
    sprayed: Mapping[str, Any],
    masked: Measured,
) -> _Exposures:
    assert masked.exposure_ms is not None, "the caller refused a scan that failed"
    high_ms = masked.exposure_ms
    unsaturated_ms = _unsaturated_ms(context, rig, options)
    middle_ms = math.sqrt(unsaturated_ms * high_ms)
    projector = context.rigs.given(rig, options).facts.projector
    period_ms = projector.frame_period_ms if projector else None
    if period_ms:
        middle_ms = max(1, round(middle_ms / period_ms)) * period_ms
    return _Exposures(middle_ms, high_ms, _unsaturated_ms(context, rig, sprayed))


def _unsaturated_ms(context: Context, rig: str, options: Mapping[str, Any]) -> float:
    """Find the longest exposure at which a white field saturates nothing, as hdr-fringe does."""
    request = CreateScan(
        method="hdr-fringe",
        rig=rig,
        rig_options=dict(options),
        name=f"Exposure of {options['scene']}",
    )
    scan = scans.create_scan(context, request, _WHO).id
    state = running.run(context, scan, StartRun(until="pre_exposure", unattended=True), _WHO)
    if state.job and state.job.error:
        raise StageUnavailableError(state.job.error)
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)
        return present_result(context, repositories, loaded, Preview).t_pre_ms


# figures


def _widening_px(codes: Codes, truth: Truth, camera: str) -> dict[str, float]:
    widening = codes.widening_px.get(camera)
    if widening is None:
        return {}
    found = {}
    for index, name in enumerate(truth.part_names):
        values = widening[truth.base & (truth.part == index)]
        values = values[np.isfinite(values)]
        if values.size:
            found[name] = float(np.median(values))
    return found


def _panels(
    base: BaseExposure, mask: IntensityMask, codes: Codes, cloud: Cloud, truth: Truth
) -> tuple[Panel, ...]:
    name = reference_camera(cloud)
    masked = name in mask.white
    white = mask.white[name] if masked else base.white[name]
    depths = truth.points_mm[..., 2][truth.lit_and_seen]
    low, high = np.nanpercentile(depths, [1, 99]).tolist()
    return (
        Panel("intensity mask", drawn(mask.factor, limits=(0.0, 1.0))),
        Panel(f"white field, {base.exposure_ms:.0f} ms", drawn(white)),
        Panel("projector column", drawn(codes.projector_px[name], "turbo")),
        Panel("missing because", drawn(cloud.reasons[name], kind="mask")),
        Panel("depth of the points", drawn(_depth_mm(cloud, truth), "turbo", (low, high))),
        Panel(
            f"off the truth, -{_ERROR_MM} to {_ERROR_MM} mm",
            drawn(error_map(cloud, truth), "turbo", (-_ERROR_MM, _ERROR_MM)),
        ),
    )


def _depth_mm(cloud: Cloud, truth: Truth) -> Float32[np.ndarray, "h w"]:
    depth_mm = np.full(truth.part.shape, np.nan, np.float32)
    y, x = (np.rint(values).astype(np.int64) for values in (cloud.pixel_y, cloud.pixel_x))
    depth_mm[y, x] = cloud.points_mm[:, 2]
    return depth_mm


def _report(
    scene: str,
    options: Mapping[str, Any],
    exposures: _Exposures,
    reference: Measured,
    results: Sequence[Measured],
) -> Report:
    everything = [reference, *results]
    rows = [Row(m.headline, m.panels) for m in everything if m.variant.name in ("sprayed", *SHOWN)]
    return Report(
        name="table-iv",
        title=f"Completeness with and without the intensity mask: {scene}",
        introduction=_INTRODUCTION,
        tables=(
            points_table(reference, results),
            detail_table(reference, everything),
            decoding_table(results),
        ),
        figures=(
            Figure(
                "table_iv",
                "Every measurement, from the white field to the error",
                contact_sheet(rows),
            ),
        ),
        findings=findings(reference, results),
        facts={"exposures_ms": exposures._asdict(), "rig_options": dict(options)},
    )
