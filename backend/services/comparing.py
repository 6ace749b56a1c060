"""The same scene by several exposure strategies, with figures and pictures: the paper's figures 4 and 7."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from backend.contract.requests import CreateScan
from backend.domain.frames import Frame
from backend.domain.shots import Progress
from backend.jobs.loading import LoadedScan, load_scan
from backend.numerics.scoring import Scores
from backend.services import scans
from backend.services.contact_sheet import Panel, Picture, Row, contact_sheet, drawn, png
from backend.services.context import Context
from backend.services.export_folder import FolderKind, refuse_foreign, whole_folder
from backend.services.reporting import report, truth_document
from backend.services.variants import Variant, present_result, run_variant, touched_fields
from backend.stages.cloud import Cloud
from backend.stages.exposures import Exposures
from backend.stages.fringe_capture import FringeFrames
from backend.stages.fringe_phase import AbsolutePhase
from backend.stages.pre_exposure import Preview

METHOD = "hdr-fringe"
COMPARISON = FolderKind("comparison.json", "unglare-comparison")
_WHO = "compare"


@dataclass(frozen=True)
class Strategy:
    """One way to choose exposures and to fuse them."""

    name: str
    title: str
    settings: Mapping[str, Mapping[str, Any]]
    """`{stage: {field: value}}`; fields of other strategies go back to their defaults."""
    time_of: str | None = None
    """Strategy whose light time is this one's budget."""


STRATEGIES = (
    Strategy("planned", "planned exposures, weighted fusion (default)", {}),
    Strategy(
        "paper",
        "one exposure per zone, fused by zone masks (the paper's)",
        {
            "exposures": {"strategy": "hdrsia"},
            "fusion": {"strategy": "masks"},
            "fringe_phase": {"unwrapping": "cascade"},
        },
    ),
    Strategy(
        "planned_same_time", "planned exposures within the paper's light time", {}, time_of="paper"
    ),
    Strategy(
        "paper_weighted",
        "the paper's exposures, weighted fusion",
        {"exposures": {"strategy": "hdrsia"}},
    ),
    Strategy("single_low", "one low exposure", {"exposures": {"strategy": "single_low"}}),
    Strategy("single_high", "one high exposure", {"exposures": {"strategy": "single_high"}}),
)


class Scale(NamedTuple):
    """Values at both ends of the colours: those of the first strategy, so that rows can be compared."""

    columns_px: tuple[float, float]
    depth_mm: tuple[float, float]


@dataclass(frozen=True)
class Compared:
    """What one strategy reached."""

    strategy: Strategy
    error: str | None = None
    """Why it reached nothing."""
    exposures_ms: tuple[float, ...] = ()
    light_s: float | None = None
    """Exposure time of all fringes."""
    total_s: float | None = None
    """Light of the preview's and of all fringes, plus the time of computing."""
    points: int | None = None
    scores: Scores | None = None
    panels: tuple[Panel, ...] = ()
    """Pictures of the reference camera."""
    scale: Scale | None = None
    """What the colours of its pictures mean."""


def compare(
    context: Context,
    scene_options: Mapping[str, Any],
    *,
    rig: str = "simulated",
    strategies: Sequence[Strategy] = STRATEGIES,
    progress: Progress | None = None,
) -> tuple[Compared, ...]:
    """Measure one scene by every strategy, as edits of one scan: equal shots are taken once.

    Parameters
    ----------
    context
        Database, store, rigs; its runner has to return from `start` when the job has ended.
    scene_options
        Options of the rig: scene, size, seed ...
    rig
        Has to know the truth for more than points and times.
    strategies
        What is compared, in this order.
    progress
        Is told the strategy.

    Raises
    ------
    UnglareError
        If the scan can't be made; what goes wrong in one strategy is said in its row.
    """
    name = f"Comparison on {scene_options.get('scene', 'the default scene')}"
    request = CreateScan(method=METHOD, rig=rig, rig_options=dict(scene_options), name=name)
    scan = scans.create_scan(context, request, _WHO).id
    results: dict[str, Compared] = {}
    for number, strategy in enumerate(strategies):
        if progress:
            progress(number / len(strategies), strategy.name)
        results[strategy.name] = _measure(context, scan, strategy, results)
    return tuple(results.values())


