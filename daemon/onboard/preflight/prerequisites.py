"""What is missing before any device is opened: one list of checks, for `run` and for `check`.

Both call `prerequisites`, so that their results agree. `daemon.onboard.capture.devices` evaluates
the properties of devices that answered, `daemon.onboard.flight.arming` what is missing for arming.
"""

from __future__ import annotations

import datetime
import errno
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

from daemon.configuration.model import Configuration
from daemon.mission.store import durable
from daemon.mission.store.disk_identity import same_file_system
from daemon.mission.store.disk_space import LEVEL2_SHARE
from daemon.mission.store.health import read_health
from daemon.onboard.capture.devices import frame_nbytes
from daemon.onboard.capture.head_network import head_network
from daemon.onboard.capture.link_settings import (
    exposure_interval_s,
    link_budget,
    link_plans,
    plan_as_json,
)
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed
from daemon.onboard.preflight.import_names import import_names
from drivers.base import registry
from drivers.base.extras import MissingExtraError, require
from processing.image.accelerator.devices import why_unusable
from processing.rig import Rig

Check: TypeAlias = Callable[[Configuration, Rig], Iterator[CheckResult]]

PACE_NBYTES_MIN: Final = 16_000_000
PACE_NBYTES_MAX: Final = 512_000_000
PACE_TRIES: Final = 3
"""Number of measurements; the fastest counts, since other programs write as well."""
_BLOCK_NBYTES: Final = 4_000_000


def prerequisites(
    configuration: Configuration, rig: Rig, checks: Sequence[Check] | None = None
) -> list[CheckResult]:
    """Every item that can be checked without a device, in the order of `CHECKS`.

    A blocking failure ends the checks: later ones may depend on it.
    """
    results: list[CheckResult] = []
    for check in CHECKS if checks is None else checks:
        results += check(configuration, rig)
        if any(result.is_blocking for result in results):
            break
    return results


def libraries(configuration: Configuration, rig: Rig) -> Iterator[CheckResult]:
    """Optional packages that the configuration needs."""
    needed = {
        extra
        for kind, driver in configuration.drivers
        for extra in registry.extras_of(kind, driver)
    }
    if configuration.watch is not None:
        needed |= {"watch"} | ({"mavlink"} if configuration.watch.mavlink is not None else set())
    elevation = configuration.plan.elevation
    if elevation is not None and elevation.suffix.lower() != ".asc":
        needed.add("geotiff")
    for extra in sorted(needed):
        try:
            require(extra)
        except MissingExtraError as error:
            yield failed("library", extra, str(error), is_blocking=True)
        else:
            yield passed("library", extra)


