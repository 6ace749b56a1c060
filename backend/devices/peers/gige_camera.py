"""A GigE Vision camera in pure Python: serves any `Camera` over the real protocol, to any GigE Vision client.

The simulated rig's cameras, served like this, let real drivers be used and tested without a laboratory. No
privileges are needed: UDP port 3956 is open to everybody, and 127.0.0.0/8 has an address for each camera.
"""

import contextlib
import logging
import random
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from backend.devices.errors import DeviceDisconnected, DeviceError, DeviceTimeout, FeatureError
from backend.devices.peers import genicam as features
from backend.devices.peers.gvcp import (
    DISCOVERY_BYTES,
    PORT,
    Bootstrap,
    Command,
    RefusedError,
    Request,
    Status,
    answer,
    parse_request,
)
from backend.devices.peers.gvsp import PIXEL_FORMATS, Block, next_block_id
from backend.devices.peers.processing import TEST_PATTERNS, Processing
from backend.devices.peers.registers import Registers, Writer
from backend.devices.protocols import Camera, CameraSettings, Frame, Range, TriggerSource

log = logging.getLogger(__name__)

PACKET_BYTES = Range(576, 16_000, 4, "bytes")
HEARTBEAT_MS = 3000
_TICKS_PER_S = 1_000_000_000
_KEPT_BLOCKS = 8
"""Frames that can still be resent."""
_POLL_S = 0.1
_HEADERS_BYTES = 28
"""IPv4's and UDP's, which count as a part of a packet."""
_TEST_PACKET = 0x8000_0000
"""Bit of the packet size register that asks for a packet of that size."""


@dataclass(frozen=True)
class Wire:
    """What the way to the client does to packets."""

    loss: float = 0.0
    """Share of stream packets that get lost; resent ones arrive."""
    pause_every: int = 16
    """After so many packets the sender pauses, so that small receive buffers keep up."""
    pause_s: float = 0.0002
    seed: int = 0
    largest_bytes: int | None = None
    """Longer packets never arrive, as at a switch without jumbo frames; 0: none does, as at a firewall."""


