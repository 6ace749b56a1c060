"""The kiosk: which monitor, which command line, and where the token is kept."""

import os
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from backend.domain.errors import NotFoundError, StartupError
from backend.services.kiosk import Kiosk, Monitor

DESK = Monitor("DP-1", 0, 0, 1920, 1080)
PROJECTOR = Monitor("HDMI-1", 1920, 0, 1280, 800)
BOTH = (DESK, PROJECTOR)


@pytest.mark.parametrize(("number", "chosen"), [(None, PROJECTOR), (1, DESK), (2, PROJECTOR)])
def test_the_projector_is_the_last_monitor_unless_it_is_named(
    number: int | None, chosen: Monitor
) -> None:
    assert Kiosk.choose(BOTH, number) is chosen


def test_a_monitor_that_isnt_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(NotFoundError, match=r"no monitor 3.*HDMI-1 \(1280x800 at 1920,0\)"):
        Kiosk.choose(BOTH, 3)


def test_the_window_fills_the_monitor_and_the_token_is_no_argument(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("backend.services.kiosk.shutil.which", lambda name: f"/usr/bin/{name}")
    kiosk = Kiosk(tmp_path / "kiosk")
    command = kiosk.command(PROJECTOR, "http://127.0.0.1:8000", name="left one", token="se&cret")
    assert command[0] == "/usr/bin/chromium"
    assert {
        "--kiosk",
        "--window-position=1920,0",
        "--window-size=1280,800",
        "--force-device-scale-factor=1",
    } <= set(command)
    assert not any("cret" in argument for argument in command)
    door = tmp_path / "kiosk" / "open-left%20one.html"
    assert command[-1] == door.as_uri()
    assert stat.S_IMODE(door.stat().st_mode) == 0o600
    assert "/projector?name=left+one&amp;token=se%26cret" in door.read_text()


def test_the_window_is_closed_behind_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser, marks = tmp_path / "chromium", tmp_path / "marks"
    browser.write_text(f"#!/bin/sh\necho $$ > {marks}\nexec sleep 60\n")
    browser.chmod(0o755)
    monkeypatch.setattr("backend.services.kiosk.shutil.which", lambda name: str(browser))
    deadline_s = time.monotonic() + 20
    with Kiosk(tmp_path / "kiosk").opened(DESK, "http://127.0.0.1:1", name="wall", token="secret"):
        while not (marks.exists() and marks.read_text().strip()):
            assert time.monotonic() < deadline_s
            threading.Event().wait(0.01)
        pid = int(marks.read_text())
        os.kill(pid, 0)  # it is there
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert not list((tmp_path / "kiosk").glob("*.html"))  # the token stood there


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="only Linux tells whose profile it is")
@pytest.mark.parametrize("ours", [True, False])
def test_a_window_that_a_killed_command_left_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ours: bool
) -> None:
    monkeypatch.setattr("backend.services.kiosk.shutil.which", lambda name: "/bin/true")
    profile = Kiosk(tmp_path / "kiosk").profile("wall")
    profile.mkdir(parents=True)
    words = f"--user-data-dir={profile if ours else 'elsewhere'}"
    command = [sys.executable, "-c", "print(1, flush=True); input()", words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as left:
        assert left.stdout is not None
        left.stdout.readline()  # it runs, under these words
        (profile / "SingletonLock").symlink_to(f"host-{left.pid}")
        with Kiosk(tmp_path / "kiosk").opened(DESK, "http://127.0.0.1:1", name="wall", token="t"):
            pass
        assert (left.poll() is not None) == ours
        left.kill()


def test_without_a_browser_the_way_out_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("backend.services.kiosk.shutil.which", lambda name: None)
    with pytest.raises(StartupError, match="apt-get install chromium"):
        Kiosk(tmp_path).command(DESK, "http://127.0.0.1:8000", name="projector", token=None)


def test_projectors_of_any_name_have_profiles_of_their_own(tmp_path: Path) -> None:
    kiosk = Kiosk(tmp_path)
    names = ["left", "../left", "left/", "Бильярдная" * 10, "Бильярдная" * 11]
    profiles = [kiosk.profile(name) for name in names]
    assert len(set(profiles)) == len(names)
    for profile in profiles:
        profile.mkdir()
        assert profile.parent == tmp_path
