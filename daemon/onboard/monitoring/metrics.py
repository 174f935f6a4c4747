"""Metrics in the conventions of Prometheus: base units, `_total`.

Computed from the state at each scrape; nothing is counted twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from daemon.onboard.flight.ledger import CAUSES, PENDING
from daemon.onboard.flight.phases import Phase
from daemon.onboard.monitoring.flight_state import FlightState

PHASES = tuple(phase.value for phase in Phase)


def exposition(state: FlightState) -> bytes:
    """The response of `/metrics`."""
    registry = CollectorRegistry()
    registry.register(_FlightCollector(state))
    return generate_latest(registry)


class _FlightCollector(Collector):
    def __init__(self, state: FlightState) -> None:
        self._brief = state.brief()
        self._devices = state.devices()
        self._exposures = state.changed("exposures", 0)

    def collect(self) -> Iterator[Metric]:
        brief, status = self._brief, self._brief["status"]
        yield InfoMetricFamily(
            "syntopic",
            "What runs.",
            value={
                "software": str(brief["software"]),
                "mission": str(brief["mission"].get("id") or ""),
                "rig": str(brief["mission"].get("rig") or ""),
                "simulated": str(brief["simulated"]).lower(),
            },
        )
        phase = GaugeMetricFamily("syntopic_phase", "1 for the phase it is in.", labels=["phase"])
        for name in PHASES:
            phase.add_metric([name], float(brief["phase"] == name))
        yield phase
        yield from self._ledger(status.get("ledger") or {})
        verdicts = CounterMetricFamily(
            "syntopic_exposure_verdicts", "Exposures by verdict.", labels=["verdict"]
        )
        for verdict, count in brief["verdicts"].items():
            verdicts.add_metric([verdict], count)
        yield verdicts
        ready = GaugeMetricFamily(
            "syntopic_device_ready", "1 while a device delivers.", labels=["device", "kind"]
        )
        for device in self._devices:
            labels = [device["name"], str(device["kind"] or "")]
            ready.add_metric(labels, float(device["state"] == "ready"))
        yield ready
        counters = CounterMetricFamily(
            "syntopic_device_events",
            "Counters of a device's driver, by its name there.",
            labels=["device", "kind", "counter"],
        )
        for device in self._devices:
            for name, count in sorted(device["counters"].items()):
                counters.add_metric([device["name"], str(device["kind"] or ""), name], count)
        yield counters
        standing = sum(fault["stands"] for fault in brief["faults"])
        yield GaugeMetricFamily("syntopic_faults_standing", "Faults that stand.", value=standing)
        yield from self._gauges(status)

    def _ledger(self, ledger: Mapping[str, Any]) -> Iterator[Metric]:
        triggers = ledger.get("triggers") or {}
        exposures = CounterMetricFamily(
            "syntopic_exposures", "Triggers by what became of them.", labels=["state"]
        )
        for name in ("complete", "degraded", "lost"):
            exposures.add_metric([name], triggers.get(name, 0))
        yield exposures
        yield CounterMetricFamily(
            "syntopic_triggers", "Triggers given.", value=triggers.get("triggers", 0)
        )
        for what in ("frames", "marks"):
            received = CounterMetricFamily(
                f"syntopic_{what}", f"Received {what}, by cause.", labels=["cause"]
            )
            receipts = ledger.get(what) or {}
            for cause in (*CAUSES, "missing"):
                received.add_metric([cause], receipts.get(cause, 0))
            yield received
            pending = receipts.get(PENDING, 0)
            yield GaugeMetricFamily(
                f"syntopic_{what}_pending", f"Received {what}, not attributed yet.", value=pending
            )
        balanced = float(bool(ledger.get("balanced", True)))
        yield GaugeMetricFamily(
            "syntopic_ledger_balanced", "1 while the ledger balances.", value=balanced
        )

    def _disks(self, disks: Sequence[Mapping[str, Any]]) -> Iterator[Metric]:
        """Known properties of each disk; empty if none is known."""
        figures = {
            "syntopic_disk_in_use": ("1 while a disk is in use.", "state"),
            "syntopic_disk_healthy": ("1 while a disk states no problem.", "healthy"),
            "syntopic_disk_temperature_celsius": ("Temperature of a disk.", "temperature_c"),
            "syntopic_disk_wear_percent": ("Endurance of a disk that is used.", "wear_percent"),
        }
        for name, (what, key) in figures.items():
            gauge = GaugeMetricFamily(name, what, labels=["disk"])
            for disk in disks:
                value = disk.get(key)
                if value is not None:
                    number = float(value == "in use") if key == "state" else float(value)
                    gauge.add_metric([str(disk["disk"])], number)
            if gauge.samples:
                yield gauge

    def _gauges(self, status: Mapping[str, Any]) -> Iterator[Metric]:
        left = status.get("exposures_left")
        if left is not None:
            yield GaugeMetricFamily(
                "syntopic_disk_exposures_left", "Exposures the disk still holds.", value=left
            )
        yield from self._disks(status.get("disks") or [])
        sigma_ns = status.get("clock_sigma_ns")
        if sigma_ns is not None:
            yield GaugeMetricFamily(
                "syntopic_clock_sigma_seconds",
                "Standard deviation of GPS time on the host's clock.",
                value=sigma_ns * 1e-9,
            )
        temperatures = GaugeMetricFamily(
            "syntopic_temperature_celsius", "Temperature of a probe.", labels=["probe"]
        )
        for probe, value in (status.get("temperatures_c") or {}).items():
            if value is not None:
                temperatures.add_metric([probe], value)
        yield temperatures
        processing = [
            exposure for exposure in self._exposures if exposure.get("duration_s") is not None
        ]
        if processing:
            yield GaugeMetricFamily(
                "syntopic_processing_last_seconds",
                "Time the pipeline took for the last exposure.",
                value=processing[-1]["duration_s"],
            )
