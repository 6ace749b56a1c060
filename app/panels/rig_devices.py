"""Which rig, its devices, connecting and disconnecting, and looking for cameras."""

from typing import Any, Protocol

import viser

from app import markup
from app.desk import Desk
from app.numbers import number
from backend.contract.rigs import (
    DeviceView,
    DiscoverCameras,
    Discovery,
    FoundCameraView,
    RigLink,
    RigOffer,
    RigState,
)

_COLOURS = {
    "ready": "#3fae6a",
    "armed": "#4c9bff",
    "lost": "#e25555",
    "closed": "#7d8796",
}
_LINKS = {
    RigLink.OPEN: ("#3fae6a", "connected"),
    RigLink.OPENING: ("#4c9bff", "connecting"),
    RigLink.CLOSING: ("#4c9bff", "disconnecting"),
    RigLink.CLOSED: ("#7d8796", "disconnected"),
}


class Page(Protocol):
    """What the parts of the rig's page ask of it."""

    @property
    def rig(self) -> str | None:
        """Name of the rig on the screen."""

    def do(self, ask: Any) -> None:
        """Ask the API for something that answers with the rig's state, and draw that."""


class DevicesPanel:
    """The left panel's first part, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, page: Page) -> None:
        self._desk, self._page = desk, page
        self._offers: dict[str, RigOffer] = {}
        self._drawn = ""
        self._menu: Any = gui.add_dropdown("Rig", ["–"], visible=desk.who.may_operate)
        self._devices = gui.add_html("")
        self._buttons: list[viser.GuiButtonHandle] = []
        if desk.who.may_operate:
            self._add_buttons(gui)
            self._add_search(gui)

        @self._menu.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            offer = self._offers.get(self._menu.value)
            if event.client is not None and offer is not None:
                self._desk.open_rig(offer.name, None)

    def choose(self, rig: str, offers: tuple[RigOffer, ...]) -> None:
        """Offer all rigs, with this one chosen."""
        self._offers = {_label(offer, offers): offer for offer in offers}
        chosen = next((label for label, o in self._offers.items() if o.name == rig), rig)
        self._menu.options = tuple(dict.fromkeys((*self._offers, chosen)))
        self._menu.value = chosen
        self._drawn = self._devices.content = ""

    def show(self, state: RigState) -> None:
        """Show this state."""
        content = markup.div("ug-devices", _head(state) + "".join(map(_card, cards(state))))
        if content != self._drawn:
            self._drawn = content
            self._devices.content = content
        if self._buttons:
            connect, disconnect = self._buttons
            is_idle = state.owner is None and (
                state.work is None or state.work.status.value != "running"
            )
            connect.label = "Connect" if state.link is RigLink.CLOSED else "Reconnect"
            connect.disabled = not is_idle
            disconnect.disabled = not is_idle or state.link is RigLink.CLOSED

    def _add_buttons(self, gui: viser.GuiApi) -> None:
        gui.add_html(markup.marker("ug-row2"))
        connect = gui.add_button("Reconnect", color="gray", icon=viser.Icon.PLUG)
        disconnect = gui.add_button(
            "Disconnect", color="gray", icon=viser.Icon.PLUG_OFF, hint="Close the devices, so that another program can use them"
        )  # fmt: skip
        self._buttons = [connect, disconnect]
        api = self._desk.api

        @connect.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            if (rig := self._page.rig) is not None:
                self._page.do(lambda: api.reconnect(rig))

        @disconnect.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            if (rig := self._page.rig) is not None:
                self._page.do(lambda: api.disconnect(rig))

    def _add_search(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Find cameras", expand_by_default=False, order=1e3):
            addresses = gui.add_text(
                "Addresses", "", hint="IPv4 addresses, with commas; empty: those of the rig files"
            )
            ask = gui.add_button(
                "Ask these addresses", color="gray", icon=viser.Icon.SEARCH, hint="By unicast: nobody else hears it"
            )  # fmt: skip
            search = gui.add_button(
                "Search the network (broadcast)", color="gray", icon=viser.Icon.ACCESS_POINT,
                hint="Every driver looks for itself; GigE Vision drivers broadcast: every device on every network of the server hears it",
            )  # fmt: skip
            found = gui.add_html("")

        def look(request: DiscoverCameras) -> None:
            found.content = markup.div("ug-text ug-doc", "Looking …")
            try:
                found.content = found_html(self._desk.api.discover(request))
            except Exception:
                found.content = ""
                raise

        @ask.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            names = tuple(a for a in addresses.value.replace(",", " ").split() if a)
            self._desk.load(lambda: look(DiscoverCameras(addresses=names)), key="discover")

        @search.on_click
        async def _(_: viser.GuiEvent[Any]) -> None:
            self._desk.load(lambda: look(DiscoverCameras(search=True)), key="discover")


def cards(state: RigState) -> list[tuple[DeviceView, str]]:
    """Return each device with what else is known of it."""
    return [(d, _projector_note(state) if d.role == "projector" else "") for d in state.devices]


def found_html(found: Discovery) -> str:
    """Say which cameras answered, and why others didn't."""
    problems = "".join(markup.div("ug-why", markup.esc(p)) for p in found.problems)
    if not found.cameras:
        return problems or markup.div("ug-text ug-doc", "No camera answered.")
    return problems + markup.div("ug-devices", "".join(map(_found_card, found.cameras)))


