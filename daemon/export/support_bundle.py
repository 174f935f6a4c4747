"""What support needs to see of a mission, in one file: no pixels, no raw bytes, no secrets.

Configuration, rig, records and verdicts, what the devices and the service said, the ledger, and the
versions of everything. Values of keys that sound like a secret are left out of the configuration.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import re
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from daemon.disk import durable
from daemon.disk.catalog import Catalog, CatalogError
from daemon.disk.flight_log import logs_of, read
from daemon.disk.mission import Mission
from daemon.disk.verification import VerifyReport

TOPICS = ("event/", "ledger", "audit", "trigger", "mark/", "log/")
"""Topics of the flight log that are told; navigation and raw bytes say where somebody flew."""

EVENTS_MAX_BYTES = 50_000_000
_SECRET = re.compile(r"(?i)^(\s*[\w.\-]*(token|secret|password|passwd|key)[\w.\-]*\s*=\s*).*$")


@dataclass(frozen=True)
class Bundle:
    """The file that was written, and what is in it: bytes by name."""

    path: Path
    contents: dict[str, int]


def write_bundle(
    mission: Mission,
    verified: VerifyReport | None = None,
    *,
    name: str = "support.zip",
    out: Path | None = None,
) -> Bundle:
    """Write `export/support.zip`, in place of an earlier one.

    Args:
        out: another folder to write it into.

    Raises:
        OSError: the disk refused.
    """
    path = (out or mission.export_dir) / name
    durable.make_directories(path.parent)
    contents: dict[str, int] = {}
    with (
        durable.new_file(path) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as bundle,
    ):

        def put(name: str, text: str) -> None:
            bundle.writestr(name, text)
            contents[name] = len(text.encode("utf-8", "replace"))

        put("versions.json", json.dumps(_versions(), indent=1))
        for file in (mission.path / "mission.json", mission.rig_path):
            if file.exists():
                put(file.name, file.read_text("utf-8", "replace"))
        if mission.service_path.exists():
            put("service.toml", without_secrets(mission.service_path.read_text("utf-8", "replace")))
        put("exposures.jsonl", "".join(_records(mission)))
        put("log.jsonl", "".join(_told(mission)))
        put("events.json", json.dumps(_events(mission), indent=1))
        if verified is not None:
            put("verify.json", json.dumps({"problems": list(verified.problems)}, indent=1))
    return Bundle(path, contents)


def without_secrets(text: str) -> str:
    """Configuration with the values of keys that sound like a secret left out."""
    return "\n".join(_SECRET.sub(r"\1\"left out\"", line) for line in text.splitlines()) + "\n"


def _versions() -> dict[str, object]:
    packages = {
        str(one.metadata["Name"]): one.version for one in importlib.metadata.distributions()
    }
    return {
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "packages": dict(sorted(packages.items(), key=lambda item: item[0].lower())),
    }


def _records(mission: Mission) -> Iterator[str]:
    """Record and quality report of each exposure, without where it was."""
    for number in mission.numbers():
        told: dict[str, object] = {"number": number}
        for key, file in (
            ("record", mission.level0(number) / "exposure.json"),
            ("quality", mission.level2(number) / "quality.json"),
        ):
            try:
                content = json.loads(file.read_text("utf-8"))
            except (OSError, ValueError) as error:
                told[key] = f"not to be had: {type(error).__name__}"
                continue
            if isinstance(content, dict):
                content.pop("navigation", None)
            told[key] = content
        yield json.dumps(told) + "\n"


def _told(mission: Mission) -> Iterator[str]:
    """Messages of the flight log that hold neither bytes of devices nor places."""
    nbytes = 0
    for path in logs_of(mission.log_dir):
        for message in read(path):
            if not message.topic.startswith(TOPICS):
                continue
            payload = message.payload.decode("utf-8", "replace").strip()
            line = json.dumps(
                {"log": path.name, "topic": message.topic, "mono_ns": str(message.mono_ns)}
            )
            line = f'{line[:-1]}, "content": {payload}}}\n'
            nbytes += len(line)
            if nbytes > EVENTS_MAX_BYTES:
                yield '{"cut": "more than 50 MB of messages"}\n'
                return
            yield line


def _events(mission: Mission) -> list[dict[str, str]]:
    try:
        catalog = Catalog.read(mission.catalog_path)
    except CatalogError as error:
        return [{"source": "index", "name": "unreadable", "sentence": str(error)}]
    try:
        return [
            {"source": source, "name": name, "sentence": sentence}
            for source, name, sentence in catalog.events()
        ]
    finally:
        catalog.close()
