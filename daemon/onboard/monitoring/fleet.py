"""Several aircraft on one page: the state of each service, gathered from its telemetry.

Reading only. A command goes to the page of the aircraft itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from fastapi import FastAPI
from fastapi.responses import FileResponse

from daemon.onboard.monitoring.client.telemetry_client import (
    AccessOptions,
    ClientError,
    ServiceAddress,
    telemetry_records,
)
from daemon.onboard.monitoring.server_messages import with_messages
from daemon.onboard.monitoring.web.page_files import PAGE, PageFiles, add_security_headers

BYTES_PER_S = 4000.0
"""Budget of each link: the brief state each second, and little besides."""

RETRY_S = 2.0
OLD_S = 5.0
"""Age from which a state counts as not linked."""

MEMBERS_MAX = 32
FAULTS_MAX = 50
SEVERITY_ORDER = {"warning": 0, "caution": 1, "info": 2}

Records = Callable[[ServiceAddress, AccessOptions, float], Iterator[dict[str, Any] | None]]


class FleetMember:
    """One service: its last state, and when it was received.

    Args:
        service: its address.
        access: token and authority.
        records: source of telemetry records; replaced in tests.
    """

    def __init__(
        self,
        service: ServiceAddress,
        access: AccessOptions,
        records: Records = telemetry_records,
    ) -> None:
        self.service = service
        self._access = access
        self._records = records
        self._lock = threading.Lock()
        self._brief: dict[str, Any] = {}
        self._received_s: float | None = None
        self._problem = ""

    def start(self) -> None:
        """Receive telemetry in a thread, for ever."""
        name = f"fleet {self.service.address}"
        threading.Thread(target=self._receive, name=name, daemon=True).start()

    def _receive(self) -> None:
        while True:
            try:
                for record in self._records(self.service, self._access, BYTES_PER_S):
                    self.add(record, time.monotonic())
            except ClientError as error:
                with self._lock:
                    self._problem = str(error)
            time.sleep(RETRY_S)

    def add(self, record: Mapping[str, Any] | None, now_s: float) -> None:
        """Take a record; None if the connection is lost."""
        with self._lock:
            if record is None:
                self._problem = "the connection was lost; it is retried"
                return
            keys = ("phase", "mission", "simulated", "status", "faults", "verdicts", "last_number")
            self._brief = {key: record.get(key) for key in keys}
            self._received_s, self._problem = now_s, ""

    def as_json(self, now_s: float) -> dict[str, Any]:
        """The row of this aircraft."""
        with self._lock:
            brief, received_s, problem = self._brief, self._received_s, self._problem
        mission, status = _map(brief.get("mission")), _map(brief.get("status"))
        triggers = _map(_map(status.get("ledger")).get("triggers"))
        age_s = None if received_s is None else max(0.0, now_s - received_s)
        return {
            "address": self.service.address,
            "name": str(mission.get("rig") or self.service.address),
            "is_linked": age_s is not None and age_s <= OLD_S and not problem,
            "age_s": None if age_s is None else round(age_s, 1),
            "problem": problem,
            "phase": brief.get("phase"),
            "mission": mission.get("id"),
            "simulated": bool(brief.get("simulated")),
            "triggers": triggers.get("triggers"),
            "lost": triggers.get("lost"),
            "verdicts": brief.get("verdicts") or {},
            "exposures_left": status.get("exposures_left"),
            "faults": [f for f in _list(brief.get("faults"))[:FAULTS_MAX] if isinstance(f, dict)],
        }


def fleet_json(members: Sequence[FleetMember], now_s: float) -> dict[str, Any]:
    """All aircraft, one row each, and their alarms merged: the active and severe ones first.

    Args:
        members: the services.
        now_s: time of the monotonic clock in s.

    Returns:
        `aircraft`, in the order of the members, and `alarms`, each with its `aircraft`.
    """
    rows = [member.as_json(now_s) for member in members]
    alarms = [
        {**fault, "aircraft": row["name"], "address": row["address"]}
        for row in rows
        for fault in row.pop("faults")
    ]
    alarms.sort(key=_urgency)
    return {"aircraft": rows, "alarms": alarms}


def create_fleet_app(members: Sequence[FleetMember]) -> FastAPI:
    """The application that serves the page of several aircraft."""
    app = FastAPI(title="Syntopic aircraft", docs_url=None, redoc_url=None, openapi_url=None)
    app.middleware("http")(add_security_headers)

    @app.get("/api/v1/fleet")
    async def fleet() -> dict[str, Any]:
        """The state of each aircraft, and all alarms."""
        return dict(with_messages(fleet_json(members, time.monotonic())))

    @app.get("/")
    async def page() -> FileResponse:
        return FileResponse(PAGE / "fleet.html")

    app.mount("/", PageFiles(PAGE), name="page")
    return app


def _urgency(alarm: Mapping[str, Any]) -> tuple[bool, bool, int]:
    severity = SEVERITY_ORDER.get(str(alarm.get("severity")), 0)
    return not alarm.get("stands"), bool(alarm.get("acknowledged")), severity


def _map(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
