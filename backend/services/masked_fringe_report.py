"""What fringes under the intensity mask bring beside those without it, in the same light time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from backend.contract.requests import CreateScan
from backend.domain.errors import StageUnavailableError
from backend.domain.shots import Progress
from backend.jobs.loading import LoadedScan, load_scan
from backend.numerics.scoring import DEFINITION, Truth
from backend.services import scans
from backend.services.contact_sheet import Panel, Row, contact_sheet, drawn
from backend.services.context import Context
from backend.services.measured import WHOLE, Measured
from backend.services.report_document import Column, Figure, Report, ReportTable
from backend.services.reporting import (
    compare_with_truth,
    error_map,
    reference_camera,
    report,
    rig_truth,
)
from backend.services.variants import Variant, present_result, run_variant, touched_fields
from backend.stages.band_capture import BandFrames
from backend.stages.cloud import Cloud
from backend.stages.fringe_capture import FringeFrames
from backend.stages.pre_exposure import Preview
from backend.storage.repositories import Repositories

_WHO = "report"
_ERROR_MM = 0.2
_TOUCHED = touched_fields([{"band_capture": {"run": None}, "exposures": {"budget_s": None}}])

_INTRODUCTION = (
    "The same scene by fringes at planned exposures (hdr-fringe), by fringes under the intensity mask that the rig finds "
    "by itself (masked-fringe, mask only), by those and further ones that light part of the epipolar lines at a time "
    "where points contradict (masked-fringe), and by hdr-fringe given the light time of all of masked-fringe's fringes.",
    "Light: exposure time of the fringes; in all: of every picture, the search for exposures and mask included. Both are "
    "one camera's, but under bands cameras take turns, so both cameras' count.",
    DEFINITION,
)


def masked_fringe_report(
    context: Context,
    scene_options: Mapping[str, Any],
    *,
    rig: str = "simulated",
    progress: Progress | None = None,
) -> Report:
    """Measure a scene by fringes without mask, under it, and under bands of epipolar lines.

    Parameters
    ----------
    context
        Its runner has to return from `start` when the job has ended.
    scene_options
        Options of the rig: scene, size, seed ...
    rig
        Has to know the truth.
    progress
        Is told what is measured.

    Raises
    ------
    UnglareError
        If a scan can't be made; what goes wrong in one measurement is said in its row.
    """
    scene = str(scene_options.get("scene", "metal"))
    options = {**scene_options, "scene": scene}

    def tell(done: float, text: str) -> None:
        if progress:
            progress(done, text)

    tell(0.0, "hdr-fringe")
    plain = _Scan.begin(context, "hdr-fringe", rig, options)
    masked = _Scan.begin(context, "masked-fringe", rig, options)
    results = [plain.measure(Variant("hdr-fringe", "fringes at planned exposures", {}))]
    tell(0.2, "mask only")
    results.append(
        masked.measure(Variant("mask-only", "under the mask", {"band_capture": {"run": "no"}}))
    )
    tell(0.5, "masked-fringe")
    results.append(masked.measure(Variant("masked-fringe", "under mask and bands", {})))
    tell(0.8, "hdr-fringe, same light")
    budget_s = results[-1].light_s
    if budget_s:
        settings = {"exposures": {"budget_s": round(budget_s, 3)}}
        results.append(
            plain.measure(
                Variant("hdr-fringe-same-light", "planned exposures, same light", settings)
            )
        )
    return _report(scene, options, results)


@dataclass(frozen=True)
class _Scan:
    """One scan by one method."""

    context: Context
    id: str
    method: str

    @classmethod
    def begin(cls, context: Context, method: str, rig: str, options: Mapping[str, Any]) -> "_Scan":
        """Make the scan."""
        name = f"{method} on {options['scene']}"
        request = CreateScan(method=method, rig=rig, rig_options=dict(options), name=name)
        return cls(context, scans.create_scan(context, request, _WHO).id, method)

    def measure(self, variant: Variant) -> Measured:
        """Run one variant and collect what it reached."""
        stages = {s.name for s in self.context.registry.get(self.method).stages}
        touched = {stage: fields for stage, fields in _TOUCHED.items() if stage in stages}
        if error := run_variant(self.context, self.id, variant, touched, _WHO):
            return Measured(variant, error)
        figures = report(self.context, self.id)
        with self.context.database.reading() as repositories:
            loaded = load_scan(repositories, self.context.registry, self.id)
            cloud = present_result(self.context, repositories, loaded, Cloud)
            preview = present_result(self.context, repositories, loaded, Preview)
            light_s = _light_s(self.context, repositories, loaded)
        truth = rig_truth(self.context, loaded, reference_camera(cloud), cloud.cameras)
        if truth is None:
            raise StageUnavailableError(
                f"The rig of {loaded.title!r} doesn't know the truth: make this report with the simulated one."
            )
        return Measured(
            variant,
            scores=compare_with_truth(cloud, truth),
            light_s=light_s,
            all_light_s=figures.light_s,
            panels=_panels(preview, cloud, truth),
        )


def _light_s(context: Context, repositories: Repositories, loaded: LoadedScan) -> float:
    """Return the exposure time of all fringes, those under bands included."""
    light_s = present_result(context, repositories, loaded, FringeFrames).exposure_time_s
    if any(planned.stage.output is BandFrames for planned in loaded.plan.stages):
        light_s += present_result(context, repositories, loaded, BandFrames).exposure_time_s
    return light_s


def _panels(preview: Preview, cloud: Cloud, truth: Truth) -> tuple[Panel, ...]:
    name = reference_camera(cloud)
    depths = truth.points_mm[..., 2][truth.lit_and_seen]
    low, high = float(depths.min()), float(depths.max())
    return (
        Panel(f"white field, {preview.t_pre_ms:.1f} ms", drawn(preview.white[name])),
        Panel("depth of the points", drawn(cloud.depth_mm[name], "turbo", (low, high))),
        Panel("missing because", drawn(cloud.reasons[name], kind="mask")),
        Panel(
            f"off the truth, -{_ERROR_MM} to {_ERROR_MM} mm",
            drawn(error_map(cloud, truth), "turbo", (-_ERROR_MM, _ERROR_MM)),
        ),
    )


def _report(scene: str, options: Mapping[str, Any], results: Sequence[Measured]) -> Report:
    rows = [Row(measured.headline, measured.panels) for measured in results]
    return Report(
        name="masked-fringe",
        title=f"Fringes with and without the intensity mask: {scene}",
        introduction=_INTRODUCTION,
        tables=(_table(results),),
        figures=(
            Figure(
                "masked_fringe",
                "Every measurement, from the white field to the error",
                contact_sheet(rows),
            ),
        ),
        findings=_findings(results),
        facts={"rig_options": dict(options)},
    )


def _table(results: Sequence[Measured]) -> ReportTable:
    columns = (
        Column("variant", "measurement"),
        Column("part", "part"),
        Column("completeness", "complete", ".2%"),
        Column("outlier_share", "outliers", ".3%"),
        Column("over_exposed_share", "over-exposed", ".2%"),
        Column("rms_mm", "rms mm", ".4f"),
        Column("mean_mm", "mean mm", ".4f"),
        Column("light_s", "light s", ".1f"),
        Column("all_light_s", "in all s", ".1f"),
        Column("error", "error"),
    )
    rows: list[dict[str, Any]] = []
    for measured in results:
        common = {
            "variant": measured.variant.name,
            "light_s": measured.light_s,
            "all_light_s": measured.all_light_s,
            "error": measured.error,
        }
        parts = tuple(measured.all_parts) or (WHOLE,)
        rows += [common | {"part": part, **measured.figures(part)} for part in parts]
    return ReportTable("masked_fringe", "Every measurement in figures", columns, tuple(rows))


def _findings(results: Sequence[Measured]) -> tuple[str, ...]:
    by_name = {measured.variant.name: measured for measured in results}
    best = by_name["masked-fringe"].all_parts
    other = by_name.get("hdr-fringe-same-light", by_name["hdr-fringe"]).all_parts
    return tuple(
        f"{part}: {100 * (best[part].completeness - other[part].completeness):+.2f} points of completeness over "
        f"hdr-fringe in the same light time, outliers {best[part].outlier_share:.3%} instead of "
        f"{other[part].outlier_share:.3%}, rms {best[part].rms_mm:.4f} instead of {other[part].rms_mm:.4f} mm."
        for part in best
        if part in other
    )