def accelerator(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """The device that pixels are computed on, where it is not the processor."""
    device = configuration.processing.device
    if device == "cuda":
        sentence = why_unusable(device)
        if sentence is None:
            yield passed("accelerator", device)
        else:
            yield failed("accelerator", device, sentence, is_blocking=True)


def calibration(configuration: Configuration, rig: Rig) -> Iterator[CheckResult]:
    """The age of the calibration, and its files of every sensor that flies."""
    name = rig.calibration_id
    age_days = 0
    if rig.is_calibrated:
        age_days = (_today() - datetime.date.fromisoformat(rig.calibration_date)).days
    else:
        yield passed(
            "calibration",
            "rig",
            f"caution: rig {rig.name} is uncalibrated; no exposure gets a better verdict than "
            "usable. Calibrate the camera with its first flight: syntopic calibrate flight MISSION",
        )
    if age_days > rig.calibration_valid_days:
        yield failed(
            "calibration",
            name,
            f"calibration {name} of {rig.calibration_date} is {age_days} days old and was valid "
            f"for {rig.calibration_valid_days}; calibrate the camera. Exposures are flagged "
            "CALIBRATION_EXPIRED",
        )
    folder = configuration.mission.radiometry
    missing = [
        head.sensor
        for head in configuration.head
        if folder is not None
        and not any((folder / f"{head.sensor}{suffix}").exists() for suffix in (".npz", ".json"))
    ]
    if missing:
        yield failed(
            "calibration",
            "radiometry",
            f"{folder} has no calibration of {', '.join(missing)}; add {missing[0]}.npz (or "
            f"{missing[0]}.json for radiance). Pixels of these heads are taken as ideal",
        )
    elif rig.is_calibrated and age_days <= rig.calibration_valid_days:
        yield passed("calibration", name, date=rig.calibration_date)


def storage(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """The root of missions and its mirror: there or creatable, and writable.

    Of two disks one is enough for a flight.
    """
    root, mirror = configuration.mission.root, configuration.mission.mirror
    if mirror is None:
        yield _writable("root", root, is_blocking=True)
        return
    results = [_writable("root", root), _writable("mirror", mirror)]
    if all(result.outcome is CheckOutcome.FAIL for result in results):
        results = [_writable("root", root, is_blocking=True)]
    yield from results
    if same_file_system(root, mirror):
        yield passed(
            "disk",
            "mirror",
            f"caution: {mirror} is on the same file system as {root}; one fault affects both: "
            "mount another disk there",
        )


def _writable(key: str, root: Path, *, is_blocking: bool = False) -> CheckResult:
    try:
        if key == "mirror" and not root.is_dir():
            # A folder made here would lie below a mount point, on the wrong disk.
            raise NotADirectoryError(errno.ENOENT, "there is no such folder")
        durable.make_directories(root)
        probe = root / f".check-{os.getpid()}{durable.PART_SUFFIX}"
        probe.unlink(missing_ok=True)
        try:
            durable.create_file(probe, [b"syntopic check\n"])
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        return failed(
            "disk",
            str(root),
            f"mission.{key} {root} cannot be written ({error.strerror or error}); mount the disk, "
            "free it, or give the user of the service the right to write there",
            is_blocking=is_blocking,
        )
    return passed("disk", str(root), free_gb=f"{durable.free_bytes(root) / 1e9:.1f}")


def disk_health(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """Health reported by the disks, if the helper service reads it."""
    mission = configuration.mission
    for key, root in (("root", mission.root), ("mirror", mission.mirror)):
        if root is None:
            continue
        name = f"health of {key}"
        try:
            found = read_health(root)
        except OSError:
            continue  # `storage` reports the error
        if found is None:
            sentence = "not read; run: sudo systemctl enable --now syntopic-disk-health.timer"
            yield CheckResult("disk", name, CheckOutcome.NOT_TRIED, sentence)
        elif found.problems:
            yield failed("disk", name, f"disk of {root}: {'; '.join(found.problems)}")
        else:
            stated = {"temperature_c": found.temperature_c, "wear_percent": found.wear_percent}
            numbers = {k: f"{value:g}" for k, value in stated.items() if value is not None}
            yield passed("disk", name, model=found.model, serial=found.serial, **numbers)


def memory(configuration: Configuration, rig: Rig) -> Iterator[CheckResult]:
    """Memory for the frames of the exposures held in memory."""
    depth = configuration.limits.exposures_in_memory
    needed = depth * exposure_nbytes(configuration, rig)
    available = available_memory_nbytes()
    if available is not None and needed > available:
        yield failed(
            "memory",
            "frames",
            f"frames of {depth} exposures need {needed / 1e9:.1f} GB of memory and "
            f"{available / 1e9:.1f} GB are available; end other programs, add memory, or lower "
            "limits.exposures_in_memory",
            is_blocking=True,
        )
    else:
        yield passed("memory", "frames", needed_gb=f"{needed / 1e9:.2f}")


def pace(configuration: Configuration, rig: Rig) -> Iterator[CheckResult]:
    """Whether the disk writes as fast as exposures may come."""
    root = configuration.mission.root
    nbytes = exposure_nbytes(configuration, rig)
    interval_s = exposure_interval_s(configuration, rig)
    needed = (1 + LEVEL2_SHARE) * nbytes / interval_s
    size = min(max(2 * nbytes, PACE_NBYTES_MIN), PACE_NBYTES_MAX)
    size = min(size, durable.free_bytes(root) // 2)
    if size < _BLOCK_NBYTES:
        return  # a full disk is reported by arming
    measured = 0.0
    try:
        for _ in range(PACE_TRIES):
            measured = max(measured, size / measure_write_s(root, size))
            if measured >= needed:
                break
    except OSError as error:
        sentence = f"the disk of {root} refused to write {size} bytes ({error.strerror or error})"
        yield failed("disk", "pace", f"{sentence}; check the disk")
        return
    rates = f"{measured / 1e6:.0f} MB/s measured, {needed / 1e6:.0f} MB/s needed"
    if measured < needed:
        yield failed(
            "disk",
            "pace",
            f"the disk of {root} is too slow: {rates} for an exposure every {interval_s:g} s; use "
            "a faster disk, or expose less often. Frames that find no free memory are lost",
        )
    else:
        yield passed("disk", "pace", rates)


def monitoring(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """Port, tokens, certificate and keys of the page, if there is one."""
    if configuration.watch is not None:
        from daemon.onboard.monitoring.monitoring_prerequisites import check_monitoring

        yield from check_monitoring(configuration.watch)


CHECKS: Final[Sequence[Check]] = (
    import_names,
    libraries,
    accelerator,
    calibration,
    storage,
    disk_health,
    memory,
    head_network,
    link_budget,
    pace,
    monitoring,
)
"""Every prerequisite, in the order of the checks."""
CHECKS_AT_START: Final = tuple(check for check in CHECKS if check is not monitoring)
"""Those of a new flight: the process of the page checks its own when it begins."""
CHECKS_AFTER_RESTART: Final = tuple(c for c in CHECKS_AT_START if c not in (disk_health, pace))
"""Those of a resumed flight: the disk is not measured, to save time."""


def exposure_nbytes(configuration: Configuration, rig: Rig) -> int:
    """Bytes of the frames of one exposure."""
    return sum(frame_nbytes(rig, head.sensor) for head in configuration.head)


def available_memory_nbytes() -> int | None:
    """Memory that is available without swapping (MemAvailable); None if it cannot be read."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    return found[0] if found else None


def measure_write_s(root: Path, nbytes: int) -> float:
    """Seconds that a file of so many bytes takes to be durable in a folder; it is removed again.

    Raises:
        OSError: the disk refused.
    """
    path = root / f".pace-{os.getpid()}{durable.PART_SUFFIX}"
    block = memoryview(os.urandom(_BLOCK_NBYTES))
    parts = [block[: min(_BLOCK_NBYTES, nbytes - at)] for at in range(0, nbytes, _BLOCK_NBYTES)]
    path.unlink(missing_ok=True)
    started = time.monotonic()
    try:
        durable.create_file(path, parts, mode=0o644)
        return time.monotonic() - started
    finally:
        path.unlink(missing_ok=True)


def _today() -> datetime.date:
    return datetime.datetime.now(datetime.UTC).date()


def link_tables(configuration: Configuration, rig: Rig) -> list[dict[str, Any]]:
    """The budget of every interface with heads, as plain JSON types."""
    return [plan_as_json(plan) for plan in link_plans(configuration, rig)[0]]
