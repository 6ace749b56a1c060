"""What is projected while pictures are live, and how they are exposed."""

import threading
from typing import Any, Protocol

import numpy as np
import viser

from app import markup
from app.desk import Desk
from app.numbers import number
from backend.contract.rigs import Limits, LiveSettings, LiveView, RigLink, RigState

_TYPING_S = 0.5
"""A number counts when nothing was typed for so long."""
_STEP = 1.08
"""From one stop of the exposure's slider to the next, where it isn't a whole period."""
_GRAY = "gray"


class Page(Protocol):
    """What is asked of the rig's page."""

    def set_live(self, settings: LiveSettings) -> None:
        """Take live pictures otherwise from now on."""

    def want_live(self, wants: bool) -> None:
        """Take live pictures, or let the rig rest."""


class LightPanel:
    """Pattern, exposure, gain, in the container that is open when it is made."""

    def __init__(self, gui: viser.GuiApi, desk: Desk, page: Page) -> None:
        self._desk, self._page = desk, page
        self._state: RigState | None = None
        self._settings = LiveSettings()
        self._grid: tuple[float, ...] = (1.0,)
        self._waiting: threading.Timer | None = None
        self._touched_at: float = 0.0
        self._patterns = gui.add_html("")
        self._level: Any = gui.add_slider("Gray level", 0, 255, 1, 128, visible=False)
        self._exposure: Any = gui.add_number("Exposure [ms]", 20.0, min=0.0, step=0.01)
        gui.add_html(markup.marker("ug-bare"))
        self._stops: Any = gui.add_slider("", 0, 1, 1, 0)
        self._gain: Any = gui.add_slider("Gain [dB]", 0.0, 1.0, 0.1, 0.0)
        self._period = gui.add_html("")
        gui.add_html(markup.marker("ug-row3 ug-boxes"))
        self._live: Any = gui.add_checkbox(
            "Live", True, hint="Take pictures as long as this page is open"
        )
        self._marks: Any = gui.add_checkbox(
            "Marks", True, hint="Saturated pixels red, pixels at 0 blue"
        )
        self._snap: Any = gui.add_checkbox(
            "Snap", True, hint="Expose for whole periods of the projector"
        )
        self._operates = desk.who.may_operate
        for control in self._controls():
            control.visible = self._operates and control is not self._level
        self._live.visible = self._operates
        if self._operates:
            self._listen()

    @property
    def marks(self) -> bool:
        """Whether pixels are marked that are too bright or too dark."""
        return bool(self._marks.value)

    def show(self, state: RigState, *, anew: bool = False) -> None:
        """Show this state; `anew` writes the controls even where nothing has changed."""
        old, self._state = self._state, state
        if old is None or anew or _reach(old) != _reach(state):
            self._show_reach(state)
        if old is None or anew or old.name != state.name:
            self.put(state.live)
        is_free = state.owner is None and state.link is RigLink.OPEN
        for control in self._controls():
            control.disabled = not is_free
        self._snap.disabled |= state.period_ms is None
        if state.gain_db is not None and state.gain_db.max <= state.gain_db.min:
            self._gain.disabled = True
        self._draw_patterns()

    def show_live(self, live: LiveView) -> None:
        """Show the settings in force, unless something is typed just now."""
        if live.settings != self._settings and self._waiting is None:
            self.put(live.settings)
            self._draw_patterns()

    # ---- drawing

    def _controls(self) -> tuple[Any, ...]:
        return self._level, self._exposure, self._stops, self._gain, self._snap

    def _show_reach(self, state: RigState) -> None:
        exposure_ms, gain_db = state.exposure_ms, state.gain_db
        if exposure_ms is None or gain_db is None:
            return
        self._exposure.min, self._exposure.max = exposure_ms.min, exposure_ms.max
        self._gain.min, self._gain.max = gain_db.min, max(gain_db.max, gain_db.min + 0.1)
        self._gain.step = max(gain_db.step, 0.1)
        self._show_grid()

    def _show_grid(self) -> None:
        state = self._state
        if state is None or state.exposure_ms is None:
            return
        period_ms = state.period_ms if self._settings.snap else None
        self._grid = stops_ms(state.exposure_ms, period_ms)
        self._stops.max = max(len(self._grid) - 1, 1)

    def put(self, settings: LiveSettings) -> None:
        """Write the settings in force into the controls."""
        is_other_grid = settings.snap != self._settings.snap
        self._settings = settings
        if is_other_grid:
            self._show_grid()
        for control, value in (
            (self._exposure, round(settings.exposure_ms, 3)), (self._gain, settings.gain_db),
            (self._snap, settings.snap), (self._level, settings.level), (self._stops, self._stop_of(settings.exposure_ms)),
        ):  # fmt: skip
            if control.value != value:
                control.value = value
        self._level.visible = self._operates and settings.pattern == _GRAY
        self._period.content = self._period_html(settings)

    def _stop_of(self, exposure_ms: float) -> int:
        return int(np.argmin(np.abs(np.log(np.array(self._grid) / max(exposure_ms, 1e-6)))))

    def _period_html(self, settings: LiveSettings) -> str:
        period_ms = self._state.period_ms if self._state else None
        if period_ms is None:
            return ""
        periods = settings.exposure_ms / period_ms
        is_whole = abs(periods - round(periods)) < 1e-3
        count = number(round(periods) if is_whole else round(periods, 2))
        words = f"{count} {'period' if count == '1' else 'periods'} of {number(period_ms)} ms"
        css = "ug-setting-note ug-examples" if is_whole else "ug-setting-note"
        return markup.div(css, markup.esc(words if is_whole else f"{words}: may flicker"))

    def _draw_patterns(self) -> None:
        state = self._state
        if state is None:
            return
        is_free = self._operates and state.owner is None and state.link is RigLink.OPEN
        chips = "".join(self._chip(p, is_free=is_free) for p in state.patterns)
        content = markup.div("ug-heading", "Projected") + markup.div("ug-patterns", chips)
        if self._patterns.content != content:
            self._patterns.content = content

    def _chip(self, pattern: str, *, is_free: bool) -> str:
        css = "ug-pattern" + (" ug-on" if pattern == self._settings.pattern else "")
        if not is_free:
            return markup.span(f"{css} ug-off", markup.esc(pattern))
        return self._desk.clicks.label(
            f"pattern {pattern}",
            lambda: self._change(pattern=pattern),
            markup.esc(pattern),
            css,
            f"Project: {pattern}",
        )

    # ---- changing

    def _listen(self) -> None:
        self._on(self._exposure, lambda v: self._change_later(exposure_ms=float(v)))
        self._on(
            self._stops,
            lambda v: self._change(exposure_ms=self._grid[min(int(v), len(self._grid) - 1)]),
        )
        self._on(self._gain, lambda v: self._change(gain_db=float(v)))
        self._on(self._level, lambda v: self._change(level=int(v)))
        self._on(self._snap, lambda v: self._change(snap=bool(v)))
        self._on(self._live, lambda v: self._page.want_live(bool(v)))

    def _on(self, control: Any, work: Any) -> None:
        async def changed(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                work(control.value)

        control.on_update(changed)

    def _change(self, **changes: Any) -> None:
        """Send a change at once; the newest of several waiting ones counts."""
        self._stop_waiting()
        wanted = self._settings.model_copy(update=changes)
        if "snap" in changes:
            self._settings, old = wanted, self._settings
            self._show_grid()
            self._settings = old
        self._page.set_live(wanted)

    def _change_later(self, **changes: Any) -> None:
        """Send a change when nothing more is typed."""
        self._stop_waiting()
        self._waiting = threading.Timer(_TYPING_S, lambda: self._change(**changes))
        self._waiting.daemon = True
        self._waiting.start()

    def _stop_waiting(self) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting.cancel()


def stops_ms(limits: Limits, period_ms: float | None) -> tuple[float, ...]:
    """Return the exposures that the slider stops at: whole periods, each a tenth or so longer than the one before.

    Examples
    --------
    >>> stops_ms(Limits(min=1.0, max=45.0), 10.0)
    (10.0, 20.0, 30.0, 40.0)
    >>> [round(ms, 2) for ms in stops_ms(Limits(min=10.0, max=11.0), None)]
    [10.0, 10.8, 11.0]
    """
    least = limits.min if limits.min > 0 else limits.max / 1e4
    if period_ms is None or limits.max < period_ms:
        count = max(int(np.log(limits.max / least) / np.log(_STEP)), 0)
        steps = [least * _STEP**i for i in range(count + 1)]
        return tuple(steps if np.isclose(steps[-1], limits.max) else [*steps, limits.max])
    periods = [max(1, int(np.ceil(least / period_ms - 1e-9)))]
    while (more := max(periods[-1] + 1, int(periods[-1] * _STEP))) * period_ms <= limits.max * (
        1 + 1e-9
    ):
        periods.append(more)
    return tuple(k * period_ms for k in periods)


def _reach(state: RigState) -> tuple[Any, ...]:
    return state.name, state.exposure_ms, state.gain_db, state.period_ms
