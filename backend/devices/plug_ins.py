"""Entry points of installed packages: one that fails, exits or hangs while it is imported stops nobody else.

A package is imported in a thread of its own, a daemon: an import that never ends costs whoever waits for it a few
seconds, and doesn't keep the application from ending. What it raises, Ctrl+C's exception included, is its own.
"""

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from backend.devices.errors import RigConfigError
from backend.domain.errors import UnglareError

IMPORT_S = 60.0
"""So long a package may take to be imported where somebody wants to use it."""
LISTED_S = 3.0
"""So long where it is only listed; it may be there the next time."""

_pending: dict[EntryPoint, tuple["Future[Any]", float]] = {}
"""Imports that run, and when they began."""
_lock = threading.Lock()


class PlugInError(RigConfigError):
    """A package can't be used. The sentence names it; mend, update or remove it."""


class PlugInPendingError(PlugInError):
    """A package is still being imported. Ask again later."""


def plug_ins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, sorted; nothing is imported."""
    return {entry.name: entry for entry in sorted(entry_points(group=group), key=lambda e: e.name)}


def package_of(entry: EntryPoint) -> str:
    """Return the distribution that an entry point comes from, with version; empty where that isn't known."""
    try:
        return f"{entry.dist.name} {entry.dist.version}" if entry.dist else ""
    except Exception:  # noqa: BLE001  metadata of a half-removed package
        return "a package without version"


def load_plug_in(entry: EntryPoint, within_s: float = IMPORT_S) -> Any:
    """Import what an entry point names.

    Raises
    ------
    PlugInPendingError
        If that takes too long.
    PlugInError
        If it fails in whatever way.
    """
    with _lock:
        if entry not in _pending:
            _pending[entry] = _aside(entry.load), time.monotonic()
        importing, began_s = _pending[entry]
    try:
        # Who comes later doesn't wait once more for an import that hangs.
        return importing.result(timeout=max(began_s + within_s - time.monotonic(), 0.0))
    except TimeoutError as error:
        if importing.done() and importing.exception() is error:  # the package's own
            raise _failed(entry, error) from error
        raise PlugInPendingError(
            f"{_named(entry)} is still being imported after {within_s:g} s; ask again, or mend or remove it"
        ) from None
    except BaseException as error:
        if not importing.done():
            raise  # somebody pressed Ctrl+C here
        raise _failed(entry, error) from error
    finally:
        if importing.done():
            _pending.pop(entry, None)


def call_plug_in(name: str, call: Callable[[], Any], advice: str = "check its options") -> Any:
    """Call a function of a package; what isn't an expected error becomes one.

    Raises
    ------
    RigConfigError
        If it raises what it shouldn't; the cause keeps its traceback.
    """
    try:
        return call()
    except UnglareError:
        raise
    except (Exception, SystemExit) as error:
        raise RigConfigError(f"{name} failed with {_words(error)}; {advice}") from error


def lacking(made: object, attributes: Iterable[str]) -> str:
    """Return the attributes that an object hasn't, separated by commas."""
    return ", ".join(name for name in attributes if not _has(made, name))


def _has(made: object, name: str) -> bool:
    try:
        return hasattr(made, name)
    except Exception:  # noqa: BLE001  a property that can't be asked before the device is open is there
        return True


def _aside(work: Callable[[], Any]) -> "Future[Any]":
    future: Future[Any] = Future()

    def run() -> None:
        try:
            result = work()
        except BaseException as error:  # noqa: BLE001  foreign code: whatever it raises is what came of it
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=run, name="plug-in", daemon=True).start()
    return future


def _failed(entry: EntryPoint, error: BaseException) -> PlugInError:
    return PlugInError(
        f"{_named(entry)} can't be loaded ({_words(error)}); mend, update or remove it"
    )


def _named(entry: EntryPoint) -> str:
    package = package_of(entry)
    of = f" of {package}" if package else ""
    return f"{entry.group.removeprefix('unglare.').removesuffix('s')} {entry.name}{of}"


def _words(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
