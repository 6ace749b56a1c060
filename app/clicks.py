"""HTML that can be clicked, without a script: a label for a button that nobody sees."""

from collections.abc import Callable

import viser

from app import markup
from app.station import element_id

_LAST = 1e6
_MOST = 240

Action = Callable[[], None]


class Clicks:
    """Gives out labels, each for a hidden button of its own.

    A key keeps its button as long as the browser is connected, so a click on a picture that is about to change
    can't hit the wrong thing. Buttons that were not asked for longest are given new keys.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._buttons: dict[str, viser.GuiButtonHandle] = {}
        self._actions: dict[int, Action] = {}
        gui.add_html(markup.marker("ug-hidden-below"), order=_LAST)

    def label(self, key: str, action: Action, inner: str, css: str = "", title: str = "") -> str:
        """Return HTML around `inner` (already harmless) that calls `action` when clicked."""
        button = self._button(key)
        self._actions[id(button)] = action
        hint = {"title": title} if title else {}
        return markup.tag("label", f"ug-click {css}", inner, for_=element_id(button), **hint)

    def _button(self, key: str) -> viser.GuiButtonHandle:
        button = self._buttons.pop(key, None)
        if button is None and len(self._buttons) >= _MOST:
            button = self._buttons.pop(next(iter(self._buttons)))
        if button is None:
            button = self._gui.add_button("·", order=_LAST + 1)
            self._listen(button)
        self._buttons[key] = button
        return button

    def _listen(self, button: viser.GuiButtonHandle) -> None:
        @button.on_click
        async def _(_: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            self._actions[id(button)]()
