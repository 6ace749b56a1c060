"""What Prometheus collects, in its text format (version 0.0.4)."""

import shutil
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from fastapi import APIRouter, Request
from starlette.responses import PlainTextResponse

from backend.api.context import Context, context_of

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"

router = APIRouter(tags=["operation"])


class Sample(NamedTuple):
    """One value of a metric."""

    value: float
    labels: Mapping[str, str] = {}
    suffix: str = ""
    """`_sum` and `_count` of a summary."""


class Metric(NamedTuple):
    """One metric with its samples."""

    name: str
    kind: str
    help: str
    samples: tuple[Sample, ...]


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(request: Request) -> PlainTextResponse:
    """Count jobs, stage runs, frames, sessions and free bytes, for Prometheus."""
    return PlainTextResponse(exposition(_metrics(context_of(request))), media_type=MEDIA_TYPE)


def exposition(metrics: Iterable[Metric]) -> str:
    r"""Write metrics as text.

    Examples
    --------
    >>> print(exposition([Metric("frames_total", "counter", "Frames.", (Sample(3),))]), end="")
    # HELP frames_total Frames.
    # TYPE frames_total counter
    frames_total 3
    """
    return "".join(line + "\n" for metric in metrics for line in _lines(metric))


def _lines(metric: Metric) -> Iterator[str]:
    yield f"# HELP {metric.name} {metric.help}"
    yield f"# TYPE {metric.name} {metric.kind}"
    for sample in metric.samples:
        labels = ",".join(f'{key}="{_escaped(value)}"' for key, value in sample.labels.items())
        braces = f"{{{labels}}}" if labels else ""
        yield f"{metric.name}{sample.suffix}{braces} {sample.value:.17g}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _metrics(context: Context) -> Iterator[Metric]:
    counted = context.services.statistics()
    yield Metric("unglare_scans", "gauge", "Scans.", (Sample(counted.scans),))
    yield Metric(
        "unglare_jobs",
        "gauge",
        "Jobs by status.",
        tuple(Sample(n, {"status": status}) for status, n in sorted(counted.jobs.items())),
    )
    yield Metric("unglare_frames_total", "counter", "Captured frames.", (Sample(counted.frames),))
    yield Metric(
        "unglare_stage_runs",
        "gauge",
        "Runs of stages by status.",
        tuple(
            Sample(run.count, {"stage": run.stage, "status": run.status}) for run in counted.runs
        ),
    )
    yield Metric(
        "unglare_stage_duration_seconds",
        "summary",
        "Time that finished runs of a stage took.",
        tuple(
            sample
            for run in counted.runs
            if run.status == "finished"
            for sample in (
                Sample(run.duration_s, {"stage": run.stage}, "_sum"),
                Sample(run.count, {"stage": run.stage}, "_count"),
            )
        ),
    )
    yield from _process_metrics(context)


def _process_metrics(context: Context) -> Iterator[Metric]:
    disk = shutil.disk_usage(context.data_folder)
    up = float(context.station.port is not None)
    gauges = (
        ("unglare_disk_free_bytes", "Free bytes on the disk of the data folder.", disk.free),
        ("unglare_disk_size_bytes", "Size of that disk.", disk.total),
        ("unglare_station_up", "1 while the station's process is up.", up),
        ("unglare_sessions", "Browsers that are logged in.", len(context.sessions)),
        ("unglare_station_sockets", "Open websockets to the station.", context.sockets.count),
    )
    for name, help_text, value in gauges:
        yield Metric(name, "gauge", help_text, (Sample(float(value)),))
    info = Sample(1, {"version": context.version})
    yield Metric("unglare_info", "gauge", "Version of the server.", (info,))
