"""The FastAPI application: routers, guard, errors, and what lives as long as it does."""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from typing import Any

import anyio.to_thread
from fastapi import APIRouter, Depends, FastAPI

from backend.api import (
    artifacts,
    calibrations,
    docs,
    events,
    health,
    imports,
    metrics,
    pages,
    problems,
    projector_page,
    proxy,
    scans,
)
from backend.api import rigs as rig_routes
from backend.api.access import authorised
from backend.api.context import Context
from backend.api.guard import Guard
from backend.api.station import Station

_log = logging.getLogger(__name__)

DESCRIPTION = "Measure shiny, black and mirror-like parts by structured light, stage by stage."


def create_api(context: Context, *, station: Station | None = None, threads: int = 16) -> FastAPI:
    """Make the application.

    Parameters
    ----------
    context
        What the endpoints work with; its services are closed at the end.
    station
        The station's process, run as long as the application; None: none is started.
    threads
        So many blocking endpoints run at once; the event loop itself never blocks.
    """
    app = FastAPI(
        title="unglare",
        version=context.version,
        description=DESCRIPTION,
        lifespan=_lifespan(context, station, threads),
        docs_url=None,  # our own page: the usual ones load scripts from the internet
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.context = context
    app.include_router(_everything())
    app.add_middleware(Guard, unlimited=frozenset({imports.UPLOAD_PATH, artifacts.UPLOAD_PATH}))
    problems.install(app)
    _describe_by(app)
    return app


def _everything() -> APIRouter:
    # Who may do what is decided here, once, for all of /api: an endpoint can't forget it.
    private = APIRouter(
        prefix="/api", dependencies=[Depends(authorised)], responses=docs.PROBLEM_RESPONSES
    )
    for module in (
        scans, rig_routes, calibrations, artifacts, imports, events, health, metrics, docs,
    ):  # fmt: skip
        private.include_router(module.router)
    everything = APIRouter()
    everything.include_router(private)
    everything.include_router(health.public, prefix="/api")
    everything.include_router(docs.page)
    everything.include_router(pages.router)
    everything.include_router(projector_page.router)
    everything.include_router(proxy.router)
    return everything


def _lifespan(context: Context, station: Station | None, threads: int) -> Any:
    @contextlib.asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = threads
        running = asyncio.create_task(station.run()) if station else None
        if running is not None:
            running.add_done_callback(_log_defect)
        try:
            yield
        finally:
            context.sessions.end_all()
            if running is not None:
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
            # Here and not behind the server: a signal may end the process there.
            await anyio.to_thread.run_sync(context.services.close)

    return lifespan


def _log_defect(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()):
        _log.error("The station is watched no longer: a defect.", exc_info=error)


def _describe_by(app: FastAPI) -> None:
    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = docs.described(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend it
