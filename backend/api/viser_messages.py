"""What a browser may send to the station: viser itself refuses nothing.

viser obeys whatever message arrives: buttons that are hidden, any attribute of any control
(`updates={"update_cb": []}` switches a control off for everybody), and a request to open a public
tunnel through somebody else's server. So only named messages pass, by role.
"""

from typing import Any

import msgspec

from backend.api.sessions import Role

_LOOK = frozenset(
    {"ViewerCameraMessage", "GetRenderResponseMessage", "LocalStorageGetItemResponseMessage"}
)
_OPERATE = _LOOK | {
    "GuiUpdateMessage",
    "GuiButtonHoldMessage",
    "GuiFormSubmitMessage",
    "GuiFormDirtyMessage",
    "CommandTriggerMessage",
    "ScenePointerMessage",
    "SceneNodeClickMessage",
    "SceneNodeDragMessage",
    "TransformControlsUpdateMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsDragEndMessage",
}  # no FileTransfer*: files come in through the API, which limits and checks them
ALLOWED = {Role.VIEWER: _LOOK, Role.OPERATOR: _OPERATE}


class _Head(msgspec.Struct):
    """The part of a message that decides; the rest is skipped without building objects of it."""

    type: str
    updates: Any = None


_DECODER = msgspec.msgpack.Decoder(_Head)


def allowed(message: bytes, role: Role) -> bool:
    """Tell whether a browser with this role may send this message to the station.

    Garbage, unknown messages and updates of anything but a control's `value` are not.
    """
    try:
        head = _DECODER.decode(message)
    except (msgspec.MsgspecError, RecursionError, ValueError):
        return False
    if head.type not in ALLOWED[role]:
        return False
    return head.type != "GuiUpdateMessage" or _changes_the_value_only(head.updates)


def _changes_the_value_only(updates: Any) -> bool:
    return isinstance(updates, dict) and updates.keys() == {"value"}