def _found_card(camera: FoundCameraView) -> str:
    who = " ".join(t for t in (camera.vendor, camera.model, camera.serial) if t) or camera.driver
    lines = [camera.address, f"rig file: {camera.rig_line}"]
    if camera.used_in:
        lines.append(f"in {', '.join(camera.used_in)}")
    if camera.controlled_by:
        lines.append(f"controlled by {camera.controlled_by}")
    return _box(who, "", "", lines)


def _head(state: RigState) -> str:
    colour, words = _LINKS[state.link]
    if any(device.link == "lost" for device in state.devices):
        colour, words = _COLOURS["lost"], "device lost: reconnect"
    chip = f'<span class="ug-state" style="--c:{colour}">{markup.esc(words)}</span>'
    owner = f"{state.owner.who} {state.owner.doing}" if state.owner else "nobody captures"
    return markup.div("ug-rig-link", chip + markup.span("ug-note", markup.esc(owner)))


def _card(card: tuple[DeviceView, str]) -> str:
    device, more = card
    who = " ".join(t for t in (device.vendor, device.model) if t) or device.driver
    ids = [t for t in (device.serial, device.address) if t]
    size = f"{device.width_px} × {device.height_px} px"
    rate = f"{number(device.refresh_hz)} Hz" if device.refresh_hz else ""
    driver = f"driver {device.driver}" if device.driver else ""
    lines = [who, " · ".join(ids), " · ".join(t for t in (size, rate, driver) if t), more]
    return _box(device.name, device.link, _COLOURS.get(device.link, "#7d8796"), lines)


def _box(name: str, state: str, colour: str, lines: list[str]) -> str:
    chip = (
        f'<span class="ug-state" style="--c:{colour}">{markup.esc(state)}</span>' if state else ""
    )
    head = markup.div("ug-scan-head", markup.span("ug-name", markup.esc(name)) + chip)
    body = "".join(markup.div("ug-note", markup.esc(line)) for line in lines if line)
    return markup.div("ug-device", head + body)


def _projector_note(state: RigState) -> str:
    if state.owner is not None and not state.owner.scan:
        return ""  # a calibration sets it to 0 meanwhile
    if state.settle_ms is None:
        return "settle time not measured" if state.keeps_latency else ""
    words = f"settles in {number(state.settle_ms, 3)} ms"
    if state.settle_measured is None:
        return words
    when = state.settle_measured.astimezone()
    return f"{words}, measured {when.day} {when:%b %Y, %H:%M}"


def _label(offer: RigOffer, offers: tuple[RigOffer, ...]) -> str:
    is_only = [o.title for o in offers].count(offer.title) == 1
    return offer.title if is_only else f"{offer.title} ({offer.name})"
