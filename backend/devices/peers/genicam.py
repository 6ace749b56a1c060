"""The camera's own description (GenICam XML): which features it has, and in which registers.

Written from the standard's node types with SFNC names, so that any GenICam client finds what it looks for.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from backend.devices.peers.gvcp import Bootstrap
from backend.devices.peers.processing import TEST_PATTERNS
from backend.devices.protocols import Range

FEATURES = 0x8000
"""Registers of the features begin here, the description behind them."""
XML_ADDRESS = 0x10000


@dataclass(frozen=True)
class Register:
    """Where a feature's value is."""

    address: int
    length: int = 4
    access: str = "RW"


WIDTH = Register(FEATURES, access="RO")
HEIGHT = Register(FEATURES + 0x04, access="RO")
PIXEL_FORMAT = Register(FEATURES + 0x08)
PAYLOAD_SIZE = Register(FEATURES + 0x0C, access="RO")
ACQUISITION_MODE = Register(FEATURES + 0x10)
ACQUISITION_START = Register(FEATURES + 0x14, access="WO")
ACQUISITION_STOP = Register(FEATURES + 0x18, access="WO")
PARAMETERS_LOCKED = Register(FEATURES + 0x1C)
TRIGGER_SELECTOR = Register(FEATURES + 0x20)
TRIGGER_MODE = Register(FEATURES + 0x24)
TRIGGER_SOURCE = Register(FEATURES + 0x28)
TRIGGER_SOFTWARE = Register(FEATURES + 0x2C, access="WO")
TRIGGER_ACTIVATION = Register(FEATURES + 0x30)
EXPOSURE_TIME = Register(FEATURES + 0x40, 8)
GAIN = Register(FEATURES + 0x48, 8)
TEST_PATTERN = Register(FEATURES + 0x50)
REVERSE_X = Register(FEATURES + 0x54)
GAMMA_ENABLE = Register(FEATURES + 0x58)
RATE_ENABLE = Register(FEATURES + 0x5C)
GAMMA = Register(FEATURES + 0x60, 8)
RATE = Register(FEATURES + 0x68, 8)

GAMMAS = Range(0.25, 4.0)
RATES_HZ = Range(0.1, 1000.0, unit="Hz")

TRIGGER_MODES = {"Off": 0, "On": 1}
TRIGGER_SOURCES = {"Software": 0, "Line0": 1, "Line1": 2}


@dataclass(frozen=True)
class CameraDescription:
    """What a description says of one camera."""

    vendor: str
    model: str
    pixel_formats: Mapping[str, int]
    trigger_sources: Sequence[str]
    exposure_us: Range
    gain_db: Range
    packet_bytes: Range


def describe(camera: CameraDescription) -> bytes:
    """Write the XML."""
    root = ET.Element(
        "RegisterDescription",
        ModelName=camera.model, VendorName=camera.vendor, StandardNameSpace="GEV", ToolTip=f"{camera.vendor} {camera.model}",
        SchemaMajorVersion="1", SchemaMinorVersion="1", SchemaSubMinorVersion="0",
        MajorVersion="1", MinorVersion="0", SubMinorVersion="0",
        ProductGuid="7f0c1a62-5d0e-4b53-9a53-0d5a3ce1b201", VersionGuid="7f0c1a62-5d0e-4b53-9a53-0d5a3ce1b202",
        xmlns="http://www.genicam.org/GenApi/Version_1_1",
    )  # fmt: skip
    writer = _Writer(root)
    writer.category("Root", ["DeviceControl", "ImageFormatControl", "AcquisitionControl", "AnalogControl", "TransportLayerControl"])  # fmt: skip
    _device(writer)
    _image(writer, camera)
    _acquisition(writer, camera)
    writer.category("AnalogControl", ["Gain", "GammaEnable", "Gamma"])
    writer.floating("Gain", GAIN, camera.gain_db)
    writer.boolean("GammaEnable", GAMMA_ENABLE)
    writer.floating("Gamma", GAMMA, GAMMAS)
    _transport(writer, camera)
    port = writer.add("Port", "Device")
    del port
    return b'<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root)


def _device(writer: "_Writer") -> None:
    texts = {
        "DeviceVendorName": (Bootstrap.VENDOR, 32),
        "DeviceModelName": (Bootstrap.MODEL, 32),
        "DeviceVersion": (Bootstrap.DEVICE_VERSION, 32),
        "DeviceSerialNumber": (Bootstrap.SERIAL, 16),
        "DeviceID": (Bootstrap.SERIAL, 16),
    }
    writer.category("DeviceControl", list(texts))
    for name, (address, length) in texts.items():
        writer.text(name, Register(address, length, "RO"))


def _image(writer: "_Writer", camera: CameraDescription) -> None:
    writer.category(
        "ImageFormatControl", ["Width", "Height", "PixelFormat", "ReverseX", "TestPattern"]
    )
    writer.integer("Width", WIDTH)
    writer.integer("Height", HEIGHT)
    writer.choice("PixelFormat", PIXEL_FORMAT, camera.pixel_formats)
    writer.boolean("ReverseX", REVERSE_X)
    writer.choice("TestPattern", TEST_PATTERN, TEST_PATTERNS)


