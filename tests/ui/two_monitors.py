"""A laboratory without hardware: an X server with two monitors, the real server, a kiosk, cameras that look.

Everything is a process of its own, as on a real station, and dies with the test process whatever happens.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from backend.devices.peers.monitor_display import Region
from backend.services.kiosk import Kiosk, Monitor

SIZE = (640, 400)
"""Of each monitor, in [px]."""
PATIENCE_S = 120.0
_NEVER = threading.Event()
_TOKEN = "two-monitors-4711"
_MODE = 'Modeline "640x400" 20.16 640 656 720 800 400 401 404 420'
_XORG = f"""
Section "ServerFlags"
  Option "AutoAddDevices" "false"
  Option "AutoEnableDevices" "false"
EndSection
Section "Device"
  Identifier "card"
  Driver "dummy"
  VideoRam 16384
EndSection
Section "Monitor"
  Identifier "monitor"
  HorizSync 5-1000
  VertRefresh 5-200
  {_MODE}
EndSection
Section "Screen"
  Identifier "screen"
  Device "card"
  Monitor "monitor"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Modes "640x400"
    Virtual {2 * SIZE[0]} {SIZE[1]}
  EndSubSection
EndSection
"""


def needed(program: str, package: str) -> str:
    """Return a program's path; skip the test if it isn't installed."""
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"{program} isn't installed: apt-get install {package}")
    return found


def wait_for(ready: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
    """Wait until a condition holds, and return what made it hold."""
    deadline_s = time.monotonic() + timeout_s
    while not (found := ready()):
        assert time.monotonic() < deadline_s, f"{what} didn't happen within {timeout_s:g} s"
        _NEVER.wait(0.05)  # other processes tell nobody that they are ready
    return found


@dataclass
class Program:
    """A running program and what it has written so far."""

    process: "subprocess.Popen[bytes]"
    log: Path

    @property
    def said(self) -> str:
        """What it wrote."""
        return self.log.read_text("utf-8", "replace")

    def wait_until_it_says(self, pattern: str) -> "re.Match[str]":
        """Wait for a line."""

        def found() -> "re.Match[str] | None":
            assert self.process.poll() is None or re.search(pattern, self.said), self.said
            return re.search(pattern, self.said)

        match: re.Match[str] = wait_for(found, f"{pattern!r} from {self.process.args!r}")
        return match

    def stop(self, number: int = signal.SIGTERM) -> int:
        """End it, and return its status."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(number)
        try:
            return self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


@dataclass
class Desktop:
    """An X server with two monitors side by side and a window manager."""

    folder: Path
    display: str = ""
    programs: list[Program] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """Environment of programs on this desktop."""
        kept = {n: v for n, v in os.environ.items() if not n.startswith("UNGLARE_")}
        return kept | {"DISPLAY": self.display, "HOME": str(self.folder)}

    def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        pass_fds: tuple[int, ...] = (),
        more: Mapping[str, str] | None = None,
    ) -> Program:
        """Start a program that dies with this process."""
        log = self.folder / f"{name}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                ["setpriv", "--pdeathsig", "KILL", *command],
                env=self.environment | dict(more or {}),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                pass_fds=pass_fds,
            )
        program = Program(process, log)
        self.programs.append(program)
        return program

    def unglare(self, name: str, *arguments: str, **environment: str) -> Program:
        """Start a command of ours."""
        return self.start(name, [sys.executable, "-m", "backend.cli", *arguments], more=environment)

    def xrandr(self, *arguments: str) -> None:
        """Arrange the monitors."""
        command = [needed("xrandr", "x11-xserver-utils"), *arguments]
        subprocess.run(command, env=self.environment, check=True, capture_output=True, timeout=30)

    def unplug(self) -> None:
        """Pull the second monitor's cable."""
        self.xrandr("--output", "DUMMY1", "--off")

    def plug_in(self) -> None:
        """Plug it in, to the right of the first."""
        self.xrandr("--output", "DUMMY1", "--mode", "640x400", "--right-of", "DUMMY0")
        self.xrandr()  # looking makes the server notice that the output is connected

    @property
    def second(self) -> Monitor:
        """The projector."""
        return Monitor("DUMMY1", SIZE[0], 0, *SIZE)

    @property
    def region(self) -> Region:
        """Where the second monitor is on the desktop."""
        return Region(SIZE[0], 0, *SIZE)


@contextlib.contextmanager
def two_monitors(folder: Path) -> Iterator[Desktop]:
    """Start the X server on a free display, arrange its monitors, start the window manager."""
    xorg, openbox = needed("Xorg", "xserver-xorg-core"), needed("openbox", "openbox")
    if not list(Path("/usr/lib/xorg/modules/drivers").glob("dummy_drv.so")):
        pytest.skip("Xorg's dummy driver isn't installed: apt-get install xserver-xorg-video-dummy")
    needed("xrandr", "x11-xserver-utils")
    settings = folder / "xorg.conf"
    settings.write_text(_XORG)
    desktop = Desktop(folder)
    read, write = os.pipe()
    try:
        with open(read) as told:
            options = ["-nolisten", "tcp", "-noreset", "-novtswitch", "-sharevts", "-displayfd", str(write)]  # fmt: skip
            desktop.start(
                "xorg",
                [xorg, "-config", str(settings), "-logfile", str(folder / "x.log"), *options],
                pass_fds=(write,),
            )
            os.close(write)
            desktop.display = f":{told.readline().strip()}"
        assert desktop.display != ":", desktop.programs[0].said
        desktop.xrandr("--addmode", "DUMMY1", "640x400")
        desktop.plug_in()
        desktop.start("openbox", [openbox, "--sm-disable"])
        yield desktop
    finally:
        for program in reversed(desktop.programs):
            program.stop()


