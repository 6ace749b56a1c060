"""The public port, and tokens that stay out of the log."""

import asyncio
import contextlib
import logging
import socket

import pytest

from backend.api.server import TokensHidden, public_socket
from backend.domain.errors import StartupError


def test_a_free_port_is_listened_on_at_once() -> None:
    with contextlib.closing(public_socket("127.0.0.1", 0)) as listening:
        with socket.create_connection(listening.getsockname()):
            pass


def test_a_stalled_browser_is_cut_by_the_kernel() -> None:
    with contextlib.closing(public_socket("127.0.0.1", 0)) as listening:
        with socket.create_connection(listening.getsockname()):
            accepted, _ = listening.accept()
            with accepted:
                option = accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)

    assert option == 30_000


def test_answers_dont_wait_for_the_clients_acknowledgement() -> None:
    without_delay: list[int] = []

    class Noting(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            accepted = transport.get_extra_info("socket")
            without_delay.append(accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            transport.close()

    async def accept_one() -> None:
        with contextlib.closing(public_socket("127.0.0.1", 0)) as listening:
            server = await asyncio.get_running_loop().create_server(Noting, sock=listening)
            reader, writer = await asyncio.open_connection(*listening.getsockname())
            await reader.read()
            writer.close()
            server.close()

    asyncio.run(accept_one())

    assert without_delay == [1]


def test_a_port_in_use_is_one_sentence_with_the_way_out() -> None:
    with contextlib.closing(public_socket("127.0.0.1", 0)) as first:
        port = first.getsockname()[1]

        with pytest.raises(StartupError) as refused:
            public_socket("127.0.0.1", port)

    assert str(refused.value) == (
        f"Port {port} of 127.0.0.1 is in use by another program; stop that one, or choose "
        "another port with --port or UNGLARE_PORT."
    )


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(StartupError, match=r"Port 0 of 192\.0\.2\.1 can't be listened on"):
        public_socket("192.0.2.1", 0)


def test_an_address_that_isnt_one_is_refused() -> None:
    with pytest.raises(StartupError, match="'no such address!' isn't known"):
        public_socket("no such address!", 0)


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("GET /?token=s3cret HTTP/1.1", "GET /?token=*** HTTP/1.1"),
        ("/login?next=/&token=s3cret&user=Ada", "/login?next=/&token=***&user=Ada"),
        ("no secret here", "no secret here"),
    ],
)
def test_tokens_stay_out_of_the_log(line: str, shown: str) -> None:
    record = logging.LogRecord("x", logging.INFO, "f", 1, '%s "%s"', ("WebSocket", line), None)

    assert TokensHidden().filter(record)
    assert record.getMessage() == f'WebSocket "{shown}"'
