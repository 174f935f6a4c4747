"""Writes what starts an exposure of a head, and the output that reports it.

Source: GenICam SFNC 2.7, chapter 5 "Acquisition control" and chapter 8 "Digital I/O control".
"""

from __future__ import annotations

import contextlib
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.feature_writer import FeatureWriter
from drivers.cameras.aravis.settings import AravisSettings

FRAME_TRIGGERS: Final = ("FrameStart", "ExposureStart", "FrameTrigger")
BURST_TRIGGER: Final = "FrameBurstStart"
BURST_LENGTH: Final = "AcquisitionBurstFrameCount"
"""Frames of a burst; a burst of one frame is a single frame (SFNC 2.7, section 5.5)."""
ACQUISITION_TRIGGER: Final = "AcquisitionStart"
NO_SOFTWARE_TRIGGER: Final = (
    'trigger_source is "software"; the head has no command TriggerSoftware, set trigger_source = '
    '"line"'
)
TRIGGER_DELAYS: Final = ("TriggerDelay", "TriggerDelayAbs")
STROBES: Final = (
    ("LineSelector", "LineSource", ("ExposureActive", "ExposureStartActive")),
    ("SyncOutSelector", "SyncOutSource", ("Exposing",)),
)
"""Selector of an output, its source, and the entries that are active during the exposure."""
OUTPUT_MODES: Final = ("Output", "Strobe")
DEBOUNCERS: Final = (
    *("LineDebouncerTime", "LineDebouncerTimeAbs", "LineDebounceTime"),
    *("DebounceTime", "InputDebounceTime", "mvLineDebounceTimeRisingEdge"),
)


def write_trigger(writer: FeatureWriter, settings: AravisSettings) -> None:
    """Let a trigger start every single frame, and switch every other trigger off.

    Args:
        writer: of the head's features.
        settings: the configured settings.
    """
    features = writer.features
    if not features.is_implemented("TriggerMode") and not features.entries("TriggerSelector"):
        writer.missing.append("no feature TriggerMode")
        return
    is_software = settings.trigger_source == "software"
    if is_software and features.kind("TriggerSoftware") != "command":
        writer.refusals.append(NO_SOFTWARE_TRIGGER)
        return
    selectors = features.entries("TriggerSelector")
    frame_trigger = _frame_trigger(writer, selectors)
    if selectors and frame_trigger is None:
        return
    switch_triggers_off(features)
    hint = "choose one that the head has"
    if frame_trigger is not None:
        writer.set("trigger_source", "TriggerSelector", frame_trigger, hint)
    # A head may have a mode for some of its triggers only.
    if not features.is_available("TriggerMode"):
        of = f" for its trigger {frame_trigger}" if frame_trigger is not None else ""
        writer.missing.append(f"no feature TriggerMode{of}")
        return
    key, source = {
        "software": ("trigger_source", "Software"),
        "line": ("trigger_line", settings.trigger_line),
        "action": ("trigger_action", settings.trigger_action),
    }[settings.trigger_source]
    # Quirk: some heads accept a source only while the trigger is off, others only while it is
    # on. It is written in both states.
    # Upstream: no report known (2026-11-23); on the order of features, AravisProject/aravis#560.
    with contextlib.suppress(FeatureError):
        features.set("TriggerSource", source)
    writer.set("trigger_source", "TriggerMode", "On", "the head cannot be triggered")
    held = features.text("TriggerSource")
    is_fixed = held != source and held and not features.is_writable("TriggerSource")
    if is_fixed:
        hint = f"its trigger source is fixed at {held}"
    writer.set(key, "TriggerSource", source, hint)
    # A head may have the command for the selected trigger and source only.
    if is_software and not features.is_implemented("TriggerSoftware"):
        writer.refusals.append(NO_SOFTWARE_TRIGGER)
    if settings.trigger_source == "line":
        _write_line(writer, settings)
    delay = features.first_available(TRIGGER_DELAYS)
    if delay is not None:
        low, high = features.bounds(delay)
        # Heads that cannot start without any delay have a lowest one.
        lowest = low if 0 < low <= high else 0.0
        _write_duration(writer, "trigger_delay_us", delay, settings.trigger_delay_us, lowest)
    elif settings.trigger_delay_us:
        writer.refusals.append(
            f"trigger_delay_us is {settings.trigger_delay_us:g}; the head has no trigger delay"
        )
    if settings.trigger_source == "action":
        _write_action(writer, settings)


def switch_triggers_off(features: Features) -> None:
    """Switch every trigger of a head off; some heads lock other features while one is on.

    Args:
        features: the head's features.
    """
    before = features.text("TriggerSelector")
    triggers = features.entries("TriggerSelector")
    # The one that is selected comes last and stays selected: other features may depend on it.
    for trigger in sorted(triggers, key=lambda entry: entry == before) or [""]:
        with contextlib.suppress(FeatureError):
            if trigger:
                features.set("TriggerSelector", trigger)
            if features.text("TriggerMode") == "On":
                features.set("TriggerMode", "Off")