class Station:
    """The server as its clients see it."""

    def __init__(self, desktop: Desktop, folder: Path) -> None:
        self._desktop = desktop
        self._rigs: set[str] = set()
        self._environment = {
            "UNGLARE_DATA_FOLDER": str(folder),
            "UNGLARE_PORT": "0",
            "UNGLARE_STATION": "false",
            "UNGLARE_TOKEN": _TOKEN,
        }
        self.program = self._started()
        self.address = self.program.wait_until_it_says(r"(http://[\d.]+:\d+)/\?token").group(1)
        self._environment["UNGLARE_PORT"] = self.address.rpartition(":")[2]
        self.client = httpx.Client(
            base_url=self.address,
            headers={"Authorization": f"Bearer {_TOKEN}"},
            trust_env=False,
            timeout=60,
        )

    def _started(self) -> Program:
        return self._desktop.unglare("server", "serve", **self._environment)

    def fall_and_rise(self) -> None:
        """Die as by a power cut, and start again at the same address."""
        self.program.stop(signal.SIGKILL)
        self.program = self._started()
        self.program.wait_until_it_says(r"http://[\d.]+:\d+/\?token")

    def close(self) -> None:
        """Hang up."""
        self.client.close()

    def add_rig(self, file: Path, name: str) -> None:
        """Keep a rig file, by the command."""
        added = self._desktop.unglare(
            "rigs-add", "rigs", "add", str(file), "--name", name, **self._environment
        )
        assert added.process.wait(PATIENCE_S) == 0, added.said
        self._rigs.add(name)

    def give_page_to(self, rig: str) -> None:
        """Disconnect all other rigs: a page shows the patterns of one rig at a time."""
        for other in self._rigs - {rig}:
            address = f"/api/rigs/{other}"
            self.post(f"{address}/disconnect")
            wait_for(partial(self._is_disconnected, address), f"the disconnecting of {other}")

    def _is_disconnected(self, address: str) -> bool:
        return str(self.get(f"{address}/state")["link"]) == "closed"

    def get(self, path: str) -> Any:
        """Ask."""
        answer = self.client.get(path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def post(self, path: str, **body: Any) -> Any:
        """Have something done."""
        answer = self.client.post(path, json=body)
        assert answer.is_success, answer.text
        return answer.json()

    def array(self, hash_: str) -> "np.ndarray[Any, Any]":
        """Fetch an array."""
        import io

        return np.asarray(np.load(io.BytesIO(self.client.get(f"/api/artifacts/{hash_}").content)))

    def open_page(self, folder: Path) -> tuple[Program, str]:
        """Show the projector page on the second monitor, as `unglare projector` does; also return DevTools' address."""
        needed("chromium", "chromium")
        kiosk = Kiosk(folder)
        port = kiosk.profile("projector") / "DevToolsActivePort"
        port.unlink(missing_ok=True)
        command = kiosk.command(self._desktop.second, self.address, name="projector", token=_TOKEN)
        # DevTools let a test do what an operator might do to the window.
        program = self._desktop.start("kiosk", [*command, "--remote-debugging-port=0"])
        try:
            wait_for(lambda: port.is_file() and "\n" in port.read_text(), "the browser's start")
            tools = f"http://127.0.0.1:{port.read_text().split()[0]}"
            wait_for(lambda: self._is_open(tools), "the projector page")
        except BaseException:
            program.stop()
            raise
        return program, tools

    def _is_open(self, tools: str) -> bool:
        pages = httpx.get(f"{tools}/json/list", trust_env=False, timeout=60).json()
        return any(page["url"] == f"{self.address}/projector?name=projector" for page in pages)

    def scan(self, rig: str, **settings: dict[str, Any]) -> "Scan":
        """Make a scan."""
        self.give_page_to(rig)
        made = self.post("/api/scans", method="hdr-fringe", rig=rig, settings=settings)
        return Scan(self, made["id"])


@dataclass(frozen=True)
class Scan:
    """One scan on the station."""

    station: Station
    id: str

    @property
    def state(self) -> dict[str, Any]:
        """All of it."""
        state: dict[str, Any] = self.station.get(f"/api/scans/{self.id}")
        return state

    def stage(self, name: str) -> dict[str, Any]:
        """One stage of it."""
        return next(stage for stage in self.state["stages"] if stage["name"] == name)

    def start(self, until: str | None = None) -> "Scan":
        """Run what isn't current, unattended."""
        self.station.post(f"/api/scans/{self.id}/runs", until=until, unattended=True)
        return self

    def wait_for_shot(self, number: int) -> None:
        """Wait until so many fringes are captured, or the job has ended."""

        def there() -> bool:
            job = self.state["job"]
            shot = re.search(r"fringe .*, (\d+) of", job["text"] or "")
            return job["status"] not in ("queued", "running") or bool(
                shot and int(shot.group(1)) >= number
            )

        wait_for(there, f"shot {number}")

    def end(self) -> dict[str, Any]:
        """Wait for the job's end, and return the job."""

        def over() -> dict[str, Any] | None:
            job: dict[str, Any] = self.state["job"]
            return job if job["status"] not in ("queued", "running") else None

        job: dict[str, Any] = wait_for(over, "the end of the scan")
        return job

    def array(self, stage: str, field_name: str, camera: str) -> "np.ndarray[Any, Any]":
        """Fetch a map of a result."""
        fields = {f["name"]: f for f in self.stage(stage)["fields"]}
        return self.station.array(fields[field_name]["arrays"][camera]["hash"])

    def frames(self, stage: str = "fringe_capture") -> list[dict[str, Any]]:
        """Return the frames of a capturing stage."""
        fields = {f["name"]: f for f in self.stage(stage)["fields"]}
        frames: list[dict[str, Any]] = fields["frames"]["frames"]
        return frames
