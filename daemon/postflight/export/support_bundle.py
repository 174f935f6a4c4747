"""Support bundle of a mission, in one file: no pixels, no raw bytes, no secrets.

Configuration, rig, records and verdicts, messages of the devices and the service, the ledger, and
the versions of everything. Secrets are left out of all of it
(`daemon.postflight.export.redaction`).
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from daemon.mission.canonical_json import RECORD_MAX_BYTES, RecordError, parse_record
from daemon.mission.catalog.catalog import Catalog, CatalogError
from daemon.mission.foreign_files import ForeignFileError, read_regular_file
from daemon.mission.layout import Mission, MissionError
from daemon.mission.log.flight_log import logs_of, read
from daemon.mission.store import durable
from daemon.mission.store.output_places import refuse_foreign_file
from daemon.mission.verification.verification import VerifyReport
from daemon.postflight.export.redaction import REDACTED, text_without_secrets, without_secrets
from processing.rig.toml_text import FILE_MAX_BYTES

TOPICS = ("event/", "ledger", "audit", "trigger", "mark/", "log/")
"""Included topics of the flight log; navigation and raw bytes would reveal where somebody flew."""

EVENTS_MAX_BYTES = 50_000_000


@dataclass(frozen=True)
class Bundle:
    """The file that was written, and what is in it: bytes by name."""

    path: Path
    contents: dict[str, int]


_FIRST_FILE = "versions.json"


def _is_bundle(head: bytes) -> bool:
    return head.startswith(b"PK") and _FIRST_FILE.encode() in head[:100]


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
        OutputPlaceError: `out` holds another file of this name.
        OSError: the disk refused.
    """
    path = (out or mission.export_dir) / name
    refuse_foreign_file(path, _is_bundle, cure="give another folder with --out")
    durable.make_directories(path.parent)
    contents: dict[str, int] = {}
    with (
        durable.new_file(path) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as bundle,
    ):

        def put(name: str, text: str) -> None:
            bundle.writestr(name, text)
            contents[name] = len(text.encode("utf-8", "replace"))

        put(_FIRST_FILE, json.dumps(_versions(), indent=1))
        put("mission.json", json.dumps(without_secrets(mission.about()), indent=1))
        if mission.rig_path.exists():
            text = read_regular_file(mission.rig_path, FILE_MAX_BYTES).decode("utf-8", "replace")
            put("rig.toml", text_without_secrets(text))
        put("service.json", _configuration(mission))
        put("exposures.jsonl", "".join(_records(mission)))
        put("log.jsonl", "".join(_log_lines(mission)))
        put("events.json", json.dumps(_events(mission), indent=1))
        if verified is not None:
            put(
                "verify.json",
                json.dumps(without_secrets({"problems": verified.problems}), indent=1),
            )
    return Bundle(path, contents)


def _configuration(mission: Mission) -> str:
    """The configuration that was flown; what cannot be parsed is left out as a whole."""
    try:
        flown = mission.flown_configuration()
    except MissionError:
        return json.dumps({REDACTED: "service.toml cannot be read as TOML"})
    return json.dumps(without_secrets(flown), indent=1, default=str)


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
        entry: dict[str, object] = {"number": number}
        for key, file in (
            ("record", mission.level0(number) / "exposure.json"),
            ("quality", mission.level2(number) / "quality.json"),
        ):
            try:
                content = parse_record(read_regular_file(file, RECORD_MAX_BYTES), file.name)
            except (ForeignFileError, RecordError) as error:
                entry[key] = f"not to be had: {type(error).__name__}"
                continue
            content.pop("navigation", None)
            entry[key] = without_secrets(content)
        yield json.dumps(entry) + "\n"


def _log_lines(mission: Mission) -> Iterator[str]:
    """Messages of the flight log that hold neither bytes of devices nor places."""
    nbytes = 0
    for path in logs_of(mission.log_dir):
        for message in read(path):
            if not message.topic.startswith(TOPICS):
                continue
            try:
                content = without_secrets(parse_record(message.payload, message.topic))
            except RecordError:
                content = "not to be had: no record"
            about = {"log": path.name, "topic": message.topic, "mono_ns": str(message.mono_ns)}
            line = json.dumps({**about, "content": content}) + "\n"
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
            {"source": source, "name": name, "sentence": text_without_secrets(sentence)}
            for source, name, sentence in catalog.events()
        ]
    except CatalogError as error:
        return [{"source": "index", "name": "unreadable", "sentence": str(error)}]
    finally:
        catalog.close()
