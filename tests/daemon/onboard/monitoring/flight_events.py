"""Events of a short flight, for the tests of monitoring."""

from __future__ import annotations

from typing import Any

from daemon.onboard.flight.ledger import LedgerSheet, Receipts

NAVIGATION = {
    "receiver": "gnss",
    "gps_ns": "1479300000000000000",
    "method": "interpolated",
    "gap_ns": 100_000_000,
    "fix": "3d",
    "satellites": 14,
    "latitude_deg": 47.07,
    "longitude_deg": 15.43,
    "height_m": 1395.0,
    "horizontal_sigma_m": 0.02,
    "vertical_sigma_m": 0.03,
    "velocity_ned_mps": [55.0, 0.0, 0.0],
    "speed_sigma_mps": 0.02,
    "roll_rad": 0.0,
    "pitch_rad": 0.0,
    "heading_rad": 0.0,
    "leap_seconds": 18,
}


def status(phase: str = "flying", triggers: int = 0, exposures_left: int = 100) -> dict[str, Any]:
    sheet = LedgerSheet(
        *(triggers, 0, triggers, 0, 0, triggers, triggers, ()),
        frames=Receipts("frames", received=13 * triggers, used=13 * triggers),
        marks=Receipts("marks", received=triggers, used=triggers),
        imbalances=(),
    )
    return {
        "event": "status",
        "mono_ns": "1",
        "phase": phase,
        "ledger": sheet.as_json(),
        "exposures_left": exposures_left,
        "position": {"latitude_deg": 47.07 + triggers * 1e-3, "longitude_deg": 15.43},
        "temperatures_c": {"0": 32.1, "1": None},
        "clock_sigma_ns": 25,
        "queue": 0,
    }


def exposure(
    number: int, verdict: str = "good", *, line: str = "", north_m: float = 0.0
) -> list[dict[str, Any]]:
    """From the trigger to the verdict; `north_m` behind the place of NAVIGATION."""
    here = NAVIGATION | {"latitude_deg": 47.07 + north_m / 111_180}
    return [
        {"event": "triggered", "mono_ns": "1", "number": number},
        {"event": "stored", "mono_ns": "1", "number": number, "duration_s": 0.1},
        {
            "event": "sealed",
            "mono_ns": "1",
            "number": number,
            "state": "complete",
            "frames": 13,
            "missing": [],
            "mark_sigma_ns": 25,
            "temperatures_c": {"0": 32.1},
            "navigation": here,
            "line": line,
            "strip": line,
        },
        {
            "event": "processed",
            "mono_ns": "1",
            "number": number,
            "duration_s": 0.5,
            "report": {
                "verdict": verdict,
                "flags": [],
                "findings": [{"flag": "SIGMA0", "sentence": "Look.", "verdict": verdict}],
                "figures": {"sigma0_px": 0.01, "dc_k": 11.8, "tie_points_pp": 900, "parallax": 1},
            },
        },
    ]


def mission(path: str = "/nowhere") -> dict[str, Any]:
    return {
        "event": "mission",
        "mono_ns": "1",
        "id": "20261121T101500Z-small",
        "path": path,
        "rig": "small",
        "simulated": True,
        "resumed": False,
        "recovery": [],
    }


def lost(device: str) -> dict[str, Any]:
    return device_event(device, "lost", f"{device} does not answer; look at its cable.", fault=True)


def recovered(device: str) -> dict[str, Any]:
    return device_event(device, "recovered", f"{device} is back.", fault=False)


def device_event(device: str, name: str, sentence: str, *, fault: bool) -> dict[str, Any]:
    return {
        "event": "device",
        "mono_ns": "1",
        "device": device,
        "name": name,
        "fault": fault,
        "sentence": sentence,
    }
