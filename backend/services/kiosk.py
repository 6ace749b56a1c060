"""A browser window that fills the projector's monitor and shows the projector page, pixel by pixel."""

import contextlib
import html
import os
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from urllib.parse import quote, urlencode

from backend.domain.errors import NotFoundError, StartupError

_CLOSING_S = 10.0
_LONGEST_QUOTED = 80
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--kiosk", "--force-device-scale-factor=1", "--force-color-profile=srgb",  # no pixel is scaled or converted
    "--no-first-run", "--noerrdialogs", "--no-default-browser-check", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-infobars", "--disable-session-crashed-bubble",
)  # fmt: skip


@dataclass(frozen=True)
class Monitor:
    """One monitor of this machine."""

    name: str
    left_px: int
    top_px: int
    width_px: int
    height_px: int

    def __str__(self) -> str:
        """Write it as an operator reads it."""
        return f"{self.name} ({self.width_px}x{self.height_px} at {self.left_px},{self.top_px})"


def listed_monitors() -> tuple[Monitor, ...]:
    """Return the monitors from left to right.

    Raises
    ------
    NotFoundError
        If there is no screen at all.
    """
    from screeninfo import ScreenInfoError, get_monitors

    try:
        found = get_monitors()
    except ScreenInfoError as error:
        raise NotFoundError(
            f"No monitor is found ({error}); run this in a desktop session, or set DISPLAY."
        ) from error
    monitors = [Monitor(m.name or "monitor", m.x, m.y, m.width, m.height) for m in found]
    return tuple(sorted(monitors, key=lambda m: (m.left_px, m.top_px)))


class Kiosk:
    """Starts the browser.

    Parameters
    ----------
    folder
        Of the browser's profiles, one per projector; nobody else's settings and extensions take part.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @staticmethod
    def choose(monitors: Sequence[Monitor], number: int | None) -> Monitor:
        """Return a monitor by its number from 1 on, else the last: the projector is the second one.

        Raises
        ------
        NotFoundError
            If there are fewer.
        """
        if number is not None and number > len(monitors):
            names = ", ".join(map(str, monitors))
            raise NotFoundError(f"There is no monitor {number}; there are: {names}.")
        return monitors[(number or len(monitors)) - 1]

    def run(self, monitor: Monitor, address: str, *, name: str, token: str | None) -> None:
        """Show the page until its window is closed; a window that shows this projector already is closed before.

        Raises
        ------
        StartupError
            If no browser is installed.
        """
        with self.opened(monitor, address, name=name, token=token) as browser:
            browser.wait()

    @contextlib.contextmanager
    def opened(
        self, monitor: Monitor, address: str, *, name: str, token: str | None
    ) -> "Iterator[subprocess.Popen[bytes]]":
        """Show the page as long as the block runs; the window is closed behind it.

        A window that a killed command left behind is closed before: its browser would open this page, too, and keep
        it. So nobody else may use the profile meanwhile.

        Raises
        ------
        StartupError
            If no browser is installed.
        """
        command = self.command(monitor, address, name=name, token=token)
        self._close_left_over(name)
        # In a group of its own: Ctrl+C is the command's, which closes the window when it is done.
        browser = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)  # noqa: S603  our own words
        try:
            yield browser
        finally:
            self._door_of(name).unlink(missing_ok=True)  # the token stands in it
            browser.terminate()
            try:
                browser.wait(timeout=_CLOSING_S)
            except subprocess.TimeoutExpired:
                browser.kill()
                browser.wait()

    def profile(self, name: str) -> Path:
        """Return the folder that the browser keeps for a projector: a browser opens everything of one profile."""
        return self._folder / f"profile-{_file_name(name)}"

    def _door_of(self, name: str) -> Path:
        return self._folder / f"open-{_file_name(name)}.html"

    def _close_left_over(self, name: str) -> None:
        profile = self.profile(name)
        try:
            pid = int((profile / "SingletonLock").readlink().name.rpartition("-")[2])  # HOST-PID
            arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            if os.fsencode(f"--user-data-dir={profile}") not in arguments:
                return  # another program has that number by now
            browser = os.pidfd_open(pid)
        except (OSError, ValueError, AttributeError):  # nothing is left, or this isn't Linux
            return
        try:
            for number in (signal.SIGTERM, signal.SIGKILL):
                signal.pidfd_send_signal(browser, number)
                if select.select([browser], [], [], _CLOSING_S)[0]:
                    return
        except ProcessLookupError:
            return
        finally:
            os.close(browser)

    def command(self, monitor: Monitor, address: str, *, name: str, token: str | None) -> list[str]:
        """Return the browser's command line."""
        browser = next(filter(None, map(shutil.which, BROWSERS)), None)
        if browser is None:
            raise StartupError(
                f"None of {', '.join(BROWSERS)} is installed; run: apt-get install chromium, or open"
                f" {address}/projector full screen by hand."
            )
        self._folder.mkdir(parents=True, exist_ok=True)
        return [
            browser,
            *_FLAGS,
            *(
                ["--no-sandbox"] if os.geteuid() == 0 else []
            ),  # it refuses to start as root otherwise
            f"--user-data-dir={self.profile(name)}",
            f"--window-position={monitor.left_px},{monitor.top_px}",
            f"--window-size={monitor.width_px},{monitor.height_px}",
            self._door(address, name, token).as_uri(),
        ]

    def _door(self, address: str, name: str, token: str | None) -> Path:
        """Write the page that leads on: a token among a program's arguments could be read by everybody."""
        query = {"name": name} | ({"token": token} if token else {})
        target = html.escape(f"{address}/projector?{urlencode(query)}")
        door = self._door_of(name)
        door.touch(mode=0o600)
        door.write_text(f'<!doctype html><meta http-equiv="refresh" content="0; url={target}">\n')
        return door


def _file_name(name: str) -> str:
    """Return a file name for a projector's name, whatever characters that has; a long one by its hash.

    Examples
    --------
    >>> _file_name("left wall/2")
    'left%20wall%2F2'
    """
    quoted = quote(name, safe="")
    return quoted if len(quoted) <= _LONGEST_QUOTED else sha256(quoted.encode()).hexdigest()
