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
from backend.contract.rigs import LiveCamera, LiveView

_PART_PX = 128
_MAGNIFIED = 3
_PANEL_PX = (300, 350)
_IN_A_ROW = 3
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
        self._lately: dict[str, dict[int, float]] = {}
        """Of each camera: sharpness by the number of the picture."""
        self._best: dict[str, float] = {}
        self._pattern = ""
        self._place: tuple[str, int, int] | None = None
        self._part: Any = None
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Magnifier", viser.Icon.ZOOM_IN):
            self._part_head = gui.add_html("")
            self._part_place = gui.add_folder(None)
        self._panel.float(x=-14, y=-14, width=_PANEL_PX[0], height=_PANEL_PX[1])
        del client

    def forget(self) -> None:
        """Another rig, or none: what was best doesn't count any more."""
        self._start_anew()
        self._put_away()
        self._chart.clear()

    def show(self, live: LiveView, cameras: list[str]) -> None:
        """Show what the newest pictures say."""
        if live.settings.pattern != self._pattern:
            self._pattern = live.settings.pattern
            self._start_anew()
        for camera in live.cameras:
            self._remember(camera)
        self._chart.show(cameras, {c.camera: c.histogram for c in live.cameras})
        known = {c.camera: c for c in live.cameras}
        content = "".join(self._card(i, name, known.get(name)) for i, name in enumerate(cameras))
        if not cameras:
            content = markup.div("ug-empty", "No pictures while the rig isn't connected.")
        self._cards.content = content + (self._foot() if cameras else "")

    def choose(self, camera: str, x: int, y: int) -> None:
        """Show this part of a picture pixel by pixel from now on."""
        self._place = camera, x, y
        self._planes.mark(camera, x, y, _PART_PX)
        close = self._desk.clicks.label(
            "leave part", self._put_away, "✕ close", "ug-link", "Put it away"
        )
        title = markup.span("ug-name", markup.esc(f"{camera}, pixel {x}, {y}"))
        self._part_head.content = markup.div("ug-caption ug-pixel", title + close)
        self._panel.visible = True

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

    def _start_anew(self) -> None:
        self._lately, self._best = {}, {}

    def _remember(self, camera: LiveCamera) -> None:
        """Keep the best sharpness: of three pictures in a row the middle one counts, so no single one does."""
        lately = self._lately.setdefault(camera.camera, {})
        lately[camera.number] = camera.sharpness
        for old in sorted(lately)[:-_IN_A_ROW]:
            del lately[old]
        if len(lately) == _IN_A_ROW:
            now = float(np.median(list(lately.values())))
            self._best[camera.camera] = max(self._best.get(camera.camera, 0.0), now)

    def _put_away(self) -> None:
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
        age = f"{camera.age_s:.0f} s old" if old else ""
        note = " · ".join(t for t in (exposure, gain, age) if t)
        head = markup.span("ug-name", swatch + markup.esc(name)) + markup.span(
            "ug-note", markup.esc(note)
        )
        return markup.div(
            "ug-live-card",
            markup.div("ug-live-head", head) + _shares(camera) + self._sharpness(camera),
        )

    def _sharpness(self, camera: LiveCamera) -> str:
        best = self._best.get(camera.camera, 0.0)
        now = float(np.median(list(self._lately.get(camera.camera, {0: 0.0}).values())))
        share = max(0.0, now / best) if best > 0 else 0.0
        colour = "#3fae6a" if share >= 0.95 else "#e8a33d" if share >= 0.7 else "#e25555"
        bar = f'<div class="ug-progress"><div style="width:{100 * share:.0f}%;background:{colour}"></div></div>'
        words = (
            markup.span("", "sharpness")
            + bar
            + markup.span("ug-value", f"{100 * share:.0f} % of best")
        )
        return markup.div("ug-sharp", words)

    def _foot(self) -> str:
        hint = "Click a picture to magnify a part."
        if not self._desk.who.may_operate:
            return ""
        reset = self._desk.clicks.label(
            "reset best",
            self._best.clear,
            "reset best",
            "ug-link",
            "Start the focus aid anew",
        )
        return markup.div("ug-live-foot", markup.span("ug-note", hint) + reset)


def _shares(camera: LiveCamera) -> str:
    cells = (
        ("mean", f"{camera.mean_gray:.0f} of {2**camera.bit_depth - 1}", ""),
        ("saturated", percent(camera.saturated_share), "#e23030" if camera.saturated_share > 0 else ""),
        ("black", percent(camera.black_share), "#3f86ff" if camera.black_share > 0 else ""),
    )  # fmt: skip
    inner = "".join(
        f'<span>{name} <b style="color:{colour or "inherit"}">{markup.esc(value)}</b></span>'
        for name, value, colour in cells
    )
    return markup.div("ug-shares", inner)
