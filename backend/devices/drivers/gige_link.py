"""What stands between a GigE Vision camera and its pictures, though it answers or should: in one sentence each."""

import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path

ROUTES = Path("/proc/net/route")
LARGEST_BUFFER = Path("/proc/sys/net/core/rmem_max")
WANTED_BUFFER_BYTES = 8 << 20
"""Receive buffer of a stream: the kernel's default doesn't find room for a burst of packets."""
_GATEWAY = 0x2
_OTHER_PACKETS = 2
"""Small packets of a frame, before and behind its pixels."""


@dataclass(frozen=True)
class StreamCounts:
    """What a stream has seen since it was made."""

    packets: int
    """Of any kind and size that arrived."""
    frames: int
    """Complete ones."""
    broken_frames: int


def wrong_network(address: str, routes: str) -> str:
    """Say that no network card of this computer is in a camera's network; empty if one is, or nobody can tell.

    Parameters
    ----------
    address
        IPv4 address of the camera.
    routes
        Content of `ROUTES`.
    """
    camera = IPv4Address(address)
    networks = list(_direct_networks(routes))
    if camera.is_loopback or not networks or any(camera in network for network in networks):
        return ""
    ours = ", ".join(map(str, networks))
    return (
        f"no network card of this computer is in its network (they are in {ours}): give the card that the camera is plugged"
        f" into an address beside the camera's, e.g. {_beside(camera)}/24, or give the camera another one"
    )


def _direct_networks(routes: str) -> Iterator[IPv4Network]:
    """Return the networks that are reached without a gateway."""
    for line in routes.splitlines()[1:]:
        fields = line.split()
        if len(fields) < 8 or int(fields[3], 16) & _GATEWAY:
            continue
        network, mask = (socket.inet_ntoa(struct.pack("<I", int(fields[i], 16))) for i in (1, 7))
        yield IPv4Network(f"{network}/{mask}", strict=False)


def _beside(camera: IPv4Address) -> IPv4Address:
    first = IPv4Address(int(camera) & 0xFFFFFF00) + 1
    return first if first != camera else first + 1


def small_buffer(frame_bytes: int, largest_bytes: int) -> str:
    """Say that a frame's packets don't find room where the computer is busy for a moment; empty if they do."""
    if largest_bytes >= min(frame_bytes, WANTED_BUFFER_BYTES):
        return ""
    return (
        f"a frame has {frame_bytes / 1e6:.1f} MB, but this computer allows receive buffers of {largest_bytes / 1e6:.1f} MB:"
        " packets get lost whenever it is busy; raise the limit: sudo sysctl -w net.core.rmem_max=33554432"
    )


def stream_trouble(counts: StreamCounts, packet_bytes: int, address: str) -> str:
    """Say why no picture arrives of a camera that was triggered and answers commands; empty if nobody can tell."""
    if counts.packets == 0:
        return (
            "it answers commands, but no packet of its pictures arrives: let UDP from it through this computer's firewall,"
            f" e.g. sudo ufw allow proto udp from {address}"
        )
    heads_only = counts.packets <= _OTHER_PACKETS * max(1, counts.broken_frames)
    if counts.frames == 0 and heads_only:
        return (
            f"only the small packets of its pictures arrive, those of {packet_bytes} bytes don't: leave packet_bytes out of"
            " the rig file, give 1500, or switch jumbo frames on at network card and switch"
        )
    return ""


def content_of(path: Path) -> str:
    """Return what the system says at a path; empty where it says nothing."""
    try:
        return path.read_text("ascii")
    except (OSError, UnicodeDecodeError):
        return ""
