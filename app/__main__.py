"""The station: settings from the environment, one `Session` per connected browser.

Started by the backend as `python -m app`. Prints one line `{"port": N}` when it is ready, and ends when its standard
input closes or its parent dies.
"""

import json
import logging
import os
import select
import sys
from dataclasses import dataclass

import viser

from app import station
from app.client import ApiClient
from app.panels.cloud import REVIEW_BUDGET
from app.session import Session

_LOG = logging.getLogger("app")
_LOOK_S = 1.0
"""How often to look whether the parent still lives."""


@dataclass(frozen=True)
class StationSettings:
    """What the parent says by the environment."""

    secret: str
    api_url: str
    points_budget: int

    @classmethod
    def from_environment(cls) -> "StationSettings":
        """Read UNGLARE_STATION_SECRET, UNGLARE_API_URL and UNGLARE_POINTS_BUDGET (points shown at first)."""
        missing = [
            n for n in ("UNGLARE_STATION_SECRET", "UNGLARE_API_URL") if not os.environ.get(n)
        ]
        if missing:
            raise SystemExit(
                f"{' and '.join(missing)} not set: the station is started by `unglare serve`."
            )
        budget = os.environ.get("UNGLARE_POINTS_BUDGET", str(REVIEW_BUDGET))
        return cls(os.environ["UNGLARE_STATION_SECRET"], os.environ["UNGLARE_API_URL"], int(budget))


class Sessions:
    """The sessions of all connected browsers."""

    def __init__(self, settings: StationSettings) -> None:
        self._settings = settings
        self._sessions: dict[int, Session] = {}

    def connected(self, client: viser.ClientHandle) -> None:
        """Make a browser's session; without the proxy's introduction it stays an empty page."""
        who = station.introduction_of(client)
        if who is None:
            return
        api = ApiClient(self._settings.api_url, who.token)
        self._sessions[client.client_id] = Session(
            client, api, who, points_budget=self._settings.points_budget
        )

    def disconnected(self, client: viser.ClientHandle) -> None:
        """End a browser's session."""
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


def main() -> None:
    """Serve until the parent is gone."""
    logging.basicConfig(
        level=logging.WARNING,
        stream=sys.stderr,
        format="station: %(levelname)s %(name)s: %(message)s",
    )
    settings = StationSettings.from_environment()
    report, sys.stdout = (
        sys.stdout,
        sys.stderr,
    )  # the parent reads one line: nobody else may write there
    server = station.start(settings.secret)
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, brand_color=(51, 154, 240)
    )
    server.scene.world_axes.visible = False
    sessions = Sessions(settings)
    server.on_client_connect(sessions.connected)
    server.on_client_disconnect(sessions.disconnected)
    print(json.dumps({"port": server.get_port()}), file=report, flush=True)
    wait_for_parent(os.getppid())
    # viser's threads and open event streams would keep the process alive for a while.
    os._exit(0)


def wait_for_parent(parent: int) -> None:
    """Return when standard input closes or the process has another parent."""
    while os.getppid() == parent:
        readable, _, _ = select.select([sys.stdin], [], [], _LOOK_S)
        if readable and not os.read(sys.stdin.fileno(), 4096):
            return


if __name__ == "__main__":
    main()
