"""The station's process: started, watched, started again when it dies, ended with us."""

import asyncio
import contextlib
import enum
import json
import logging
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import backend

_log = logging.getLogger("unglare.station")

_PATIENCE_S = 60.0  # viser and numpy on a cold disk
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
_STEADY_S = 60.0  # having lived so long, the next death counts as the first
_FAREWELL_S = 5.0
_ITS_OWN = frozenset({"UNGLARE_POINTS_BUDGET"})
"""Settings of the station that are passed on."""

# Runs before the station, in its process: the kernel kills it when this thread of ours ends, however
# it ends. As a program of its own and not as `preexec_fn`, which may deadlock in a threaded process.
_LAUNCHER = """
import ctypes, os, signal, sys
parent = int(sys.argv[1])
if sys.platform == "linux":
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
if os.getppid() == parent:
    os.execv(sys.argv[2], sys.argv[2:])
"""


class Phase(enum.StrEnum):
    """Where the station's process stands.

    ```mermaid
    stateDiagram-v2
        [*] --> starting
        starting --> up : it reported its port
        starting --> waiting : it died, or reported nothing
        up --> waiting : it died
        waiting --> starting : the pause is over
        up --> stopped
        waiting --> stopped
    ```
    """

    STARTING = "starting"
    UP = "up"
    WAITING = "waiting"
    STOPPED = "stopped"


class Station:
    """Keeps one child process running.

    The child finds `UNGLARE_STATION_SECRET` and `UNGLARE_API_URL` in its environment, and prints
    `{"port": N}` as one line on its standard output when it is ready. Every other line it prints goes
    to our log. Its standard input ends when we do.

    Parameters
    ----------
    api_url
        Where the child finds the API, on loopback.
    command
        The program and its arguments.
    pause_s
        Wait before the first restart [s]; doubled each time, up to 30 s.
    """

    def __init__(
        self,
        api_url: str,
        command: Sequence[str] = (sys.executable, "-P", "-m", "app"),
        *,
        pause_s: float = _FIRST_PAUSE_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.secret = secrets.token_urlsafe(32)
        self.port: int | None = None
        """Loopback port of the child; None while it isn't up."""
        self.phase = Phase.STARTING
        self.starts = 0
        self._api_url = api_url
        self._command = tuple(command)
        self._pause_s = pause_s
        self._clock = clock
        self._last_end = ""

    @property
    def message(self) -> str:
        """One sentence for whoever waits."""
        if self.phase is Phase.STOPPED:
            return "The station has been stopped."
        if not self._last_end:
            return "The station is starting."
        return f"The station {self._last_end} and is being started again."

    async def run(self) -> None:
        """Keep the child running until this is cancelled; then end it."""
        pause_s = self._pause_s
        try:
            while True:
                started_s = self._clock()
                self._last_end = await self._one_life()
                if self._clock() - started_s > _STEADY_S:
                    pause_s = self._pause_s
                _log.error("The station %s; next start in %.1f s.", self._last_end, pause_s)
                self.phase = Phase.WAITING
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        finally:
            self.phase = Phase.STOPPED

    async def _one_life(self) -> str:
        """Run the child once; return how it ended."""
        self.phase, self.starts = Phase.STARTING, self.starts + 1
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-I",
                "-S",
                "-c",
                _LAUNCHER,
                str(os.getpid()),
                *self._command,
                stdin=asyncio.subprocess.PIPE,  # its end tells the child, on every system, that we are gone
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT,
                env=child_environment(os.environ, self.secret, self._api_url),
                start_new_session=True,  # Ctrl+C is for us; we end it in order
            )
        except OSError as error:
            return f"couldn't be started ({error})"
        try:
            return await self._watch(process)
        finally:
            self.port = None
            await _end(process)

    async def _watch(self, process: asyncio.subprocess.Process) -> str:
        assert process.stdout is not None
        try:
            async with asyncio.timeout(_PATIENCE_S):
                self.port = await _port_reported(process.stdout)
        except TimeoutError:
            return f"reported no port within {_PATIENCE_S:.0f} s"
        if self.port is not None:
            self.phase = Phase.UP
            _log.info("The station is up (process %d, port %d).", process.pid, self.port)
            while line := await _line(process.stdout):
                _log.info("%s", line.rstrip())
        return _how_it_ended(await process.wait())


def child_environment(ours: Mapping[str, str], secret: str, api_url: str) -> dict[str, str]:
    """Return the child's environment: ours without our settings (tokens!), with what it has to know."""
    kept = {n: v for n, v in ours.items() if not n.startswith("UNGLARE_") or n in _ITS_OWN}
    # The command has `-P`: a folder `app` that happens to be where we were started isn't ours.
    root = str(Path(backend.__file__).resolve().parent.parent)
    paths = [root, *filter(None, [ours.get("PYTHONPATH")])]
    return kept | {
        "UNGLARE_STATION_SECRET": secret,
        "UNGLARE_API_URL": api_url,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONUNBUFFERED": "1",
    }


async def _port_reported(output: asyncio.StreamReader) -> int | None:
    """Read until the line with the port; None if the output ends before."""
    while line := await _line(output):
        with contextlib.suppress(ValueError, TypeError, KeyError):
            return int(json.loads(line)["port"])
        _log.info("%s", line.rstrip())
    return None


async def _line(output: asyncio.StreamReader) -> str:
    """Read a line; empty at the end. A line longer than the buffer is left out, not fatal."""
    try:
        return (await output.readline()).decode("utf-8", "replace")
    except ValueError:
        return "(a line that is too long)\n"


def _how_it_ended(code: int) -> str:
    if code >= 0:
        return f"ended with status {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


async def _end(process: asyncio.subprocess.Process) -> None:
    """Ask the child to end, then make it."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(_FAREWELL_S):
            # Reading on: a child that can't get rid of its last words doesn't end.
            await asyncio.gather(process.wait(), _drain(process))
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def _drain(process: asyncio.subprocess.Process) -> None:
    while process.stdout is not None and await _line(process.stdout):
        pass
