"""Why no picture of a camera arrives: told from what system and stream say."""

import pytest

from backend.devices.drivers.gige_link import (
    StreamCounts,
    small_buffer,
    stream_trouble,
    wrong_network,
)

ROUTES = """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth0\t000200C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
eth1\t0000FEA9\t00000000\t0001\t0\t0\t0\t0000FFFF\t0\t0\t0
"""


@pytest.mark.parametrize(
    ("address", "routes", "words"),
    [
        ("192.0.2.7", ROUTES, ""),
        ("169.254.3.9", ROUTES, ""),
        ("127.0.0.2", ROUTES, ""),
        ("10.1.2.3", "", ""),
        ("10.1.2.3", "garbage\n1 2 3", ""),
        ("10.1.2.3", ROUTES, "(they are in 192.0.2.0/24, 169.254.0.0/16): give the card"),
        ("10.1.2.3", ROUTES, "e.g. 10.1.2.1/24"),
        ("10.1.2.1", ROUTES, "e.g. 10.1.2.2/24"),
    ],
)
def test_a_camera_in_another_network_is_told(address: str, routes: str, words: str) -> None:
    said = wrong_network(address, routes)
    assert words in said
    assert bool(said) == bool(words)


@pytest.mark.parametrize(
    ("frame_bytes", "largest_bytes", "told"),
    [
        (1_310_720, 212_992, True),
        (1_310_720, 4_194_304, False),
        (100_000_000, 8 << 20, False),
        (100_000_000, (8 << 20) - 1, True),
    ],
)
def test_a_receive_buffer_is_too_small_for_a_frame(
    frame_bytes: int, largest_bytes: int, told: bool
) -> None:
    said = small_buffer(frame_bytes, largest_bytes)
    assert ("sysctl -w net.core.rmem_max=33554432" in said) == told


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        (StreamCounts(packets=0, frames=0, broken_frames=0), "sudo ufw allow proto udp from 10.1.2.3"),
        (StreamCounts(packets=2, frames=0, broken_frames=1), "those of 9000 bytes don't"),
        (StreamCounts(packets=120, frames=0, broken_frames=1), ""),
        (StreamCounts(packets=5000, frames=40, broken_frames=1), ""),
        (StreamCounts(packets=2, frames=1, broken_frames=1), ""),
    ],
)  # fmt: skip
def test_what_a_stream_has_seen_says_what_is_wrong(counts: StreamCounts, words: str) -> None:
    said = stream_trouble(counts, 9000, "10.1.2.3")
    assert words in said
    assert bool(said) == bool(words)