def _acquisition(writer: "_Writer", camera: CameraDescription) -> None:
    writer.category(
        "AcquisitionControl",
        ["AcquisitionMode", "AcquisitionStart", "AcquisitionStop", "TriggerSelector", "TriggerMode",
         "TriggerSource", "TriggerSoftware", "TriggerActivation", "ExposureTime", "AcquisitionFrameRateEnable",
         "AcquisitionFrameRate"],
    )  # fmt: skip
    sources = {name: TRIGGER_SOURCES[name] for name in camera.trigger_sources}
    writer.choice("AcquisitionMode", ACQUISITION_MODE, {"Continuous": 0})
    writer.command("AcquisitionStart", ACQUISITION_START)
    writer.command("AcquisitionStop", ACQUISITION_STOP)
    writer.choice("TriggerSelector", TRIGGER_SELECTOR, {"FrameStart": 0})
    writer.choice("TriggerMode", TRIGGER_MODE, TRIGGER_MODES)
    writer.choice("TriggerSource", TRIGGER_SOURCE, sources)
    writer.command("TriggerSoftware", TRIGGER_SOFTWARE)
    writer.choice("TriggerActivation", TRIGGER_ACTIVATION, {"RisingEdge": 0})
    writer.floating("ExposureTime", EXPOSURE_TIME, camera.exposure_us)
    writer.boolean("AcquisitionFrameRateEnable", RATE_ENABLE)
    writer.floating("AcquisitionFrameRate", RATE, RATES_HZ)


def _transport(writer: "_Writer", camera: CameraDescription) -> None:
    writer.category(
        "TransportLayerControl",
        ["PayloadSize", "TLParamsLocked", "GevSCPSPacketSize", "GevSCPSFireTestPacket"],
    )
    writer.integer("PayloadSize", PAYLOAD_SIZE)
    writer.integer("TLParamsLocked", PARAMETERS_LOCKED)
    writer.integer(
        "GevSCPSPacketSize", Register(Bootstrap.PACKET_SIZE), camera.packet_bytes, bits=(31, 16)
    )
    # Clients that find the largest packet size by themselves look for this feature.
    writer.command("GevSCPSFireTestPacket", Register(Bootstrap.PACKET_SIZE), bits=(0, 0))


class _Writer:
    """Nodes by kind; each feature gets a register node of its own."""

    def __init__(self, root: ET.Element) -> None:
        self._root = root

    def add(self, kind: str, name: str, /, **texts: object) -> ET.Element:
        """Add a node with its texts as children."""
        node = ET.SubElement(self._root, kind, Name=name, NameSpace="Standard")
        for tag, text in texts.items():
            ET.SubElement(node, tag).text = str(text)
        return node

    def category(self, name: str, features: Sequence[str]) -> None:
        """Add a category."""
        node = self.add("Category", name)
        for feature in features:
            ET.SubElement(node, "pFeature").text = feature

    def integer(
        self,
        name: str,
        register: Register,
        allowed: Range | None = None,
        bits: tuple[int, int] | None = None,
    ) -> None:
        """Add a whole number; `bits` (last, first counted from the left) if it fills a part of its register."""
        limits: dict[str, object] = {}
        if allowed is not None:
            limits = {"Min": int(allowed.min), "Max": int(allowed.max), "Inc": int(allowed.inc)}
        self.add("Integer", name, pValue=f"{name}Register", **limits)
        self._register("MaskedIntReg" if bits else "IntReg", name, register, bits)

    def floating(self, name: str, register: Register, allowed: Range) -> None:
        """Add a number with its range and unit."""
        unit = {"Unit": allowed.unit} if allowed.unit else {}
        limits = {"Min": repr(allowed.min), "Max": repr(allowed.max)}
        self.add("Float", name, pValue=f"{name}Register", **limits, **unit)
        self._place("FloatReg", name, register, Endianess="BigEndian")

    def boolean(self, name: str, register: Register) -> None:
        """Add a switch."""
        self.add("Boolean", name, pValue=f"{name}Register", OnValue=1, OffValue=0)
        self._register("IntReg", name, register)

    def choice(self, name: str, register: Register, entries: Mapping[str, int]) -> None:
        """Add an enumeration."""
        node = self.add("Enumeration", name)
        for entry, value in entries.items():
            element = ET.SubElement(node, "EnumEntry", Name=entry, NameSpace="Standard")
            ET.SubElement(element, "Value").text = str(value)
        ET.SubElement(node, "pValue").text = f"{name}Register"
        self._register("IntReg", name, register)

    def command(self, name: str, register: Register, bits: tuple[int, int] | None = None) -> None:
        """Add a command; `bits` if it is a part of its register."""
        self.add("Command", name, pValue=f"{name}Register", CommandValue=1)
        self._register("MaskedIntReg" if bits else "IntReg", name, register, bits)

    def text(self, name: str, register: Register) -> None:
        """Add a text of fixed length."""
        self.add(
            "StringReg", name, Address=hex(register.address), Length=register.length,
            AccessMode=register.access, pPort="Device",
        )  # fmt: skip

    def _register(
        self, kind: str, name: str, register: Register, bits: tuple[int, int] | None = None
    ) -> None:
        mask = {"LSB": bits[0], "MSB": bits[1]} if bits else {}
        self._place(kind, name, register, **mask, Sign="Unsigned", Endianess="BigEndian")

    def _place(self, kind: str, name: str, register: Register, **more: object) -> None:
        self.add(
            kind, f"{name}Register", Address=hex(register.address), Length=register.length,
            AccessMode=register.access, pPort="Device", Cachable="NoCache", **more,
        )  # fmt: skip
