"""What cannot fit a link is refused by `check` and `run` alike, with its figures."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from processing.rig import find_rig
from tests.support.head_network import head_network

SENTENCE = "432 MB of 13 heads take 3.5 s of 1.35 s on eth1 (1000 Mbit/s"


def service(folder: Path) -> Path:
    """The full camera behind one interface at 1 Gbit/s."""
    lines = [
        "[mission]",
        'root = "missions"',
        'rig = "ultracam-x"',
        "[trigger]",
        'driver = "pulse-bus"',
        "port = 9000",
        "interval_s = 1.35",
        "[network]",
        "link_mbps = { eth1 = 1000 }",
    ]
    for index, sensor in enumerate(find_rig("ultracam-x").sensors):
        lines += ["[[head]]", f'sensor = "{sensor.name}"', 'driver = "aravis"']
        lines += [f'address = "10.77.0.{10 + index}"']
    path = folder / "service.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.timeout(120)
def test_the_full_camera_on_one_gigabit_is_refused_by_check_and_run(tmp_path: Path) -> None:
    pytest.importorskip("gi", reason="needs PyGObject (extra aravis) and gir1.2-aravis-0.8")
    path = str(service(tmp_path))
    with head_network(mtu=9000) as network:
        program = (sys.executable, "-m", "daemon")
        checked = network.at_computer(*program, "check", path, "--json")
        printed = network.at_computer(*program, "check", path)
        run = network.at_computer(*program, "run", path)
    assert checked.returncode == 1, checked.stderr
    found = json.loads(checked.stdout)
    (link,) = found["links"]
    assert (link["interface"], link["fits"], link["heads"]) == ("eth1", False, [])
    assert link["payload_bytes"] == pytest.approx(431.9e6, rel=0.001)
    refusals = [f for f in found["findings"] if f["kind"] == "link"]
    assert [f["prevents"] for f in refusals] == [True]
    assert SENTENCE in refusals[0]["sentence"]
    assert SENTENCE in " ".join(printed.stdout.split())
    assert run.returncode != 0
    assert SENTENCE in " ".join((run.stdout + run.stderr).split())
