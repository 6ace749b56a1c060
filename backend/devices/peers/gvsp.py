"""GigE Vision's stream protocol (GVSP): a frame as packets, leader and trailer around the pixels."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

PIXEL_FORMATS = {"Mono8": 0x01080001, "Mono12": 0x01100005, "Mono16": 0x01100007}
"""GenICam's PixelFormat codes of what is sent here, by SFNC name."""

OVERHEAD_BYTES = 36
"""Of each packet: IPv4 header 20, UDP header 8, stream header 8."""

_HEADER = struct.Struct(">HHI")
_LEADER = struct.Struct(">HHQIIIIIHH")
_TRAILER = struct.Struct(">HHI")
_LEADER_FORMAT, _TRAILER_FORMAT, _PAYLOAD_FORMAT = 1, 2, 3
_IMAGE = 1


@dataclass(frozen=True)
class Block:
    """One frame on its way."""

    block_id: int
    """1..65535; 0 is never used."""
    timestamp_ticks: int
    pixel_format: int
    width_px: int
    height_px: int
    pixels: bytes | memoryview
    packet_bytes: int
    """Size of a packet on the wire, headers included."""

    @property
    def chunk_bytes(self) -> int:
        """Pixels' bytes in one packet."""
        return self.packet_bytes - OVERHEAD_BYTES

    @property
    def last_packet(self) -> int:
        """Id of the trailer; the leader's is 0."""
        return -(-len(self.pixels) // self.chunk_bytes) + 1

    def packet(self, number: int) -> bytes:
        """Write one packet."""
        if number == 0:
            return self._head(_LEADER_FORMAT, 0) + self._leader()
        if number == self.last_packet:
            return self._head(_TRAILER_FORMAT, number) + _TRAILER.pack(0, _IMAGE, self.height_px)
        start = (number - 1) * self.chunk_bytes
        chunk = self.pixels[start : start + self.chunk_bytes]
        return b"".join((self._head(_PAYLOAD_FORMAT, number), chunk))

    def packets(self) -> Iterator[bytes]:
        """Write all packets in order."""
        return (self.packet(number) for number in range(self.last_packet + 1))

    def _head(self, packet_format: int, number: int) -> bytes:
        return _HEADER.pack(0, self.block_id, packet_format << 24 | number)

    def _leader(self) -> bytes:
        return _LEADER.pack(
            0, _IMAGE, self.timestamp_ticks, self.pixel_format, self.width_px, self.height_px, 0, 0, 0, 0
        )  # fmt: skip


def next_block_id(block_id: int) -> int:
    """Count on: after 65535 comes 1."""
    return block_id % 0xFFFF + 1
