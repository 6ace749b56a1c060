"""The page of a rig without a scan: its devices left, its live pictures in the middle, light and exposure right."""

import threading
from typing import Any

import viser

from app import markup
from app.client import ApiError
from app.desk import Desk
from app.numbers import heading, quantity
from app.panels.rig_devices import DevicesPanel
from app.panels.rig_focus import FocusPanel
from app.panels.rig_light import LightPanel
from app.panels.rig_work import RigWorkPanel
from app.poll import Poll
from app.space import Space
from app.views.live_planes import LivePlanes
from app.views.pixel import decoded
from app.worker import Work
from backend.contract.rigs import LiveSettings, LiveView, RigLink, RigOffer, RigState

_PAUSE_S = 0.1
"""Between two looks at the newest pictures: a look takes as long again."""
_LOOKS_PER_STATE = 10
_PICTURE_PX = 800


class RigDeskPanel:
    """The whole page. Nothing is asked while it is closed.

    Parameters
    ----------
    main
        Where the controls go: a folder of the right panel.
    left
        The left panel.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        space: Space,
        desk: Desk,
        *,
        main: viser.GuiFolderHandle,
        left: Any,
    ) -> None:
        gui = client.gui
        self._desk = desk
        self._lock = threading.RLock()
        self._state: RigState | None = None
        self._looks = 0
        self._numbers: dict[str, int] = {}
        self._wants_live = True
        self._planes = LivePlanes(space)
        self._main, self._left = main, left
        with left.add_tab("Rig", viser.Icon.CAMERA):
            self._devices = DevicesPanel(gui, desk, self)
            self._work = RigWorkPanel(gui, desk, self)
        with main:
            self._head = gui.add_html("")
            self._light = LightPanel(gui, desk, self)
            self._focus = FocusPanel(gui, desk, self._planes, client)
        self._poll = Poll("live pictures", self._look, self._failed, pause_s=_PAUSE_S)

    @property
    def rig(self) -> str | None:
        """Name of the rig on the screen; None: the page is closed."""
        return self._poll.target

    @property
    def is_open(self) -> bool:
        """True while a rig is on the screen."""
        return self.rig is not None

    # ---- what the session asks for

    def open(self, rig: str, offers: tuple[RigOffer, ...], options: dict[str, Any] | None) -> None:
        """Show a rig; an operator's look connects it.

        One that is open with other options is opened with these, unless somebody captures; None: it stays as it is.
        """
        with self._lock:
            self._state, self._looks, self._numbers = None, 0, {}
            self._wants_live = True
            self._focus.forget()
            self._planes.open()
            self._planes.clear()
            self._devices.choose(rig, offers)
            self._main.visible = self._left.visible = True
            self._poll.turn_to(rig)
        error = next((offer.error for offer in offers if offer.name == rig), None)
        if error is None and self._desk.who.may_operate:
            self.do(lambda: self._connected(rig, options))

    def close(self) -> None:
        """Leave the page, if it is on the screen."""
        with self._lock:
            if not self.is_open:
                return
            self._poll.turn_to(None)
            self._main.visible = self._left.visible = False
            self._focus.forget()
            self._planes.close()

    def end(self) -> None:
        """End the page's thread: the browser is gone."""
        self._poll.close()

    def changed(self, rig: str) -> None:
        """Look at the rig's state anew: something happened to it."""
        if rig == self.rig:
            self._looks = 0

    def leave_part(self) -> None:
        """Put the magnifier away."""
        self._focus.put_away()

    def click(self, origin: Any, direction: Any) -> None:
        """Choose the place of a picture that is looked at pixel by pixel."""
        place = self._planes.place_of(origin, direction)
        if place is not None:
            self._focus.choose(*place)

    # ---- what its parts ask for

    def do(self, ask: Any) -> None:
        """Ask the API for something that answers with the rig's state, and draw that."""
        self._desk.act(lambda: self._draw_state(ask()))

    def set_live(self, settings: LiveSettings) -> None:
        """Take live pictures otherwise from now on."""
        self._desk.act(lambda: self._set_live(settings), key="live settings")

    def want_live(self, wants: bool) -> None:
        """Take live pictures, or let the rig rest."""
        self._wants_live = wants
        rig = self.rig
        if rig is not None and not wants:
            self._desk.act(lambda: self._draw_live(self._desk.api.end_live(rig)))

    # ---- looking

    def _look(self, rig: str) -> None:
        api = self._desk.api
        operates = self._desk.who.may_operate and self._wants_live
        if self._looks % _LOOKS_PER_STATE == 0:
            self._looks += 1
            self._draw_state(api.rig_state(rig))
        self._looks += 1
        live = api.watch(rig) if operates else api.live(rig)
        if rig != self.rig:
            return
        self._draw_live(live)
        marks = self._light.marks
        for camera in live.cameras:
            if self._numbers.get(camera.camera) != camera.number:
                self._numbers[camera.camera] = camera.number
                jpeg = api.camera_picture(rig, camera.camera, max_px=_PICTURE_PX, marks=marks)
                self._draw_picture(rig, camera.camera, jpeg)
                self._focus.look(rig, camera, marks=marks)

    def _draw_picture(self, rig: str, camera: str, jpeg: bytes | None) -> None:
        with self._lock:
            if jpeg is not None and rig == self.rig:
                self._planes.show(camera, decoded(jpeg))

    def _draw_live(self, live: LiveView) -> None:
        with self._lock:
            if live.rig != self.rig or self._state is None:
                return
            if (live.owner is None) != (self._state.owner is None):
                self._looks = 0  # who has the rig has changed: the state tells more
            self._light.show_live(live)
            self._focus.show(live, self._cameras())

    def _draw_state(self, state: RigState) -> None:
        with self._lock:
            if state.name != self.rig:
                return
            self._state = state
            self._head.content = self._head_html(state)
            self._devices.show(state)
            self._work.show(state)
            self._light.show(state)
            cameras = [
                (d.name, d.width_px, d.height_px) for d in state.devices if d.role == "camera"
            ]
            if cameras and self._planes.arrange(cameras):
                self._numbers = {}  # pictures that stood elsewhere are drawn again
                self._focus.mark_again()
            elif not cameras and state.link is RigLink.CLOSED:
                self._planes.clear()
                self._numbers = {}

    def _connected(self, rig: str, options: dict[str, Any] | None) -> RigState:
        api = self._desk.api
        state = api.rig_state(rig)
        is_idle = state.link is RigLink.OPEN and state.owner is None
        if is_idle and options is not None and options != state.options:
            api.disconnect(rig)
        return api.connect(rig, options or {})

    def _set_live(self, settings: LiveSettings) -> None:
        rig, state = self.rig, self._state
        if rig is None:
            return
        try:
            live = self._desk.api.set_live(rig, settings)
            self._light.answered(settings, live.settings)  # snapped: what was typed may stand there
            self._draw_live(live)
        except ApiError:
            if state is not None:
                self._light.show(self._desk.api.rig_state(rig), anew=True)
            raise

    def _failed(self, error: Exception) -> None:
        self._desk.act(_raising(error))

    def _cameras(self) -> list[str]:
        devices = self._state.devices if self._state else ()
        return [d.name for d in devices if d.role == "camera"]

    def _head_html(self, state: RigState) -> str:
        title = markup.div("ug-title ug-rig-title", markup.esc(state.title), title=state.title)
        purpose = _purpose(state)
        below = markup.div("ug-subtitle", markup.esc(purpose), title=purpose)
        back = ""
        if self._desk.who.may_operate:
            back = self._desk.clicks.label(
                "leave rig", self._desk.go_home, "‹", "ug-back", "All scans"
            )
        head = markup.div("ug-head", back + markup.div("ug-names", title + below))
        if state.owner is not None:
            shown = "Its pictures are shown; c" if state.owner.scan else "C"
            words = f"{state.owner.who} {state.owner.doing}. {shown}ontrols come back when it ends."
            return head + markup.div("ug-handed ug-owner", markup.esc(words))
        if state.failure:
            return head + markup.div("ug-why", markup.esc(state.failure))
        return head


def _purpose(state: RigState) -> str:
    words = ", ".join(_option(name, value) for name, value in state.options.items())
    return words or "Rig without a scan: light, exposure, focus, latency"


def _option(name: str, value: Any) -> str:
    words, unit = heading(name)
    if isinstance(value, (list, tuple)):
        value = " × ".join(f"{v:g}" if isinstance(v, (int, float)) else str(v) for v in value)
    return f"{words} {quantity(value, unit) if not isinstance(value, dict) else '…'}"


def _raising(error: Exception) -> Work:
    def work() -> None:
        raise error

    return work
