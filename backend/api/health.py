"""How the parts are doing, for people and for a container's health check."""

import os
import shutil
from collections.abc import Callable, Iterator
from typing import Literal

from fastapi import APIRouter, Request, Response

from backend.api.access import MaybeWho, Who
from backend.api.context import Context, context_of
from backend.contract.base import Message
from backend.contract.problems import Identity
from backend.domain.errors import UnglareError

Status = Literal["ok", "warning", "failure"]
_LITTLE_ROOM_BYTES = 2 * 2**30
_WORST_FIRST: tuple[Status, ...] = ("failure", "warning", "ok")

router = APIRouter(tags=["operation"])
public = APIRouter(tags=["operation"])


class PartHealth(Message):
    """How one part is doing."""

    name: str
    status: Status
    sentence: str


class Health(Message):
    """How everything is doing; the worst part counts."""

    status: Status
    version: str
    parts: tuple[PartHealth, ...] = ()
    """Only for whoever is logged in."""


@router.get("/me")
async def me(who: Who) -> Identity:
    """Tell who the caller is; 401 tells a page that its session is over."""
    return Identity(user=who.user, role=who.role.value)


@public.get("/health", responses={503: {"model": Health, "description": "A part fails."}})
def health(request: Request, response: Response, who: MaybeWho) -> Health:
    """Tell how database, store, station and rigs are doing; strangers learn only whether all is well."""
    found = _health(context_of(request))
    response.status_code = 503 if found.status == "failure" else 200
    return found if who else found.model_copy(update={"parts": ()})


def _health(context: Context) -> Health:
    parts = tuple(_parts(context))
    worst = next(s for s in _WORST_FIRST if s == "ok" or any(p.status == s for p in parts))
    return Health(status=worst, version=context.version, parts=parts)


def _parts(context: Context) -> Iterator[PartHealth]:
    yield _tried("database", lambda: _database(context))
    yield _tried("store", lambda: _store(context))
    yield _station(context)
    yield _tried("rig", lambda: _rigs(context))


def _tried(name: str, look: Callable[[], tuple[Status, str]]) -> PartHealth:
    """Look at a part; what it raises is its state, not an error of the health check."""
    try:
        status, sentence = look()
    except (UnglareError, OSError) as error:
        status, sentence = "failure", str(error)
    return PartHealth(name=name, status=status, sentence=sentence)


def _database(context: Context) -> tuple[Status, str]:
    context.services.scans(1, 0, "")
    return "ok", "The database answers."


def _store(context: Context) -> tuple[Status, str]:
    folder = context.data_folder
    if not os.access(folder, os.W_OK):
        return "failure", f"The data folder {folder} can't be written; change its owner."
    free_bytes = shutil.disk_usage(folder).free
    sentence = f"{free_bytes / 2**30:.1f} GiB are free on the disk of {folder}."
    return ("warning" if free_bytes < _LITTLE_ROOM_BYTES else "ok"), sentence


def _station(context: Context) -> PartHealth:
    up = context.station.port is not None
    sentence = "The station is up." if up else context.station.message
    return PartHealth(name="station", status="ok" if up else "warning", sentence=sentence)


def _rigs(context: Context) -> tuple[Status, str]:
    offers = context.services.rigs()
    broken = [offer for offer in offers if offer.error]
    if broken:
        return "warning", f"Rig {broken[0].name} can't be used: {broken[0].error}"
    return "ok", f"Rigs to choose from: {', '.join(offer.name for offer in offers) or 'none'}."
