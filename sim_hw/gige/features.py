"""The features of an emulated head: one table from which registers and GenICam XML both follow.

Names are those of the SFNC (Standard Features Naming Convention); `TdiShifts` is the maker's own.
The effect of a feature is in `gige_head`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Access = Literal["RO", "RW", "WO"]

# Bootstrap registers, GigE Vision 2.0, section 28.
VERSION = 0x0000
DEVICE_MODE = 0x0004
MAC_HIGH = 0x0008
MAC_LOW = 0x000C
IP_OPTIONS = 0x0010
IP_CONFIGURATION = 0x0014
IP_ADDRESS = 0x0024
SUBNET_MASK = 0x0034
GATEWAY = 0x0044
MANUFACTURER = 0x0048
MODEL = 0x0068
DEVICE_VERSION = 0x0088
MANUFACTURER_INFO = 0x00A8
SERIAL = 0x00D8
USER_NAME = 0x00E8
DISCOVERY_LENGTH = 0x00F8
XML_URL = 0x0200
XML_URL_LENGTH = 512
INTERFACES = 0x0600
MESSAGE_CHANNELS = 0x0900
STREAM_CHANNELS = 0x0904
ACTION_SIGNALS = 0x0908
ACTION_DEVICE_KEY = 0x090C
STREAM_CAPABILITY = 0x092C
CONTROL_CAPABILITY = 0x0934
HEARTBEAT_TIMEOUT = 0x0938
TICK_FREQUENCY_HIGH = 0x093C
TIMESTAMP_CONTROL = 0x0944
TIMESTAMP_VALUE = 0x0948
CONTROL_PRIVILEGE = 0x0A00
STREAM_PORT = 0x0D00
STREAM_PACKET_SIZE = 0x0D04
STREAM_PACKET_DELAY = 0x0D08
STREAM_DESTINATION = 0x0D18
STREAM_SOURCE_PORT = 0x0D1C
ACTION_GROUP_KEY = 0x9800
ACTION_GROUP_MASK = 0x9804

FIRE_TEST_PACKET = 1 << 31
DO_NOT_FRAGMENT = 1 << 30
PACKET_SIZE_MASK = 0xFFFF
TIMESTAMP_LATCH = 1 << 1
EXCLUSIVE_ACCESS = 1 << 0
CONTROL_ACCESS = 1 << 1

# Features of this head; one page per category.
XML_START = 0x2_0000

PIXEL_FORMATS = {
    "Mono8": 0x0108_0001,
    "Mono10": 0x0110_0003,
    "Mono10p": 0x010A_0046,
    "Mono10Packed": 0x010C_0004,
    "Mono12": 0x0110_0005,
    "Mono12p": 0x010C_0047,
    "Mono12Packed": 0x010C_0006,
    "Mono16": 0x0110_0007,
}
"""PFNC codes; the byte above the lower sixteen bits is the width of a pixel on the wire."""

ACQUISITION_MODES = {"Continuous": 0, "SingleFrame": 1, "MultiFrame": 2}
TRIGGER_SOURCES = {"Software": 0, "Line1": 1, "Action1": 2}
CHUNKS = {
    "Timestamp": 0,
    "ExposureTime": 1,
    "CounterValue": 2,
    "Temperature": 3,
    "Gain": 4,
    "FrameID": 5,
}

PTP_STATUSES = {
    "Initializing": 1,
    "Faulty": 2,
    "Disabled": 3,
    "Listening": 4,
    "PreMaster": 5,
    "Master": 6,
    "Passive": 7,
    "Uncalibrated": 8,
    "Slave": 9,
}
"""Values of IEEE 1588-2008, table 8."""

IMAGE_CHUNK_ID = 0x0001
CHUNK_IDS = {
    "Timestamp": 0x1001,
    "ExposureTime": 0x1002,
    "CounterValue": 0x1003,
    "Temperature": 0x1004,
    "Gain": 0x1005,
    "FrameID": 0x1006,
}

HEARTBEAT_TIMEOUT_MIN_MS = 500
PACKET_SIZE_MIN = 576
PACKET_SIZE_MAX = 65_500
TDI_SHIFTS_MAX = 64
THROUGHPUT_MIN_BYTES_PER_S = 100_000
THROUGHPUT_MAX_BYTES_PER_S = 1_250_000_000


@dataclass(frozen=True)
class Feature:
    """What every feature has: its SFNC name, its category, where it lies, who may do what."""

    name: str
    category: str
    address: int
    access: Access = "RW"
    locked_while_acquiring: bool = False
    """TLParamsLocked: refused between AcquisitionStart and AcquisitionStop."""
    length: int = 4


@dataclass(frozen=True)
class IntegerFeature(Feature):
    """An unsigned big-endian integer, or some bits of one.

    `bits` is (lowest, highest), counted from the least significant.
    """

    minimum: int = 0
    maximum: int = 0xFFFF_FFFF
    increment: int = 1
    default: int = 0
    unit: str = ""
    bits: tuple[int, int] | None = None
    is_signed: bool = False


@dataclass(frozen=True)
class FloatFeature(Feature):
    """An IEEE double, big-endian."""

    length: int = 8
    minimum: float = 0.0
    maximum: float = 0.0
    default: float = 0.0
    unit: str = ""


@dataclass(frozen=True)
class EnumerationFeature(Feature):
    entries: Mapping[str, int] = field(default_factory=dict)
    default: int = 0


@dataclass(frozen=True)
class BooleanFeature(Feature):
    """A word that is 0 or 1; with a `selector`, one word per entry of that enumeration."""

    default: int = 0
    selector: str | None = None
    bit: int | None = None


@dataclass(frozen=True)
class CommandFeature(Feature):
    access: Access = "WO"
    value: int = 1
    bit: int | None = None


@dataclass(frozen=True)
class StringFeature(Feature):
    access: Access = "RO"
    length: int = 32


@dataclass(frozen=True)
class ChunkFeature:
    """A value that comes with the frame instead of lying in a register; 8 bytes, big-endian."""

    name: str
    chunk: str
    is_float: bool = False
    unit: str = ""


def head_features(width_px: int, height_px: int) -> tuple[Feature, ...]:
    """The registers of a head with that many pixels, in the order a person reads them."""
    device, image, acquisition = "DeviceControl", "ImageFormatControl", "AcquisitionControl"
    analog, transport, chunk = "AnalogControl", "TransportLayerControl", "ChunkDataControl"
    action, ptp = "ActionControl", "PtpControl"
    return (
        StringFeature("DeviceVendorName", device, MANUFACTURER),
        StringFeature("DeviceModelName", device, MODEL),
        StringFeature("DeviceVersion", device, DEVICE_VERSION),
        StringFeature("DeviceManufacturerInfo", device, MANUFACTURER_INFO, length=48),
        StringFeature("DeviceSerialNumber", device, SERIAL, length=16),
        StringFeature("DeviceUserID", device, USER_NAME, "RW", length=16),
        FloatFeature(
            "DeviceTemperature", device, 0x1_0000, "RO", minimum=-100.0, maximum=200.0, unit="C"
        ),
        CommandFeature("DeviceReset", device, 0x1_0008),
        IntegerFeature("SensorWidth", image, 0x1_0100, "RO", default=width_px),
        IntegerFeature("SensorHeight", image, 0x1_0104, "RO", default=height_px),
        # The CCD is read out whole: there is no region of interest to choose.
        IntegerFeature(
            "Width", image, 0x1_0108, minimum=width_px, maximum=width_px, default=width_px
        ),
        IntegerFeature(
            "Height", image, 0x1_010C, minimum=height_px, maximum=height_px, default=height_px
        ),
        IntegerFeature("OffsetX", image, 0x1_0110, maximum=0),
        IntegerFeature("OffsetY", image, 0x1_0114, maximum=0),
        EnumerationFeature(
            "PixelFormat",
            image,
            0x1_0118,
            locked_while_acquiring=True,
            entries=PIXEL_FORMATS,
            default=PIXEL_FORMATS["Mono16"],
        ),
        EnumerationFeature("AcquisitionMode", acquisition, 0x1_0200, entries=ACQUISITION_MODES),
        CommandFeature("AcquisitionStart", acquisition, 0x1_0204),
        CommandFeature("AcquisitionStop", acquisition, 0x1_0208),
        IntegerFeature(
            "AcquisitionFrameCount", acquisition, 0x1_020C, minimum=1, maximum=65_535, default=1
        ),
        FloatFeature(
            "AcquisitionFrameRate",
            acquisition,
            0x1_0210,
            minimum=0.01,
            maximum=1000.0,
            default=1.0,
            unit="Hz",
        ),
        EnumerationFeature("TriggerSelector", acquisition, 0x1_0218, entries={"FrameStart": 0}),
        EnumerationFeature("TriggerMode", acquisition, 0x1_021C, entries={"Off": 0, "On": 1}),
        EnumerationFeature("TriggerSource", acquisition, 0x1_0220, entries=TRIGGER_SOURCES),
        EnumerationFeature("TriggerActivation", acquisition, 0x1_0224, entries={"RisingEdge": 0}),
        CommandFeature("TriggerSoftware", acquisition, 0x1_0228),
        IntegerFeature("ActionDeviceKey", action, ACTION_DEVICE_KEY),
        IntegerFeature("ActionSelector", action, 0x1_0600, minimum=1, maximum=1, default=1),
        IntegerFeature("ActionGroupKey", action, ACTION_GROUP_KEY),
        IntegerFeature("ActionGroupMask", action, ACTION_GROUP_MASK),
        EnumerationFeature("ExposureMode", acquisition, 0x1_022C, entries={"Timed": 0}),
        FloatFeature(
            "ExposureTime",
            acquisition,
            0x1_0230,
            minimum=10.0,
            maximum=1e6,
            default=5000.0,
            unit="us",
        ),
        IntegerFeature("TdiShifts", acquisition, 0x1_0238, maximum=TDI_SHIFTS_MAX),
        FloatFeature("Gain", analog, 0x1_0300, maximum=48.0, unit="dB"),
        IntegerFeature("PayloadSize", transport, 0x1_0400, "RO", unit="B"),
        IntegerFeature(
            "GevSCPSPacketSize",
            transport,
            STREAM_PACKET_SIZE,
            minimum=PACKET_SIZE_MIN,
            maximum=PACKET_SIZE_MAX,
            increment=4,
            default=1500,
            bits=(0, 15),
            unit="B",
        ),
        BooleanFeature("GevSCPSDoNotFragment", transport, STREAM_PACKET_SIZE, bit=30),
        CommandFeature("GevSCPSFireTestPacket", transport, STREAM_PACKET_SIZE, "RW", bit=31),
        IntegerFeature("GevSCPD", transport, STREAM_PACKET_DELAY, unit="ns"),
        IntegerFeature("GevSCFTD", transport, 0x1_0404, unit="ns"),
        EnumerationFeature(
            "DeviceLinkThroughputLimitMode", device, 0x1_0010, entries={"Off": 0, "On": 1}
        ),
        IntegerFeature(
            "DeviceLinkThroughputLimit",
            device,
            0x1_0014,
            minimum=THROUGHPUT_MIN_BYTES_PER_S,
            maximum=THROUGHPUT_MAX_BYTES_PER_S,
            default=THROUGHPUT_MAX_BYTES_PER_S,
            unit="Bps",
        ),
        IntegerFeature("GevSCPHostPort", transport, STREAM_PORT, bits=(0, 15), maximum=65_535),
        IntegerFeature("GevSCDA", transport, STREAM_DESTINATION),
        IntegerFeature(
            "GevHeartbeatTimeout",
            transport,
            HEARTBEAT_TIMEOUT,
            minimum=HEARTBEAT_TIMEOUT_MIN_MS,
            default=3000,
            unit="ms",
        ),
        IntegerFeature(
            "GevTimestampTickFrequency", transport, TICK_FREQUENCY_HIGH, "RO", length=8, unit="Hz"
        ),
        CommandFeature(
            "GevTimestampControlLatch", transport, TIMESTAMP_CONTROL, value=TIMESTAMP_LATCH
        ),
        IntegerFeature("GevTimestampValue", transport, TIMESTAMP_VALUE, "RO", length=8, unit="ns"),
        BooleanFeature("PtpEnable", ptp, 0x1_0700),
        CommandFeature("PtpDataSetLatch", ptp, 0x1_0704),
        EnumerationFeature(
            "PtpStatus",
            ptp,
            0x1_0708,
            "RO",
            entries=PTP_STATUSES,
            default=PTP_STATUSES["Disabled"],
        ),
        IntegerFeature(
            "PtpOffsetFromMaster", ptp, 0x1_0710, "RO", length=8, unit="ns", is_signed=True
        ),
        IntegerFeature("PtpParentClockID", ptp, 0x1_0720, "RO", length=8, is_signed=True),
        IntegerFeature("PtpGrandmasterClockID", ptp, 0x1_0728, "RO", length=8, is_signed=True),
        BooleanFeature("ChunkModeActive", chunk, 0x1_0500, locked_while_acquiring=True),
        EnumerationFeature("ChunkSelector", chunk, 0x1_0504, entries=CHUNKS),
        BooleanFeature(
            "ChunkEnable",
            chunk,
            0x1_0508,
            locked_while_acquiring=True,
            selector="ChunkSelector",
            length=4 * len(CHUNKS),
            default=1,
        ),
    )


CHUNK_FEATURES = (
    ChunkFeature("ChunkTimestamp", "Timestamp", unit="ns"),
    ChunkFeature("ChunkExposureTime", "ExposureTime", is_float=True, unit="us"),
    ChunkFeature("ChunkCounterValue", "CounterValue"),
    ChunkFeature("ChunkTemperature", "Temperature", is_float=True, unit="C"),
    ChunkFeature("ChunkGain", "Gain", is_float=True, unit="dB"),
    ChunkFeature("ChunkFrameID", "FrameID"),
)
