"""The composition root: from settings to the running application."""

import contextlib
import fcntl
import logging
import os
import secrets
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from fastapi import FastAPI

from backend.api.application import create_api
from backend.api.context import Context
from backend.api.server import TokensHidden, public_socket, server_for
from backend.api.sessions import Sessions, Tokens
from backend.api.station import Station
from backend.contract.rigs import RigOffer
from backend.devices.pages import PageDesk
from backend.devices.protocols import Rig
from backend.devices.rig_shelf import RigShelf
from backend.domain.errors import StartupError
from backend.jobs.execution import Workshop
from backend.jobs.rigs import OpenRig, RigPool
from backend.jobs.runner import InlineRunner, LocalRunner, Runner
from backend.methods import registry
from backend.numerics.warm_up import warm_up
from backend.services.events import EventHub
from backend.services.rig_offers import offer_kept_rigs, offer_rigs
from backend.services.services import Services
from backend.settings import Settings, load_settings
from backend.storage.artifacts import LocalArtifactStore
from backend.storage.database import Database

_log = logging.getLogger(__name__)
_EVERYWHERE = frozenset({"0.0.0.0", "::", ""})  # noqa: S104  compared with, not bound to


def local_runner(shop: Workshop) -> Runner:
    """Run pure stages in a worker process whose kernels are compiled before the first scan."""
    return LocalRunner(shop, warm_up=warm_up)


def build_services(
    settings: Settings,
    *,
    make_runner: Callable[[Workshop], Runner] = local_runner,
    pages: PageDesk | None = None,
) -> Services:
    """Open database and store, and put the services on top.

    Parameters
    ----------
    settings
        Where the data are.
    pages
        The projector pages of the application; None: no page can be reached.
    make_runner
        Makes what carries out the jobs: `local_runner` for a server, `InlineRunner` for a command.

    Returns
    -------
    services
        To be closed by whoever asked for them.

    Raises
    ------
    StartupError
        If a folder can't be written, or the database can't be opened or is too new.
    """
    make_folder(settings.data_folder)
    database = Database(settings.database)
    try:
        database.upgrade()
        store = LocalArtifactStore(settings.artifact_folder)
    except BaseException:
        database.close()
        raise
    events = EventHub()
    shelf = RigShelf(settings.rig_folder, pages or PageDesk())
    rigs = RigPool(rig_opener(settings, shelf), events.publish)
    shop = Workshop(database, store, rigs, registry, events.publish)
    return Services(
        database=database,
        store=store,
        runner=make_runner(shop),
        rigs=rigs,
        registry=registry(),
        events=events,
        version=version("unglare"),
        offers=lambda: rig_offers(settings, shelf),
        shelf=shelf,
    )


def rig_opener(settings: Settings, shelf: RigShelf) -> OpenRig:
    """Return what opens rigs: this station's own gets the options of the settings, where a scan names no others."""

    def opened(name: str, options: Mapping[str, Any]) -> Rig:
        own = settings.rig_options if name == settings.rig else {}
        return shelf.open(name, {**own, **options})

    return opened


def rig_offers(settings: Settings, shelf: RigShelf) -> tuple[RigOffer, ...]:
    """Offer this station's own rig first, also one that has no name but `package.module:factory`."""
    known = (*offer_rigs(), *offer_kept_rigs(shelf))
    own = [offer for offer in known if offer.name == settings.rig]
    others = [offer for offer in known if offer.name != settings.rig]
    unnamed = RigOffer(name=settings.rig, title=settings.rig, doc="", options_schema={})
    return (*(own or [unnamed]), *others)


def build_application(
    settings: Settings,
    services: Services,
    *,
    port: int,
    token: str | None = None,
    pages: PageDesk | None = None,
) -> FastAPI:
    """Make the application around services; nothing listens and no process runs yet.

    Parameters
    ----------
    settings
        Limits, tokens, folders.
    services
        Closed by the application when it ends.
    port
        Where it will be served: the station calls it there, and the cookie bears its number.
    token
        The operators' token; None: that of the settings.
    pages
        Where projector pages are brought together with their drivers: the services' own.

    Raises
    ------
    StartupError
        If there is no operators' token at all.
    """
    operator = token or (settings.token.get_secret_value() if settings.token else "")
    if not operator:
        raise StartupError("There is no token to log in with; set UNGLARE_TOKEN.")
    viewer = settings.viewer_token.get_secret_value() if settings.viewer_token else None
    station = Station(f"http://{_reachable(settings.host)}:{port}")
    context = Context(
        services=services,
        sessions=Sessions(Tokens(operator, viewer), lifetime_s=settings.session_hours * 3600.0),
        station=station,
        version=version("unglare"),
        cookie_name=f"unglare-{port}",
        data_folder=settings.data_folder,
        upload_limit_bytes=settings.upload_limit_mb * 2**20,
        pages=pages or PageDesk(),
    )
    return create_api(
        context, station=station if settings.station else None, threads=settings.threads
    )


_say = partial(print, flush=True)
"""Prints at once: in a file or a pipe the address would wait for more lines, which never come."""


