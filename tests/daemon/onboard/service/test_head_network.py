"""`check` warns where the heads share a network with others."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.configuration.model import HeadDeviceSection
from daemon.onboard.capture import head_network
from daemon.onboard.capture.head_network import cautions_of
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.service_file import load
from tests.daemon.onboard.service.flight_parts import Planted

pytestmark = pytest.mark.trust

ROUTES = """\
Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t0101A8C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth0\t0001A8C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
eth1\t0000000A\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
"""
HEADER = "IP address       HW type     Flags       HW address            Mask     Device\n"


def heads(*addresses: str) -> dict[str, ipaddress.IPv4Address]:
    return {f"SU0{n}": ipaddress.IPv4Address(address) for n, address in enumerate(addresses)}


def neighbour(address: str, flags: str = "0x2", interface: str = "eth1") -> str:
    return f"{address} 0x1 {flags} 02:00:00:00:00:01 * {interface}\n"


def test_heads_on_an_interface_of_their_own_need_no_caution() -> None:
    seen = HEADER + neighbour("10.0.0.11") + neighbour("10.0.0.12")
    seen += neighbour("10.0.0.99", "0x0") + neighbour("192.168.1.1", interface="eth0")
    assert not cautions_of(heads("10.0.0.11", "10.0.0.12"), ROUTES, seen)


def test_heads_on_the_interface_of_the_default_route_share_it() -> None:
    found = cautions_of(heads("192.168.1.11"), ROUTES, HEADER)
    assert found == {
        "eth0": "head SU00 is on a network shared with others (the default route leads there): "
        "a computer that forges a head's address there can alter its frames. Give the heads a "
        "separate interface"
    }


def test_other_computers_that_answered_are_named_and_counted() -> None:
    seen = HEADER + "".join(neighbour(f"10.0.0.{n}") for n in (11, 12, 51, 52, 53, 54, 55))
    (sentence,) = cautions_of(heads("10.0.0.11", "10.0.0.12"), ROUTES, seen).values()
    assert sentence.startswith(
        "2 heads (SU00 to SU01) are on a network shared with others (10.0.0.51, 10.0.0.52, "
        "10.0.0.53, 2 more)"
    )


def test_a_head_beyond_a_router_shares_the_network_of_the_router() -> None:
    found = cautions_of(heads("172.16.0.5"), ROUTES, HEADER)
    assert "(a router lies in between)" in found["eth0"]


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Planted]:
    made = Planted(tmp_path, monkeypatch)
    made.write()
    yield made


def test_check_reports_it_and_the_flight_is_not_refused(
    planted: Planted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in (("ROUTES", ROUTES), ("NEIGHBOURS", HEADER)):
        (tmp_path / name).write_text(text)
        monkeypatch.setattr(head_network, name, tmp_path / name)
    configuration, rig = load(planted.config)
    assert not list(head_network.head_network(configuration, rig)), "heads of a folder"
    head = HeadDeviceSection.model_validate(
        {"sensor": "SUA", "driver": "aravis", "address": "192.168.1.11"}
    )
    changed = configuration.model_copy(update={"head": [head]})
    (result,) = head_network.head_network(changed, rig)
    assert (result.outcome, result.is_blocking) == (CheckOutcome.PASS, False)
    emulated = HeadDeviceSection.model_validate(
        {"sensor": "SUA", "driver": "aravis", "address": "127.0.0.5"}
    )
    assert not list(
        head_network.head_network(configuration.model_copy(update={"head": [emulated]}), rig)
    )
    assert result.sentence.startswith("caution: head SUA is on a network shared with others")