def _measure(
    context: Context, scan: str, strategy: Strategy, earlier: Mapping[str, Compared]
) -> Compared:
    budget_s = earlier[strategy.time_of].light_s if strategy.time_of else None
    if strategy.time_of and budget_s is None:
        return Compared(strategy, f"{strategy.time_of} took no time that could be given to it.")
    variant = Variant(strategy.name, strategy.title, _settings(strategy, budget_s))
    if error := run_variant(context, scan, variant, _TOUCHED, _WHO):
        return Compared(strategy, error)
    scale = next((c.scale for c in earlier.values() if c.scale), None)
    return _collect(context, scan, strategy, scale)


def _settings(strategy: Strategy, budget_s: float | None) -> dict[str, dict[str, Any]]:
    wanted: dict[str, dict[str, Any]] = {s: dict(f) for s, f in strategy.settings.items()}
    if budget_s is not None:
        wanted.setdefault("exposures", {})["budget_s"] = budget_s
    return wanted


_TOUCHED = touched_fields([{"exposures": {"budget_s": None}}, *(s.settings for s in STRATEGIES)])


def _collect(context: Context, scan: str, strategy: Strategy, scale: Scale | None) -> Compared:
    figures = report(context, scan)
    with context.database.reading() as repositories:
        loaded = load_scan(repositories, context.registry, scan)

        preview = present_result(context, repositories, loaded, Preview)
        exposures = present_result(context, repositories, loaded, Exposures)
        fringes = present_result(context, repositories, loaded, FringeFrames)
        phase = present_result(context, repositories, loaded, AbsolutePhase)
        cloud = present_result(context, repositories, loaded, Cloud)
    scale = scale or _scale(phase, cloud)
    return Compared(
        strategy=strategy,
        exposures_ms=exposures.exposures_ms,
        light_s=fringes.exposure_time_s,
        total_s=fringes.exposure_time_s + _computing_s(loaded),
        points=figures.points,
        scores=figures.scores,
        panels=_panels(preview, fringes, phase, cloud, scale),
        scale=scale,
    )


def _computing_s(loaded: LoadedScan) -> float:
    runs = [p.run for p in loaded.plan.stages if p.run and not p.stage.captures]
    return sum(run.duration_s or 0.0 for run in runs)


# pictures


def _scale(phase: AbsolutePhase, cloud: Cloud) -> Scale:
    name = next(iter(cloud.depth_mm))
    columns, depths = phase.projector_px[name], cloud.depth_mm[name]
    limits = [np.nanpercentile(values, [1, 99]).tolist() for values in (columns, depths)]
    return Scale(tuple(limits[0]), tuple(limits[1]))


def _panels(
    preview: Preview, fringes: FringeFrames, phase: AbsolutePhase, cloud: Cloud, scale: Scale
) -> tuple[Panel, ...]:
    """Draw the reference camera's pictures as the paper shows them."""
    name = next(iter(cloud.depth_mm))
    frames = [f for f in fringes.frames if f.camera == name]
    shortest, longest = (extreme(frames, key=_exposure_ms) for extreme in (min, max))
    wrapped = drawn(phase.wrapped_rad[name], "twilight", (-np.pi, np.pi))
    return (
        Panel(f"white field, {preview.t_pre_ms:.1f} ms", drawn(preview.white[name])),
        Panel(f"shortest exposure, {_exposure_ms(shortest):.1f} ms", drawn(shortest.gray)),
        Panel(f"longest exposure, {_exposure_ms(longest):.1f} ms", drawn(longest.gray)),
        Panel("wrapped phase", wrapped),
        Panel("absolute phase", drawn(phase.projector_px[name], "turbo", scale.columns_px)),
        Panel("depth of the points", drawn(cloud.depth_mm[name], "turbo", scale.depth_mm)),
    )


