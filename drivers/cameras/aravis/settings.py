"""Settings of a GenICam head, and conflicts between them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.base.settings import Configured, Setting
from drivers.cameras.aravis.formats import packing_of
from drivers.cameras.aravis.presets import FeatureValue, preset_names


class AravisSettings(Configured):
    """The settings of `drivers.cameras.aravis.aravis_head.AravisHead`."""

    address = Setting(
        "", required=True, help="IP address of the head, or its name as printed by arv-tool"
    )
    serial = Setting("", help="serial number the head must have; empty takes any")
    preset = Setting("", help="features of a family of heads, see the presets below; empty: none")
    features = Setting(
        dict[str, FeatureValue](),
        help="further features by GenICam name and value, written in this order",
    )
    width_px = Setting(0, minimum=0, help="columns; 0 takes what the head is set to")
    height_px = Setting(0, minimum=0, help="rows; 0 takes what the head is set to")
    pixel_format = Setting(
        "", help="GenICam name of the pixel format; empty takes the one with the most bits"
    )
    byte_order = Setting(
        "little",
        choices=("little", "big"),
        help="byte order of pixels of more than 8 bits, unpacked; some heads send big-endian",
    )
    exposure_time_us = Setting(1000.0, minimum=1, maximum=60e6, help="exposure time, us")
    gain_db = Setting(0.0, minimum=-20, maximum=60, help="gain, dB")
    gain_unit = Setting(
        "",
        choices=("", "dB", "factor"),
        help="unit of the head's gain as its manual states it; empty reads it from the head",
    )
    temperature_probe = Setting(
        "", help="name of the rig's probe that the head's own thermometer is; empty: none"
    )
    tdi_shifts = Setting(0, minimum=0, maximum=1000, help="TDI shifts; 0 for a head without TDI")
    trigger_source = Setting(
        "line", choices=("line", "software", "action"), help="what starts an exposure"
    )
    trigger_line = Setting("Line1", help="GenICam name of the head's trigger input")
    trigger_activation = Setting(
        "RisingEdge",
        choices=("RisingEdge", "FallingEdge", "AnyEdge", "LevelHigh", "LevelLow"),
        help="edge of the trigger input that starts an exposure",
    )
    trigger_delay_us = Setting(
        0.0, minimum=0, maximum=1e6, help="time between trigger and exposure, us"
    )
    debounce_us = Setting(
        0.0, minimum=0, maximum=1e6, help="shortest trigger pulse, us; 0 leaves the head's value"
    )
    strobe_line = Setting(
        "", help="GenICam name of an output that is active during the exposure; empty: none"
    )
    trigger_action = Setting("Action1", help="GenICam name of the head's action signal")
    action_device_key = Setting(
        0x5359_4E54, minimum=0, maximum=0xFFFF_FFFF, help="device key of action commands"
    )
    action_group_key = Setting(
        1, minimum=0, maximum=0xFFFF_FFFF, help="group key of action commands"
    )
    action_group_mask = Setting(
        1, minimum=1, maximum=0xFFFF_FFFF, help="groups of action commands the head is in, bits"
    )
    packet_size = Setting(
        0, minimum=0, maximum=65535, help="bytes of a stream packet; 0 tries what passes"
    )
    packet_size_limit = Setting(
        8192, minimum=576, maximum=65535, help="the largest packet that is tried"
    )
    stream_rate_mbps = Setting(
        0.0,
        minimum=0,
        maximum=1e6,
        help="rate of the stream on the wire, Mbit/s, set by the link budget; 0 is not limited",
    )
    head_link_mbps = Setting(
        0.0,
        minimum=0,
        maximum=1e6,
        help="rate of the head's own link, by which the pause between packets is shortened; 0 "
        "leaves the pause long enough for heads that count it from the start of a packet",
    )
    transfer_delay_us = Setting(
        0.0,
        minimum=0,
        maximum=60e6,
        help="pause between readout and first packet, us, set by the link budget",
    )
    socket_buffer_bytes = Setting(
        33_554_432,
        minimum=65536,
        maximum=1 << 30,
        help="receive buffer; the kernel's rmem_max limits it",
    )
    packet_socket = Setting(
        False, help="read packets below the network stack (needs CAP_NET_RAW, fewer copies)"
    )
    packet_timeout_ms = Setting(
        20.0, minimum=1, maximum=1000, help="a packet so late is asked for again"
    )
    frame_retention_ms = Setting(
        500.0, minimum=10, maximum=5000, help="without a packet for so long a frame is given up"
    )
    chunks = Setting(True, help="let the head write time, exposure and counter behind the pixels")
    latch_interval_s = Setting(
        2.0, minimum=0.5, maximum=2.5, help="time between readings of the head's clock and health"
    )
    ptp = Setting(
        False, help="let a PTP master on the network (IEEE 1588) discipline the head's clock"
    )
    temperature_max_c = Setting(
        0.0,
        minimum=0,
        maximum=130,
        help="the head's own temperature above which it is reported as too hot, degC; 0 for none",
    )
    control_wait_limit_s = Setting(
        15.0, minimum=1, maximum=120, help="how long a dead controller's hold is waited out"
    )

    @classmethod
    def setting_conflicts(cls, values: Mapping[str, Any]) -> list[str]:
        found = []
        if (values["width_px"] == 0) != (values["height_px"] == 0):
            found.append(
                f"width_px is {values['width_px']} and height_px is {values['height_px']}; "
                "give both or neither"
            )
        if values["preset"] and values["preset"] not in preset_names():
            found.append(f"preset is {values['preset']!r}; there are " + ", ".join(preset_names()))
        if values["pixel_format"] and packing_of(values["pixel_format"]) is None:
            found.append(
                f"pixel_format is {values['pixel_format']!r}; a GenICam name of 8 to 16 bits, "
                "monochrome or Bayer, such as Mono12p or BayerRG12"
            )
        if 0 < values["packet_size"] < 576:
            found.append(f"packet_size is {values['packet_size']}; 0 or at least 576")
        if values["frame_retention_ms"] < 2 * values["packet_timeout_ms"]:
            found.append(
                f"frame_retention_ms is {values['frame_retention_ms']:g}; at least twice "
                "packet_timeout_ms, so that a packet can be asked for again"
            )
        return found
