"""A flight while others attack it from the network: nothing is lost or stored for that."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.demo_mission import ROOT, DemoMission

pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
pytest.importorskip("pymavlink", reason="pip install 'syntopic[mavlink]'")
pytestmark = [
    pytest.mark.system,
    pytest.mark.attack,
    pytest.mark.trust,
    pytest.mark.timeout(600),
]
EXPOSURES = int(os.environ.get("SYNTOPIC_ATTACKED_EXPOSURES", "4"))
BLOCK = 2 if EXPOSURES < 16 else 4
HEADS = 13
NAMESPACE = ["unshare", "--map-root-user", "--net"]


def test_an_attacked_flight_loses_nothing_and_stores_what_its_heads_sent(
    tmp_path: Path, flown: DemoMission, record_property: Callable[[str, Any], None]
) -> None:
    has_unshare = shutil.which("unshare") is not None
    if not has_unshare or subprocess.run([*NAMESPACE, "true"], check=False).returncode:
        pytest.skip("needs unshare and user namespaces: only a loopback of its own is attacked")
    done = subprocess.run(
        [
            *(*NAMESPACE, sys.executable, "-m", "tests.system.attacked_flight", str(tmp_path)),
            *(str(EXPOSURES), "--block", str(BLOCK), "--scenes", str(flown.scenes)),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=540,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    output = json.loads(done.stdout)
    for name in ("verdict_s", "attackers"):
        record_property(name, json.dumps(output[name]))
        print(name, output[name])
    # Everything was attacked: two sockets a head, and each kind of attacker got through.
    assert output["udp_sockets"] > 2 * HEADS
    assert set(output["attackers"]["sent"]) == {
        *("gvsp", "gvcp", "junk", "commands to heads", "mavlink junk", "mavlink replayed"),
        *("announcements", "slow connections", "floods", "wrong tokens"),
    }
    assert all(count > 0 for count in output["attackers"]["sent"].values())
    assert "other-sender" in output["reported"]

    assert output["failure"] is None
    triggers = output["ledger"]["triggers"]
    assert (triggers["triggers"], triggers["complete"]) == (EXPOSURES, EXPOSURES)
    assert (triggers["lost"], triggers["degraded"]) == (0, 0)
    frames = output["ledger"]["frames"]
    assert (frames["received"], frames["used"]) == (HEADS * EXPOSURES, HEADS * EXPOSURES)
    assert output["ledger"]["balanced"]
    assert output["pixels"] == {"stored": HEADS * EXPOSURES, "same": HEADS * EXPOSURES}
    assert output["verified"] == 0
    assert not [name for name in output["reported"] if name in ("lost", "stream-restarted")]