class GigECamera:
    """One camera on the network. `start` and `stop`, or a `with` block.

    Two threads: one answers commands, one sends frames. The served camera is opened by `start`.

    Parameters
    ----------
    camera
        What takes the pictures.
    address
        IPv4 address to listen on, e.g. 127.0.0.2.
    wire
        Losses and pace of the stream.
    """

    def __init__(self, camera: Camera, address: str, wire: Wire | None = None) -> None:
        self._camera = camera
        self._address = address
        self._wire = wire or Wire()
        self._random = random.Random(self._wire.seed)  # noqa: S311  losses needn't be unguessable
        self._registers = Registers()
        self._client: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._acquiring = threading.Event()
        self._acquisitions = 0
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self._blocks: OrderedDict[int, Block] = OrderedDict()
        self._block_id = 0
        self._free_at_s = 0.0
        self.dropped_triggers = 0
        """Triggers that came during an exposure."""
        self.resent_packets = 0

    def start(self) -> None:
        """Open the camera, take the port and answer from now on.

        Raises
        ------
        OSError
            If the address isn't this machine's, or another camera has it.
        DeviceError
            If the served camera can't be opened.
        """
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._control.bind((self._address, PORT))
            self._stream.bind((self._address, 0))
            self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
            self._control.settimeout(_POLL_S)
            self._camera.open()
            self._describe()
        except BaseException:
            self._close_sockets()
            raise
        self._ending.clear()
        for work in (self._answer_commands, self._send_frames):
            thread = threading.Thread(
                target=work, name=f"{work.__name__}-{self._address}", daemon=True
            )
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """Leave the network; any number of times."""
        self._ending.set()
        self._stop_acquisition()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        self._release()  # after a restart nobody controls it
        self._close_sockets()
        self._camera.close()

    def __enter__(self) -> "GigECamera":
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    # ------------------------------------------------------------ registers

    def _describe(self) -> None:
        """Fill the registers: who the camera is, its description, its present settings."""
        camera, can, registers = self._camera, self._camera.capabilities, self._registers
        formats = {name: PIXEL_FORMATS[name] for name in can.pixel_formats if name in PIXEL_FORMATS}
        sources = [s.value for s in can.trigger_sources if s.value in features.TRIGGER_SOURCES]
        info = camera.info
        xml = features.describe(
            features.CameraDescription(
                info.vendor,
                info.model,
                formats,
                sources,
                can.exposure_us,
                can.gain_db,
                PACKET_BYTES,
            )
        )
        width_px, height_px = can.sensor_size
        registers.number(Bootstrap.VERSION, 0x0001_0002)
        registers.number(Bootstrap.DEVICE_MODE, 0x8000_0001)
        registers.number(Bootstrap.CURRENT_IP, int.from_bytes(socket.inet_aton(self._address)))
        registers.number(Bootstrap.SUBNET_MASK, 0xFF00_0000)
        for address, text, length in (
            (Bootstrap.VENDOR, info.vendor, 32),
            (Bootstrap.MODEL, info.model, 32),
            (Bootstrap.DEVICE_VERSION, info.firmware or "1", 32),
            (Bootstrap.SERIAL, info.serial, 16),
            (Bootstrap.XML_URL, f"Local:camera.xml;{features.XML_ADDRESS:X};{len(xml):X}", 512),
        ):
            registers.text(address, text, length)
        registers.number(Bootstrap.INTERFACES, 1)
        registers.number(Bootstrap.STREAM_CHANNELS, 1)
        registers.number(
            Bootstrap.CAPABILITY, 0x0000_0007
        )  # several registers at once, memory, resend
        registers.number(Bootstrap.HEARTBEAT_MS, HEARTBEAT_MS)
        registers.number(Bootstrap.TICK_FREQUENCY_HIGH, _TICKS_PER_S >> 32)
        registers.number(Bootstrap.TICK_FREQUENCY_LOW, _TICKS_PER_S & 0xFFFF_FFFF)
        registers.number(Bootstrap.PACKET_SIZE, 1500)
        registers.memory(features.XML_ADDRESS, xml)
        registers.number(features.TRIGGER_MODE.address, features.TRIGGER_MODES["On"])
        registers.memory(features.GAMMA.address, struct.pack(">d", 1.0))
        registers.memory(features.RATE.address, struct.pack(">d", 30.0))
        registers.number(features.WIDTH.address, width_px)
        registers.number(features.HEIGHT.address, height_px)
        self._allow_writes()
        self._show_settings(camera.settings)

    def _allow_writes(self) -> None:
        plain = (
            Bootstrap.HEARTBEAT_MS, Bootstrap.STREAM_PORT, Bootstrap.PACKET_DELAY, Bootstrap.STREAM_ADDRESS,
            features.ACQUISITION_MODE.address, features.PARAMETERS_LOCKED.address,
            features.TRIGGER_SELECTOR.address, features.TRIGGER_ACTIVATION.address,
        )  # fmt: skip
        switches = features.REVERSE_X, features.GAMMA_ENABLE, features.RATE_ENABLE
        numbers = (features.GAMMA, features.GAMMAS), (features.RATE, features.RATES_HZ)
        acting: dict[int, Writer] = {
            Bootstrap.PACKET_SIZE: self._set_packet_size,
            features.PIXEL_FORMAT.address: self._set_pixel_format,
            features.TRIGGER_MODE.address: self._set_trigger_mode,
            features.TRIGGER_SOURCE.address: self._set_trigger_source,
            features.ACQUISITION_START.address: lambda _: self._start_acquisition(),
            features.ACQUISITION_STOP.address: lambda _: self._stop_acquisition(),
            features.TRIGGER_SOFTWARE.address: lambda _: self._trigger(),
            features.EXPOSURE_TIME.address: lambda data: self._set(exposure_us=_double(data)),
            features.GAIN.address: lambda data: self._set(gain_db=_double(data)),
        }
        for address in plain:
            self._registers.writable(address, 4, None)
        for register, allowed in (
            (features.TEST_PATTERN, tuple(TEST_PATTERNS.values())),
            *((switch, (0, 1)) for switch in switches),
        ):
            keep = partial(self._keep_number, register.address, allowed)
            self._registers.writable(register.address, 4, keep)
        for register, limits in numbers:
            keep = partial(self._keep_double, register.address, limits)
            self._registers.writable(register.address, 8, keep)
        for address, act in acting.items():
            doubles = (features.EXPOSURE_TIME.address, features.GAIN.address)
            self._registers.writable(address, 8 if address in doubles else 4, act)

    def _show_settings(self, settings: CameraSettings) -> None:
        pixel_format = settings.pixel_format or "Mono8"
        width_px, height_px = self._camera.capabilities.sensor_size
        payload = width_px * height_px * (1 if pixel_format == "Mono8" else 2)
        registers = self._registers
        registers.number(features.PIXEL_FORMAT.address, PIXEL_FORMATS[pixel_format])
        registers.number(features.PAYLOAD_SIZE.address, payload)
        source = features.TRIGGER_SOURCES.get(settings.trigger.value, 0)
        registers.number(features.TRIGGER_SOURCE.address, source)
        registers.memory(features.EXPOSURE_TIME.address, struct.pack(">d", settings.exposure_us))
        registers.memory(features.GAIN.address, struct.pack(">d", settings.gain_db))

    def _set(self, **changes: Any) -> None:
        try:
            taken = self._camera.configure(replace(self._camera.settings, **changes))
        except FeatureError as error:
            locked = self._acquiring.is_set() and not {"exposure_us", "gain_db"} & set(changes)
            raise RefusedError(Status.BUSY if locked else Status.INVALID_PARAMETER) from error
        self._show_settings(taken)

    def _keep_number(self, address: int, allowed: Sequence[int], data: bytes) -> None:
        if int.from_bytes(data) not in allowed:
            raise RefusedError(Status.INVALID_PARAMETER)
        self._registers.number(address, int.from_bytes(data))

    def _keep_double(self, address: int, allowed: Range, data: bytes) -> None:
        if _double(data) not in allowed:
            raise RefusedError(Status.INVALID_PARAMETER)
        self._registers.memory(address, data)

    @property
    def _processing(self) -> Processing:
        number, registers = self._registers.read_number, self._registers
        gamma = _double(registers.read(features.GAMMA.address, 8))
        return Processing(
            test_pattern=number(features.TEST_PATTERN.address),
            reverse_x=bool(number(features.REVERSE_X.address)),
            gamma=gamma if number(features.GAMMA_ENABLE.address) else 1.0,
        )

    @property
    def _least_period_s(self) -> float:
        """Shortest time between two exposures that the frame rate allows; 0 where it isn't limited."""
        if not self._registers.read_number(features.RATE_ENABLE.address):
            return 0.0
        return 1.0 / _double(self._registers.read(features.RATE.address, 8))

    def _set_pixel_format(self, data: bytes) -> None:
        names = {code: name for name, code in PIXEL_FORMATS.items()}
        name = names.get(int.from_bytes(data))
        if name is None:
            raise RefusedError(Status.INVALID_PARAMETER)
        self._set(pixel_format=name)

    def _set_trigger_mode(self, data: bytes) -> None:
        """Let the camera wait for triggers or run freely; then frames are triggered here, one after the other."""
        mode = int.from_bytes(data)
        if mode not in features.TRIGGER_MODES.values():
            raise RefusedError(Status.INVALID_PARAMETER)
        if mode == features.TRIGGER_MODES["Off"]:
            self._set(trigger=TriggerSource.SOFTWARE)
        self._registers.number(features.TRIGGER_MODE.address, mode)

    @property
    def _runs_freely(self) -> bool:
        mode = self._registers.read_number(features.TRIGGER_MODE.address)
        return mode == features.TRIGGER_MODES["Off"]

    def _set_trigger_source(self, data: bytes) -> None:
        names = {number: name for name, number in features.TRIGGER_SOURCES.items()}
        name = names.get(int.from_bytes(data))
        if name is None:
            raise RefusedError(Status.INVALID_PARAMETER)
        self._set(trigger=TriggerSource(name))

    def _set_packet_size(self, data: bytes) -> None:
        value = int.from_bytes(data)
        size = value & 0xFFFF
        if size not in PACKET_BYTES:
            raise RefusedError(Status.INVALID_PARAMETER)
        self._registers.number(Bootstrap.PACKET_SIZE, value & ~_TEST_PACKET)
        if value & _TEST_PACKET:
            self._send(bytes(size - _HEADERS_BYTES), self._destination())

    # ------------------------------------------------------------ commands

    def _answer_commands(self) -> None:
        while not self._ending.is_set():
            self._notice_silence()
            try:
                packet, client = self._control.recvfrom(2048)
            except TimeoutError:
                continue
            except OSError:
                return
            asked = parse_request(packet)
            if asked is None:
                continue
            reply = self._reply(asked, client)
            if asked.wants_answer:
                with contextlib.suppress(OSError):  # a client that can't be reached any more
                    self._control.sendto(reply, client)

    def _reply(self, asked: Request, client: tuple[str, int]) -> bytes:
        """Carry out a command, or say why not: whatever anybody sends, the camera goes on answering."""
        try:
            return answer(asked, self._carry_out(asked, client))
        except RefusedError as refusal:
            status = refusal.status
        except (struct.error, ValueError):  # a payload of the wrong length
            status = Status.INVALID_PARAMETER
        except DeviceError as error:
            log.warning("A command isn't carried out: %s", error)
            status = Status.ERROR
        return answer(asked, b"", status)

    def _notice_silence(self) -> None:
        """Take control back from a client that died: its heartbeat has stopped."""
        heartbeat_s = self._registers.read_number(Bootstrap.HEARTBEAT_MS) / 1000.0
        if self._client and time.monotonic() - self._heard_s > heartbeat_s:
            self._release()

    def _release(self) -> None:
        self._client = None
        for register in (
            Bootstrap.CONTROL,
            Bootstrap.CONTROLLER_PORT,
            Bootstrap.CONTROLLER_ADDRESS,
        ):
            self._registers.number(register, 0)
        self._stop_acquisition()

    def _carry_out(self, asked: Request, client: tuple[str, int]) -> bytes:
        if client == self._client:
            self._heard_s = time.monotonic()
        match asked.command:
            case Command.DISCOVERY:
                return self._registers.read(0, DISCOVERY_BYTES)
            case Command.READ_REGISTER:
                addresses = struct.unpack(f">{len(asked.payload) // 4}I", asked.payload)
                return b"".join(self._registers.read(a, 4) for a in addresses)
            case Command.READ_MEMORY:
                address, count = struct.unpack(">II", asked.payload)
                return asked.payload[:4] + self._registers.read(address, count & 0xFFFF)
            case Command.WRITE_REGISTER:
                pairs = struct.unpack(f">{len(asked.payload) // 4}I", asked.payload)
                for address, value in zip(pairs[::2], pairs[1::2], strict=True):
                    self._write(address, value.to_bytes(4), client)
                return len(pairs[::2]).to_bytes(4)
            case Command.WRITE_MEMORY:
                (address,) = struct.unpack_from(">I", asked.payload)
                self._write(address, asked.payload[4:], client)
                return len(asked.payload[4:]).to_bytes(4)
            case Command.PACKET_RESEND:
                self._resend(asked.payload)
                return b""
        raise RefusedError(Status.NOT_IMPLEMENTED)

    def _write(self, address: int, data: bytes, client: tuple[str, int]) -> None:
        if self._client not in (None, client):
            raise RefusedError(Status.ACCESS_DENIED)
        if address == Bootstrap.CONTROL:
            self._give_control(int.from_bytes(data), client)
        elif self._client is None:
            raise RefusedError(Status.ACCESS_DENIED)
        else:
            self._registers.write(address, data)

    def _give_control(self, privilege: int, client: tuple[str, int]) -> None:
        if privilege == 0:
            self._release()
            return
        self._client, self._heard_s = client, time.monotonic()
        address, port = client
        self._registers.number(Bootstrap.CONTROL, privilege)
        self._registers.number(Bootstrap.CONTROLLER_PORT, port)
        self._registers.number(
            Bootstrap.CONTROLLER_ADDRESS, int.from_bytes(socket.inet_aton(address))
        )

    # ------------------------------------------------------------ acquisition

    def _start_acquisition(self) -> None:
        self._acquisitions += 1
        self._camera.arm()
        self._blocks.clear()
        self._block_id, self._free_at_s = 0, 0.0
        self._acquiring.set()

    def _stop_acquisition(self) -> None:
        if self._acquiring.is_set():
            self._acquiring.clear()
            self._camera.abort()

    def _trigger(self) -> None:
        """Expose now; a trigger during an exposure is lost, as on real cameras, and counted."""
        settings, now_s = self._camera.settings, time.monotonic()
        waits = settings.trigger is TriggerSource.SOFTWARE and not self._runs_freely
        if not (waits and self._acquiring.is_set()):
            return
        if now_s < self._free_at_s:
            self.dropped_triggers += 1
            return
        readout_s = self._camera.capabilities.min_frame_period_s
        cycle_s = settings.exposure_us * 1e-6 + readout_s
        self._free_at_s = now_s + max(cycle_s, self._least_period_s)
        self._camera.trigger()

    def _send_frames(self) -> None:
        while not self._ending.is_set():
            if not self._acquiring.wait(_POLL_S):
                continue
            acquisition = self._acquisitions
            try:
                if self._runs_freely:
                    self._ending.wait(max(0.0, self._free_at_s - time.monotonic()))
                    self._free_at_s = time.monotonic() + self._least_period_s
                    self._camera.trigger()
                frame = self._camera.get_frame(timeout_s=_POLL_S)
            except DeviceTimeout:
                continue
            except DeviceDisconnected as error:
                log.warning("No frame is sent any more: %s", error)
                self._acquiring.clear()
                continue
            except DeviceError as error:
                if self._acquiring.is_set():  # else acquisition was stopped before the trigger
                    log.warning("No frame is sent: %s", error)
                continue
            # A picture that took so long that acquisition was started anew meanwhile belongs to nobody.
            if self._acquiring.is_set() and acquisition == self._acquisitions:
                self._send_block(frame)

    def _send_block(self, frame: Frame) -> None:
        self._block_id = next_block_id(self._block_id)
        picture = self._processing.of(frame.data, frame.bits)
        height_px, width_px = picture.shape
        pixels = np.ascontiguousarray(picture, picture.dtype.newbyteorder("<"))
        block = Block(
            block_id=self._block_id,
            timestamp_ticks=round((frame.timestamp_s or frame.host_time_s) * _TICKS_PER_S),
            pixel_format=PIXEL_FORMATS[frame.pixel_format],
            width_px=width_px,
            height_px=height_px,
            pixels=pixels.data.cast("B"),
            packet_bytes=self._registers.read_number(Bootstrap.PACKET_SIZE) & 0xFFFF,
        )
        self._blocks[block.block_id] = block
        while len(self._blocks) > _KEPT_BLOCKS:
            self._blocks.popitem(last=False)
        self._send_packets(block)

    def _send_packets(self, block: Block) -> None:
        wire, destination = self._wire, self._destination()
        for number, packet in enumerate(block.packets()):
            if wire.loss == 0.0 or self._random.random() >= wire.loss:
                self._send(packet, destination)
            if number % wire.pause_every == wire.pause_every - 1 and wire.pause_s:
                time.sleep(wire.pause_s)

    def _resend(self, payload: bytes) -> None:
        _channel, block_id, first, last = struct.unpack_from(">HHII", payload)
        block = self._blocks.get(block_id)
        if block is None:
            return
        for number in range(first & 0xFFFFFF, min(last & 0xFFFFFF, block.last_packet) + 1):
            self._send(block.packet(number), self._destination())
            self.resent_packets += 1

    def _destination(self) -> tuple[str, int]:
        address = self._registers.read(Bootstrap.STREAM_ADDRESS, 4)
        port = self._registers.read_number(Bootstrap.STREAM_PORT) & 0xFFFF
        return socket.inet_ntoa(address), port

    def _send(self, packet: bytes, destination: tuple[str, int]) -> None:
        largest = self._wire.largest_bytes
        if destination[1] == 0 or (largest is not None and len(packet) + _HEADERS_BYTES > largest):
            return
        try:
            self._stream.sendto(packet, destination)
        except OSError as error:
            log.warning("A packet to %s:%d isn't sent: %s", *destination, error)

    def _close_sockets(self) -> None:
        self._control.close()
        self._stream.close()


def _double(data: bytes) -> float:
    value: float = struct.unpack(">d", data)[0]
    return value