def _frame_trigger(writer: FeatureWriter, selectors: list[str]) -> str | None:
    """The entry of TriggerSelector that starts a single frame; None if there is none."""
    features = writer.features
    found = features.first_entry("TriggerSelector", FRAME_TRIGGERS)
    if found is not None:
        return found
    if selectors == [ACQUISITION_TRIGGER]:
        # Quirk: the only trigger of Basler scout and pilot starts every single frame.
        # Upstream: manual: GenICam description of Basler scA1300-32gm, TriggerSelector.
        return ACQUISITION_TRIGGER
    if BURST_TRIGGER in selectors and features.is_available(BURST_LENGTH):
        hint = "the head starts bursts of frames only"
        is_single = writer.set("trigger_source", BURST_LENGTH, 1, hint)
        return BURST_TRIGGER if is_single else None
    if selectors:
        missing = f" or {BURST_LENGTH}" if BURST_TRIGGER in selectors else ""
        writer.missing.append(
            f"no trigger for single frames (TriggerSelector has {', '.join(selectors)}, where "
            f"FrameStart{missing} is needed)"
        )
    return None


def _write_line(writer: FeatureWriter, settings: AravisSettings) -> None:
    features = writer.features
    if features.is_available("TriggerActivation"):
        writer.set(
            "trigger_activation",
            "TriggerActivation",
            settings.trigger_activation,
            "choose one that the head has",
        )
    elif settings.trigger_activation != "RisingEdge":
        writer.refusals.append(
            f"trigger_activation is {settings.trigger_activation!r}; the head triggers on its "
            "own edge only"
        )
    if settings.debounce_us:
        if settings.trigger_line in features.entries("LineSelector"):
            with contextlib.suppress(FeatureError):
                features.set("LineSelector", settings.trigger_line)
        name = features.first_available(DEBOUNCERS)
        if name is None:
            writer.refusals.append(
                f"debounce_us is {settings.debounce_us:g}; the head has no debouncer"
            )
        else:
            _write_duration(writer, "debounce_us", name, settings.debounce_us, 0.0)


def _write_duration(
    writer: FeatureWriter, key: str, name: str, wanted_us: float, lowest: float
) -> None:
    """Write a duration; 0 is the head's lowest, whatever its unit is."""
    unit_us = writer.features.unit_us(name)
    if wanted_us and unit_us is None:
        stated = writer.features.unit(name)
        writer.refusals.append(
            f"{key} is {wanted_us:g}; the head has {name} in {stated!r}, which is no time; set "
            f"{key} = 0 and {name} under features"
        )
        return
    value = wanted_us / unit_us if unit_us else wanted_us
    is_integer = writer.features.kind(name) == "integer"
    value = value or lowest
    writer.set(key, name, round(value) if is_integer else value, "choose another time")


def _write_action(writer: FeatureWriter, settings: AravisSettings) -> None:
    """Write keys and mask of action commands; a head may have several action signals."""
    features = writer.features
    number = "".join(c for c in settings.trigger_action if c.isdigit())
    if features.is_available("ActionSelector") and number:
        writer.set(
            "trigger_action",
            "ActionSelector",
            int(number),
            "choose an action signal the head has",
        )
    for key, name in (
        ("action_device_key", "ActionDeviceKey"),
        ("action_group_key", "ActionGroupKey"),
        ("action_group_mask", "ActionGroupMask"),
    ):
        # Quirk: heads do not return their keys, so they are not read back.
        # Upstream: manual: GenICam SFNC 2.7, ActionDeviceKey.
        value = int(getattr(settings, key))
        writer.attempt(
            f"{key} = {value!r}",
            "the head accepts no action commands",
            # mypy infers no type for the default of a parameter of a lambda.
            lambda name=name, value=value: features.write_only(name, value),  # type: ignore[misc]
        )


def write_strobe(writer: FeatureWriter, settings: AravisSettings) -> None:
    """Let an output be active during the exposure, if one is configured.

    Args:
        writer: of the head's features.
        settings: the configured settings.
    """
    line = settings.strobe_line
    if not line:
        return
    features = writer.features
    # Quirk: Allied Vision heads before Alvium have outputs of their own names.
    # Upstream: manual: GenICam description of Mako G-125B, SyncOutSelector.
    selector, source, values = next(
        (names for names in STROBES if features.entries(names[0])), STROBES[0]
    )
    if not features.entries(selector):
        writer.refusals.append(f"strobe_line is {line!r}; the head has no {selector}")
        return
    hint = "the head has " + ", ".join(features.entries(selector))
    writer.set("strobe_line", selector, line, hint)
    mode = features.first_entry("LineMode", OUTPUT_MODES)
    if selector == "LineSelector" and mode is not None:
        writer.set("strobe_line", "LineMode", mode, "choose a line that is an output")
    value = features.first_entry(source, values) or values[0]
    writer.set("strobe_line", source, value, "choose another line")
    # Quirk: outputs of Hikrobot heads have a switch of their own.
    # Upstream: manual: Hikrobot GigE Area Scan Camera User Manual, "Strobe output".
    if features.is_available("StrobeEnable"):
        writer.set("strobe_line", "StrobeEnable", True, "choose another line")
