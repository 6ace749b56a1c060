"""Keys: what one does, and for whom the list of all commands (Ctrl+K) names it."""

from collections.abc import Callable
from typing import Any

import viser

Key = tuple[str, str, str | None, Callable[[], None]]
"""What it does, the key, what is held down with it, and the work, which has to return at once."""


def add_keys(gui: viser.GuiApi, keys: list[Key]) -> None:
    """Let keys do their work."""
    for label, key, modifier, work in keys:
        command = gui.add_command(label, hotkey=key, modifier=modifier)  # type: ignore[arg-type]  # keys as viser lists them
        _on_trigger(command, work)


def _on_trigger(command: viser.CommandHandle, work: Callable[[], None]) -> None:
    @command.on_trigger
    async def _(_: Any) -> None:
        work()