def _exposure_ms(frame: Frame) -> float:
    return frame.exposure_ms or 0.0


def _sheet(results: Sequence[Compared]) -> Picture:
    """Put the panels of one or several strategies side by side, a row for each."""
    rows = [Row(headline(result), result.panels) for result in results]
    return contact_sheet(rows, otherwise="no strategy has a cloud")


def headline(result: Compared) -> str:
    """Say a strategy and its figures in one line."""
    exposures = ", ".join(f"{t:.1f}" for t in result.exposures_ms)
    text = f"{result.strategy.name}: {exposures} ms, light {result.light_s or 0:.1f} s"
    if result.scores is None:
        return text
    total = result.scores.total
    return (
        f"{text}, {total.completeness:.2%} complete, {total.outlier_share:.3%} outliers, "
        f"rms {total.rms_mm:.3f} mm"
    )


# tables and files

FIGURES = ("completeness", "outlier_share", "rms_mm", "median_mm")
COLUMNS = ("strategy", *FIGURES, "points", "light_s", "total_s", "exposures_ms", "error")


def table_row(result: Compared) -> dict[str, Any]:
    """Return one strategy's figures by column; what it didn't reach is None."""
    figures = truth_document(result.scores).get("truth", {})
    return {
        "strategy": result.strategy.name,
        **{name: figures.get(name) for name in FIGURES},
        "points": result.points,
        "light_s": result.light_s,
        "total_s": result.total_s,
        "exposures_ms": list(result.exposures_ms),
        "error": result.error,
    }


def part_figures(result: Compared) -> dict[str, dict[str, Any]]:
    """Return the figures of each part of the scene; what can't be said is None."""
    return dict(truth_document(result.scores).get("parts", {}))


def write_comparison(folder: Path, results: Sequence[Compared]) -> tuple[Path, ...]:
    """Write `comparison.csv`, a contact sheet per strategy, one of all, and `comparison.json`; return the files.

    Raises
    ------
    ConflictError
        If the folder holds anything else than an older comparison, or can't be written.
    StorageFullError
        If there is no room; nothing is left behind.
    """
    with whole_folder(folder, COMPARISON) as target:
        target.write("comparison.csv", (_csv(results).encode(),))
        for result in results:
            if result.panels:
                target.write(f"{result.strategy.name}.png", (png(_sheet([result])),))
        target.write("overview.png", (png(_sheet(results)),))
        document = {
            "format": COMPARISON.format,
            "version": 1,
            "strategies": describe(results),
            "files": dict(target.hashes),
        }
        target.write_json(COMPARISON.index_file, document)
        names = sorted(target.hashes)
    return tuple(folder / name for name in names)


def refuse_folder(folder: Path) -> None:
    """Raise `ConflictError` if a comparison can't be written there: before long work is done for it."""
    refuse_foreign(folder.expanduser().absolute(), COMPARISON)


def describe(results: Sequence[Compared]) -> list[dict[str, Any]]:
    """Write all figures as JSON values."""
    return [table_row(r) | {"title": r.strategy.title, **truth_document(r.scores)} for r in results]


def _csv(results: Sequence[Compared]) -> str:
    """Write the table: one line per strategy and one per strategy and part."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["strategy", "part", *COLUMNS[1:]])
    for result in results:
        row = table_row(result)
        row["exposures_ms"] = " ".join(f"{t:.4g}" for t in result.exposures_ms)
        writer.writerow([row["strategy"], "all", *(row[name] for name in COLUMNS[1:])])
        for part, figures in part_figures(result).items():
            known = [figures[name] for name in (*FIGURES, "accepted")]
            writer.writerow([row["strategy"], part, *known])
    return text.getvalue()
