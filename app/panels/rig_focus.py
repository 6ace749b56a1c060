"""What live pictures say: gray levels, what is saturated, how sharp they are, and a part of one pixel by pixel."""

from typing import Any

import numpy as np
import viser

from app import markup
from app.desk import Desk
from app.numbers import percent, quantity
from app.views.levels import LevelsChart, camera_colour
from app.views.live_planes import LivePlanes
from app.views.pixel import decoded
from app.views.sharpness import SharpnessAid
from backend.contract.rigs import LiveCamera, LiveView, PartView

_PART_PX = 128
_MAGNIFIED = 3
_PANEL_PX = (300, 410)
_RED, _BLUE = "#e23030", "#3f86ff"
"""As pixels are marked in the pictures."""
_OLD_S = 2.0
"""A picture older than that, beyond twice its exposure, isn't live any more."""


class FocusPanel:
    """Chart and numbers in the container that is open when it is made, and a small panel for the part."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, planes: LivePlanes, client: viser.ClientHandle
    ) -> None:
        self._gui, self._desk, self._planes = gui, desk, planes
        gui.add_html(markup.div("ug-heading", "Gray levels"))
        self._chart = LevelsChart(gui)
        self._cards = gui.add_html("")
        self._aids: dict[str, SharpnessAid] = {}
        """One per camera."""
        self._part_aid = SharpnessAid()
        self._pattern = ""
        self._place: tuple[str, int, int] | None = None
        self._part: Any = None
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Magnifier", viser.Icon.ZOOM_IN):
            self._part_head = gui.add_html("")
            self._part_numbers = gui.add_html("")  # above the picture: never cut off
            self._part_place = gui.add_folder(None)
        self._panel.float(x=-14, y=-14, width=_PANEL_PX[0], height=_PANEL_PX[1])
        del client

    def forget(self) -> None:
        """Another rig, or none: what was best doesn't count any more."""
        self._start_anew()
        self.put_away()
        self._chart.clear()

    def show(self, live: LiveView, cameras: list[str]) -> None:
        """Show what the newest pictures say."""
        if live.settings.pattern != self._pattern:
            self._pattern = live.settings.pattern
            self._start_anew()
        for camera in live.cameras:
            self._aid(camera.camera).note(camera.number, camera.sharpness, camera.saturated_share)
        if not cameras:
            self._chart.clear()
        self._chart.show(cameras, {c.camera: c.histogram for c in live.cameras})
        known = {c.camera: c for c in live.cameras}
        content = "".join(self._card(i, name, known.get(name)) for i, name in enumerate(cameras))
        if not cameras:
            content = markup.div("ug-empty", "No pictures while the rig isn't connected.")
        self._cards.content = content + (self._foot() if cameras else "")

    def choose(self, camera: str, x: int, y: int) -> None:
        """Show this part of a picture pixel by pixel from now on."""
        self._place = camera, x, y
        self._part_aid = SharpnessAid()
        self._planes.mark(camera, x, y, _PART_PX)
        close = self._desk.clicks.label(
            "leave part", self.put_away, "✕ close", "ug-link", "Put it away"
        )
        title = markup.span("ug-name", markup.esc(f"{camera}, pixel {x}, {y}"))
        self._part_head.content = markup.div("ug-caption ug-pixel", title + close)
        self._panel.visible = True

    def mark_again(self) -> None:
        """Draw the square around the part: the pictures stand elsewhere now."""
        if self._place is not None:
            self._planes.mark(*self._place, _PART_PX)

    def look(self, rig: str, camera: LiveCamera, *, marks: bool) -> None:
        """Fetch the chosen part of a new picture."""
        place = self._place
        if place is None or place[0] != camera.camera:
            return
        jpeg = self._desk.api.camera_part(rig, *place, size_px=_PART_PX, marks=marks)
        if jpeg is None or self._place != place:
            return
        part = np.kron(decoded(jpeg), np.ones((_MAGNIFIED, _MAGNIFIED, 1), np.uint8))
        if self._part is None:
            with self._part_place:
                self._part = self._gui.add_image(part, format="jpeg", jpeg_quality=90)
        else:
            self._part.image = part
        numbers = self._desk.api.part_numbers(rig, *place, size_px=_PART_PX)
        if numbers is not None and self._place == place:
            self._show_numbers(numbers, camera.bit_depth)

    def _show_numbers(self, numbers: PartView, bit_depth: int) -> None:
        self._part_aid.note(numbers.number, numbers.sharpness, numbers.saturated_share)
        cells = (
            _mean(numbers.mean_gray, bit_depth),
            _share("saturated", numbers.saturated_share, _RED),
        )
        self._part_numbers.content = markup.div(
            "ug-live-card", markup.div("ug-shares", "".join(cells)) + self._part_aid.html()
        )

    def _start_anew(self) -> None:
        self._aids, self._part_aid = {}, SharpnessAid()

    def _reset_best(self) -> None:
        for aid in (*self._aids.values(), self._part_aid):
            aid.forget_best()

    def _aid(self, camera: str) -> SharpnessAid:
        return self._aids.setdefault(camera, SharpnessAid())

    def put_away(self) -> None:
        """Hide the magnified part."""
        self._place = None
        self._planes.unmark()
        self._panel.visible = False

    def _card(self, order: int, name: str, camera: LiveCamera | None) -> str:
        swatch = f'<i style="background:{camera_colour(order)}"></i>'
        if camera is None:
            facts = markup.span("ug-note", "no picture yet")
            head = markup.span("ug-name", swatch + markup.esc(name)) + facts
            return markup.div("ug-live-card", markup.div("ug-live-head", head))
        exposure = quantity(camera.exposure_ms, "ms") if camera.exposure_ms else ""
        gain = quantity(camera.gain_db, "dB", 3) if camera.gain_db else ""
        old = camera.age_s > _OLD_S + 2e-3 * (camera.exposure_ms or 0.0)
        age = markup.span("ug-late", f"{camera.age_s:.0f} s old") if old else ""
        note = " · ".join(t for t in (markup.esc(exposure), markup.esc(gain), age) if t)
        head = markup.span("ug-name", swatch + markup.esc(name)) + markup.span("ug-note", note)
        return markup.div(
            "ug-live-card",
            markup.div("ug-live-head", head) + _shares(camera) + self._aid(name).html(),
        )

    def _foot(self) -> str:
        hint = "Click a picture to focus on a part of it."
        if not self._desk.who.may_operate:
            return ""
        reset = self._desk.clicks.label(
            "reset best",
            self._reset_best,
            "reset best",
            "ug-link",
            "Start the focus aid anew",
        )
        return markup.div("ug-live-foot", markup.span("ug-note", hint) + reset)


def _shares(camera: LiveCamera) -> str:
    cells = (
        _mean(camera.mean_gray, camera.bit_depth),
        _share("saturated", camera.saturated_share, _RED),
        _share("black", camera.black_share, _BLUE),
    )
    return markup.div("ug-shares", "".join(cells))


def _mean(mean_gray: float, bit_depth: int) -> str:
    return f"<span>mean <b>{mean_gray:.0f} of {2**bit_depth - 1}</b></span>"


def _share(name: str, share: float, colour: str) -> str:
    """Return a share with the colour that its pixels have in the picture."""
    shown = f"color:{colour}" if share > 0 else ""
    mark = f'<i style="background:{colour}"></i>'
    return f'<span>{mark}{name} <b style="{shown}">{markup.esc(percent(share))}</b></span>'
