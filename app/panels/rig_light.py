"""What is projected while pictures are live, and how they are exposed."""

import threading
from typing import Any, Protocol

import numpy as np
import viser

from app import markup
from app.desk import Desk
from app.exposing import advised
from app.numbers import number
from backend.contract.rigs import Limits, LiveSettings, LiveView, RigLink, RigState

_TYPING_S = 0.5
"""A number counts when nothing was typed for so long."""
_STEP = 1.08
"""From one stop of the exposure's slider to the next, where it isn't a whole period."""
_GRAY = "gray"
_MOST_STEPS = 8
"""So many exposures are tried before the search for one is given up: the scene changes."""
_SAME = 0.05
"""Exposures that differ by less are the same: cameras round them."""


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
        self._lock = threading.RLock()
        self._settings = LiveSettings()
        """Those on the screen: what was asked for last, else what is in force."""
        self._wanted: LiveSettings | None = None
        """Asked for and not answered yet: what is in force meanwhile is older."""
        self._typed: dict[str, Any] = {}
        self._grid: tuple[float, ...] = (1.0,)
        self._waiting: threading.Timer | None = None
        self._steps_left = 0
        """Of the search for an exposure; 0: none is searched for."""
        self._patterns = gui.add_html("")
        self._level: Any = gui.add_slider("Gray level", 0, 255, 1, 128, visible=False)
        self._exposure: Any = gui.add_number("Exposure [ms]", 20.0, min=0.0, step=0.01)
        gui.add_html(markup.marker("ug-bare"))
        self._stops: Any = gui.add_slider("", 0, 1, 1, 0)
        self._period = gui.add_html("")
        self._gain: Any = gui.add_slider("Gain [dB]", 0.0, 1.0, 0.1, 0.0)
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
        with self._lock:
            old, self._state = self._state, state
            is_other = old is None or anew or old.name != state.name
            if is_other or (old is not None and _reach(old) != _reach(state)):
                self._show_reach(state)
            if is_other:
                self._forget_wishes()
                self.put(state.live)
            else:
                self._draw_period()
        is_free = state.owner is None and state.link is RigLink.OPEN
        for control in self._controls():
            control.disabled = not is_free
        self._snap.disabled |= state.period_ms is None
        if state.gain_db is not None and state.gain_db.max <= state.gain_db.min:
            self._gain.disabled = True
        self._draw_patterns()

    def show_live(self, live: LiveView) -> None:
        """Show the settings in force, unless something is typed or asked for just now."""
        with self._lock:
            if self._waiting is not None or self._wanted is not None:
                return
            if live.settings != self._settings:
                self.put(live.settings)
                self._draw_patterns()
            if self._steps_left:
                self._search(live)

    def answered(self, asked: LiveSettings, in_force: LiveSettings) -> None:
        """Show what came of a change, unless another one was asked for since."""
        with self._lock:
            if self._wanted not in (None, asked):
                return
            self._wanted = None
            if self._waiting is None:
                self.put(in_force)
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
        self._show_what_follows(settings)

    def _show_what_follows(self, settings: LiveSettings) -> None:
        self._level.visible = self._operates and settings.pattern == _GRAY
        self._draw_period()

    def _stop_of(self, exposure_ms: float) -> int:
        return int(np.argmin(np.abs(np.log(np.array(self._grid) / max(exposure_ms, 1e-6)))))

    def _draw_period(self) -> None:
        content = self._period_html(self._settings)
        if self._period.content != content:
            self._period.content = content

    def _period_html(self, settings: LiveSettings) -> str:
        state = self._state
        if state is None or state.exposure_ms is None:
            return ""
        words, doubtful = _in_periods(settings.exposure_ms, state.period_ms)
        reach = f"{number(state.exposure_ms.min)} to {number(state.exposure_ms.max)} ms"
        css = "ug-setting-note" if doubtful else "ug-setting-note ug-examples"
        told = markup.span("", markup.esc(words), title=f"The cameras can do {reach}")
        return markup.div(f"{css} ug-between", told + self._search_link(state))

    def _search_link(self, state: RigState) -> str:
        if not self._operates or state.owner is not None or state.link is not RigLink.OPEN:
            return ""
        if self._steps_left:
            return self._desk.clicks.label("search", self._give_up, "searching … stop", "ug-link")
        hint = "Search the exposure at which the brightest pixels stay just below saturation"
        return self._desk.clicks.label("search", self._begin_search, "auto", "ug-link", hint)

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
        """Show a change and send it at once, together with what is typed and what isn't answered yet."""
        with self._lock:
            self._stop_waiting()
            if not {"snap", "pattern", "level"}.issuperset(changes):
                self._steps_left = 0  # whoever sets the light himself doesn't want it searched
            wanted = self._settings.model_copy(update={**self._typed, **changes})
            self._typed = {}
            self._ask(wanted)

    def _ask(self, wanted: LiveSettings) -> None:
        is_other_grid = wanted.snap != self._settings.snap
        self._settings = self._wanted = wanted
        if is_other_grid:
            self._show_grid()
        self._show_what_follows(wanted)
        self._draw_patterns()
        self._page.set_live(wanted)

    def _change_later(self, **changes: Any) -> None:
        """Send a change when nothing more is typed."""
        with self._lock:
            self._stop_waiting()
            self._typed |= changes
            self._waiting = threading.Timer(_TYPING_S, lambda: self._change(**self._typed))
            self._waiting.daemon = True
            self._waiting.start()

    def _forget_wishes(self) -> None:
        self._stop_waiting()
        self._wanted, self._typed, self._steps_left = None, {}, 0

    # ---- searching an exposure

    def _begin_search(self) -> None:
        with self._lock:
            self._steps_left = _MOST_STEPS
            self._draw_period()

    def _give_up(self) -> None:
        with self._lock:
            self._steps_left = 0
            self._draw_period()

    def _search(self, live: LiveView) -> None:
        """Take the next step as soon as all cameras show the present exposure."""
        now_ms = live.settings.exposure_ms
        state = self._state
        shown = [c.exposure_ms or now_ms for c in live.cameras]
        if (
            state is None
            or state.exposure_ms is None
            or not shown
            or any(abs(ms / now_ms - 1) > _SAME for ms in shown)
        ):
            return
        advice = advised([c.histogram for c in live.cameras], now_ms, self._grid)
        self._steps_left -= 1
        if abs(advice.exposure_ms / now_ms - 1) > _SAME and self._steps_left:
            self._ask(self._settings.model_copy(update={"exposure_ms": advice.exposure_ms}))
            return
        self._give_up()
        if advice.remark:
            self._desk.notify("Exposure", advice.remark, colour="orange")

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


def _in_periods(exposure_ms: float, period_ms: float | None) -> tuple[str, bool]:
    """Say how many periods of the projector an exposure is, and whether that is doubtful."""
    if period_ms is None:
        return "", False
    periods = exposure_ms / period_ms
    is_whole = abs(periods - round(periods)) < 1e-3
    count = number(round(periods) if is_whole else round(periods, 2))
    words = f"{count} {'period' if count == '1' else 'periods'} of {number(period_ms)} ms"
    return (words, False) if is_whole else (f"{words}: may flicker", True)


def _reach(state: RigState) -> tuple[Any, ...]:
    return state.name, state.exposure_ms, state.gain_db, state.period_ms
