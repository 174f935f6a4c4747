"""A service on a disk that fills in flight, in a namespace of its own: `... CONFIG DISK`.

Mounts a tmpfs at DISK, where CONFIG keeps its missions, and flies; prints what became of it as
JSON.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from daemon.mission.layout import Mission
from daemon.mission.verification.verification import verify

SIZE = "size=400m"
STORED_BEFORE = 2
STORED_AFTER = 2
NEARLY_FULL_BYTES = 100_000_000
"""Left until an exposure is triggered: the rest is filled before its frames come."""
FULL_FOR_S = 3.0
REFUSED_WITHIN_S = 20.0
LIMIT_S = 150.0


def main() -> None:
    config, disk = Path(sys.argv[1]), Path(sys.argv[2])
    subprocess.run(["mount", "-t", "tmpfs", "-o", SIZE, "tmpfs", str(disk)], check=True)
    filler = disk / "filler"
    command = [sys.executable, "-m", "tests.robustness.crash.service", str(config)]
    service = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert service.stdout is not None
    events: list[dict[str, Any]] = []
    stored: list[int] = []
    filled_s = refused_s = freed_s = 0.0
    filled_for = 0
    stored_after = 0
    mission = ""
    begun_s = time.monotonic()
    for line in service.stdout:
        event = json.loads(line)
        now_s = time.monotonic()
        events.append(event)
        if event["event"] == "mission":
            mission = event["path"]
        elif event["event"] == "triggered" and len(stored) >= STORED_BEFORE and not filled_s:
            # The guard has let it pass: its frames find a disk that is full.
            _fill(filler, leave=0)
            filled_s, filled_for = now_s, event["number"]
        elif event["event"] == "not-written" and not refused_s:
            refused_s = now_s
        elif event["event"] == "stored":
            stored.append(event["number"])
            stored_after += bool(freed_s)
            if len(stored) == STORED_BEFORE:
                _fill(filler, leave=NEARLY_FULL_BYTES)
            elif event["number"] == filled_for and not refused_s:
                # On a busy machine the event came after the frames: once more with the next.
                _free(filler, NEARLY_FULL_BYTES)
                filled_s = 0.0
        is_over = refused_s and now_s - refused_s > FULL_FOR_S
        if filled_s and not freed_s and (is_over or now_s - filled_s > REFUSED_WITHIN_S):
            filler.unlink()
            freed_s = now_s
        if stored_after >= STORED_AFTER or now_s - begun_s > LIMIT_S:
            service.send_signal(signal.SIGTERM)
            stored_after = -1000
    status = service.wait(60)
    ended = next((e for e in reversed(events) if e["event"] == "ended"), {})
    report = verify(Mission.open(Path(mission)))
    counts = {name: sum(e["event"] == name for e in events) for name in ("not-written", "disk")}
    print(
        json.dumps(
            {
                "status": status,
                "failure": ended.get("failure"),
                "balanced": ended["ledger"]["balanced"],
                "triggers": ended["ledger"]["triggers"],
                "stored": stored,
                "events": counts,
                "problems": report.problems,
                "exposures": report.exposures,
                "was_freed": bool(freed_s),
            }
        )
    )


def _fill(path: Path, *, leave: int) -> None:
    """Up to so many bytes; with none, to the last page."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for block in (1 << 20, 4096):
        try:
            while _free_bytes(path) > leave:
                os.write(descriptor, bytes(block))
        except OSError:
            continue
    os.close(descriptor)


def _free(path: Path, nbytes: int) -> None:
    """Give so many bytes back."""
    os.truncate(path, max(0, path.stat().st_size - nbytes))


def _free_bytes(path: Path) -> int:
    disk = os.statvfs(path)
    return disk.f_bavail * disk.f_frsize


if __name__ == "__main__":
    main()