def serve(
    settings: Settings,
    *,
    announce: Callable[[str], None] = _say,
    prepare: Callable[[Services], None] | None = None,
) -> None:
    """Serve the application until it is told to stop (Ctrl+C or SIGTERM).

    Parameters
    ----------
    settings
        Everything that can be chosen.
    announce
        Is told the addresses to open, token included, once it listens.
    prepare
        Called after that, in a thread of its own: nobody waits for what it does.

    Raises
    ------
    StartupError
        If it can't start: the port is in use, a folder can't be written, the database is too new,
        or another server uses the same data folder.
    """
    configure_logging(settings.log_level)
    # uvicorn takes the signal while it runs and raises it again when all is closed.
    signal.signal(signal.SIGTERM, _leave)
    token = settings.token.get_secret_value() if settings.token else secrets.token_urlsafe(24)
    with (
        contextlib.closing(public_socket(settings.host, settings.port)) as listening,
        _alone_in(settings.data_folder),
        contextlib.suppress(KeyboardInterrupt),
    ):
        port = listening.getsockname()[1]
        pages = PageDesk()
        with contextlib.closing(build_services(settings, pages=pages)) as services:
            interrupted = services.recover()
            if interrupted:
                _log.warning("%d runs were interrupted when the server stopped.", interrupted)
            app = build_application(settings, services, port=port, token=token, pages=pages)
            announce(_welcome(settings, port, token))
            if prepare is not None:
                threading.Thread(
                    target=prepare, args=(services,), name="prepare", daemon=True
                ).start()
            server_for(app, trusted_proxies=settings.trusted_proxies).run(sockets=[listening])


@contextlib.contextmanager
def serve_pages(
    settings: Settings,
    *,
    announce: Callable[[str, str], None],
    make_runner: Callable[[Workshop], Runner] = InlineRunner,
) -> Iterator[tuple[Services, PageDesk]]:
    """Serve projector pages for one command, without the station.

    Yields the services, whose rigs find the pages, and the desk where the pages come in. `announce` is told the
    server's address and the operators' token.

    Raises
    ------
    StartupError
        If it can't start, e.g. because a server runs already: the pages are with that one.
    """
    token = settings.token.get_secret_value() if settings.token else secrets.token_urlsafe(24)
    with (
        _alone_in(settings.data_folder),
        contextlib.closing(public_socket(settings.host, settings.port)) as listening,
    ):
        port, pages = listening.getsockname()[1], PageDesk()
        with contextlib.closing(
            build_services(settings, make_runner=make_runner, pages=pages)
        ) as services:
            bare = settings.model_copy(update={"station": False})
            app = build_application(bare, services, port=port, token=token, pages=pages)
            server = server_for(app, trusted_proxies=settings.trusted_proxies)
            serving = threading.Thread(
                target=server.run, kwargs={"sockets": [listening]}, name="pages", daemon=True
            )
            serving.start()
            try:
                announce(f"http://{_reachable(settings.host)}:{port}", token)
                yield services, pages
            finally:
                server.should_exit = True
                serving.join()


def configure_logging(level: str) -> None:
    """Write what happens to the error output, without tokens."""
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(TokensHidden())
    handler.setFormatter(
        logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%Y-%m-%d %H:%M:%S")
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    for chatty in ("uvicorn", "uvicorn.error", "websockets", "alembic", "numba"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def make_folder(folder: Path) -> None:
    """Make the data folder; StartupError if that can't be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StartupError(
            f"The data folder {folder} can't be made ({error.strerror}); choose another one with UNGLARE_DATA_FOLDER."
        ) from error
    if not os.access(folder, os.W_OK):
        raise StartupError(
            f"The data folder {folder} can't be written; change its owner, or choose another one with UNGLARE_DATA_FOLDER."
        )


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep a second server out: it would take the first one's running jobs for interrupted."""
    make_folder(folder)
    with (folder / "server.lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StartupError(
                f"Another server uses the data folder {folder}; stop it, or choose another folder with UNGLARE_DATA_FOLDER."
            ) from error
        yield


def is_served(folder: Path) -> bool:
    """Tell whether a server uses a data folder now."""
    try:
        with _alone_in(folder):
            return False
    except StartupError:
        return True


def _reachable(host: str) -> str:
    """Return how this machine itself reaches the server, for an address."""
    if host in _EVERYWHERE:
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _welcome(settings: Settings, port: int, token: str) -> str:
    address = f"http://{_reachable(settings.host)}:{port}/?token={token}"
    lines = [
        f"unglare {version('unglare')} is running; its data are in {settings.data_folder}.",
        "Open this address (it logs you in):",
        f"    {address}",
    ]
    if settings.host in _EVERYWHERE:
        lines.append(f"or this machine's name on port {port}, with the token {token}")
    return "\n".join([*lines, "Stop with Ctrl+C."])


def _leave(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise SystemExit(0)


def main() -> None:
    """Serve with the settings of the environment: `python -m backend.main`."""
    try:
        serve(load_settings())
    except StartupError as error:
        sys.exit(error.sentence)


if __name__ == "__main__":
    main()
