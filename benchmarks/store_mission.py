"""`python -m benchmarks.store_mission FOLDER`: a mission through a bucket whose requests fail.

A mission is uploaded to moto's S3 server while each 20th request fails: refused, throttled, its
answer lost, hung, or its body cut short. It is verified there. Then two worker processes process it
in the bucket, with a disk (a tmpfs, which root mounts) smaller than one of its exposures. Products
are compared with those of a folder. With `--upload-only` it is uploaded and verified, which needs
three times its size of disk. With `--kills` the upload is killed so often, evenly over its bytes,
and continued. The status is 1 where something does not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from daemon.cli.benchmark.measurement import machine
from daemon.mission.layout import Mission
from daemon.mission.store.product_manifests import committed_keys, read_manifest
from daemon.mission.transfer import object_store
from daemon.mission.transfer.object_store import ObjectStore
from daemon.mission.transfer.store_products import list_products, read_stored_manifest
from daemon.mission.transfer.store_transfer import transfer_to_store
from daemon.mission.transfer.store_verification import verify_in_store
from tests.daemon import diverging_camera
from tests.daemon.mission.stores.faulty_s3 import BUCKET, REGION, Faults, serving

KINDS = ("500", "503", "lost answer", "truncated", "hang")
EVERY = 20
REQUEST_TIMEOUT_S = 15.0
SENT_MAX = 1.1
"""Bytes sent over bytes of the mission."""


def flown(root: Path, exposures: int, side_px: int) -> Mission:
    """A mission of two heads with frames of so many pixels a side."""
    small = (diverging_camera.WIDTH_PX, diverging_camera.HEIGHT_PX)
    for name, before in zip(("width_px", "height_px"), small, strict=True):
        diverging_camera.RIG_TOML = diverging_camera.RIG_TOML.replace(
            f"{name} = {before}", f"{name} = {side_px}"
        )
    diverging_camera.WIDTH_PX = diverging_camera.HEIGHT_PX = side_px
    return diverging_camera.flown_mission(root, range(1, exposures + 1))


@contextmanager
def small_disk(folder: Path, nbytes: int) -> Iterator[Path]:
    """An empty disk of so many bytes."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={nbytes}", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def processed(place: str, disk: Path | None, *options: str) -> dict[str, Any]:
    """What `syntopic process` prints; its temporary files are on the disk."""
    environment = os.environ | ({} if disk is None else {"TMPDIR": str(disk)})
    command = [sys.executable, "-m", "daemon", "process", place, "--json", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, env=environment, check=True)
    content: dict[str, Any] = json.loads(done.stdout)
    return content


def compared(mission: Mission, place: ObjectStore) -> tuple[dict[int, str], dict[int, str]]:
    """Hashes of the products in the folder and in the store, by exposure."""
    folder: dict[int, str] = {}
    for number in mission.numbers():
        (key,) = committed_keys(mission, number)
        manifest = read_manifest(mission, number, key)
        folder[number] = manifest.compared_sha256 if manifest else ""
    stored: dict[int, str] = {}
    for number, key in list_products(place).committed():
        there = read_stored_manifest(place, number, key)
        stored[number] = there.compared_sha256 if there else ""
    return folder, stored


def killed_uploads(mission: Mission, url: str, kills: int, faults: Faults) -> None:
    """Run `syntopic transfer` so often, each time killed a step further on.

    Args:
        mission: to be uploaded.
        url: of the folder in the bucket.
        kills: their number.
        faults: of the store, which counts the bytes that were sent.
    """
    nbytes = sum(path.stat().st_size for path in mission.path.rglob("*") if path.is_file())
    command = [sys.executable, "-m", "daemon", "transfer", str(mission.path), url]
    for number in range(1, kills + 1):
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)

        def kill_when_due(
            _method: str, _path: str, number: int = number, pid: int = child.pid
        ) -> bool:
            if sum(faults.sent.values()) >= number * nbytes / (kills + 1):
                os.kill(pid, signal.SIGKILL)  # it is not waited for yet: the id is its own
                faults.is_for = lambda _method, _path: True
            return True

        faults.is_for = kill_when_due
        if child.wait() != -signal.SIGKILL:
            raise RuntimeError(f"upload {number} ended with status {child.returncode}")


def measured(options: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Figures, and what does not hold."""
    object_store.REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S  # type: ignore[misc]  # hangs are short
    mission = flown(options.folder / "flown", options.exposures, options.side)
    exposure_nbytes = 2 * 2 * options.side**2
    disk_nbytes = exposure_nbytes // 2
    faults = Faults(every=EVERY, kinds=KINDS, hang_s=REQUEST_TIMEOUT_S + 1)
    problems: list[str] = []
    with serving(faults) as endpoint:
        os.environ |= {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": REGION,
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
        }
        begun_s = time.monotonic()
        place_url = f"s3://{BUCKET}/missions"
        killed_uploads(mission, place_url, options.kills, faults)
        report = transfer_to_store(mission, ObjectStore(place_url))
        upload_s = time.monotonic() - begun_s
        upload_faults = dict(faults.counts)
        sent = sum(n for path, n in faults.sent.items() if not path.endswith("transfer.json"))
        faults.every = 0
        place = ObjectStore(report.target)
        problems += verify_in_store(place).problems
        if sent > SENT_MAX * report.nbytes:
            problems.append(f"{sent / report.nbytes:.3f} times the bytes were sent")
        figures = {
            "exposures": options.exposures,
            "mission_nbytes": report.nbytes,
            "exposure_nbytes": exposure_nbytes,
            "upload_kills": options.kills,
            "reused_nbytes_after_last_kill": report.uploads.reused_nbytes,
            "upload_s": round(upload_s, 1),
            "upload_faults": upload_faults,
            "sent_share": round(sent / report.nbytes, 4),
            "largest_request_nbytes": faults.largest,
        }
        if options.upload_only:
            return figures, problems
        faults.every, faults.hang_s = EVERY, 0.5
        with small_disk(options.folder / "disk", disk_nbytes) as disk:
            begun_s = time.monotonic()
            output = processed(place.url, disk, "--processes", "2", "--threads", "1")
            process_s = time.monotonic() - begun_s
        faults.every = 0
        problems += [failure["cause"] for failure in output["failures"]]
        problems += verify_in_store(place).problems
        processed(str(mission.path), None, "--processes", "2", "--threads", "1")
        folder, stored = compared(mission, place)
        if folder != stored:
            problems.append("products in the store differ from those in a folder")
    figures |= {
        "disk_nbytes": disk_nbytes,
        "process_s": round(process_s, 1),
        "process_faults": {k: n - upload_faults.get(k, 0) for k, n in faults.counts.items()},
        "done": output["done"],
        "equal": folder == stored,
    }
    return figures, problems


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.store_mission", description=__doc__)
    parser.add_argument("folder", type=Path, help="new folder for the mission")
    parser.add_argument("--exposures", type=int, default=20)
    parser.add_argument("--side", type=int, default=2048, help="pixels of a frame's side")
    parser.add_argument("--upload-only", action="store_true", help="verify, do not process")
    parser.add_argument("--kills", type=int, default=0, help="of the upload")
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    figures, problems = measured(options)
    output = {"machine": machine(), "load": os.getloadavg()[0], **figures, "problems": problems}
    print(json.dumps(output))
    if problems:
        sys.exit(1)


if __name__ == "__main__":
    main()
