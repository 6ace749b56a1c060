"""What a browser may send to the station."""

import msgspec
import pytest
import viser._messages as viser_messages
from hypothesis import given
from hypothesis import strategies as st

from backend.api.sessions import Role
from backend.api.viser_messages import ALLOWED, allowed


def packed(**fields: object) -> bytes:
    return msgspec.msgpack.encode(fields)


CLICK = packed(type="GuiUpdateMessage", uuid="button", updates={"value": True})


@pytest.mark.parametrize(
    ("message", "operator", "viewer"),
    [
        pytest.param(packed(type="ViewerCameraMessage", fov=1.0), True, True, id="camera"),
        pytest.param(CLICK, True, False, id="click"),
        pytest.param(packed(type="CommandTriggerMessage", uuid="x"), True, False, id="hotkey"),
        pytest.param(packed(type="ScenePointerMessage"), True, False, id="pointer"),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x", updates={"update_cb": []}),
            False,
            False,
            id="update of another attribute",
        ),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x", updates={"value": 1, "visible": True}),
            False,
            False,
            id="update of value and another attribute",
        ),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x", updates={}), False, False, id="no update"
        ),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x"), False, False, id="update without updates"
        ),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x", updates=["value"]),
            False,
            False,
            id="updates that are a list",
        ),
        pytest.param(
            packed(type="GuiUpdateMessage", uuid="x", updates=7), False, False, id="number"
        ),
        pytest.param(packed(type="ShareUrlRequest"), False, False, id="share"),
        pytest.param(packed(type="ShareUrlDisconnect"), False, False, id="end sharing"),
        pytest.param(packed(type="RunJavascriptMessage", source="1"), False, False, id="script"),
        pytest.param(packed(type="FileTransferStartUpload"), False, False, id="upload"),
        pytest.param(packed(type=["ViewerCameraMessage"]), False, False, id="type that is a list"),
        pytest.param(packed(kind="ViewerCameraMessage"), False, False, id="no type"),
        pytest.param(msgspec.msgpack.encode(["ViewerCameraMessage"]), False, False, id="list"),
        pytest.param(b"", False, False, id="empty"),
        pytest.param(b"\xc1garbage", False, False, id="garbage"),
        pytest.param(CLICK[:-1], False, False, id="cut off"),
        pytest.param(CLICK + b"\x00", False, False, id="with a tail"),
        pytest.param(b"\x91" * 100_000 + b"\x90", False, False, id="deeply nested"),
        pytest.param(
            b"\x82\xa4type\xb3ViewerCameraMessage\xa1x" + b"\x91" * 100_000 + b"\x90",
            False,
            False,
            id="deeply nested field",
        ),
        # the decoder of the other side takes the last of two keys: so does ours
        pytest.param(
            b"\x82\xa4type\xb3ViewerCameraMessage\xa4type\xafShareUrlRequest",
            False,
            False,
            id="two types",
        ),
    ],
)
def test_what_passes(message: bytes, operator: bool, viewer: bool) -> None:
    assert allowed(message, Role.OPERATOR) is operator
    assert allowed(message, Role.VIEWER) is viewer


@given(st.binary(max_size=200), st.sampled_from(Role))
def test_any_bytes_are_answered_with_yes_or_no(message: bytes, role: Role) -> None:
    assert allowed(message, role) in (True, False)


def test_a_viewer_may_do_nothing_that_an_operator_may_not() -> None:
    assert ALLOWED[Role.VIEWER] < ALLOWED[Role.OPERATOR]


def test_the_names_are_those_of_the_pinned_viser() -> None:
    known = {name for name in dir(viser_messages) if not name.startswith("_")}

    assert known >= ALLOWED[Role.OPERATOR]
