"""The link budget of a configuration: interfaces of the kernel in, settings of heads out."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from daemon.cli.check import check_flight
from daemon.configuration.model import Configuration
from daemon.onboard.capture import link_settings
from daemon.onboard.capture.devices import device_specs
from daemon.onboard.capture.link_settings import (
    head_link_problem,
    link_budget,
    link_plans,
    paced_specs,
)
from daemon.onboard.preflight.check_results import CheckOutcome
from daemon.onboard.preflight.service_file import from_mapping
from processing.rig import Rig, find_rig
from tests.daemon.configuration.test_configuration import GOOD

ROUTES = """\
Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t0101A8C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth1\t0000000A\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
eth2\t0001000A\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
"""


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Interfaces eth1 (1 Gbit/s) and eth2 (no rate), both for packets of 9,000 bytes."""
    for name, speed in (("eth1", "1000"), ("eth2", "-1")):
        folder = tmp_path / "net" / name
        folder.mkdir(parents=True)
        (folder / "mtu").write_text("9000\n")
        (folder / "speed").write_text(f"{speed}\n")
    (tmp_path / "route").write_text(ROUTES)
    monkeypatch.setattr(link_settings, "INTERFACES", tmp_path / "net")
    monkeypatch.setattr(link_settings, "ROUTES", tmp_path / "route")
    return tmp_path / "net"


def configured(
    rig: str = "ultracam-x-mini",
    network: str = "10.0.0",
    head: dict[str, Any] | None = None,
) -> tuple[Configuration, Rig]:
    content = copy.deepcopy(GOOD)
    content["mission"]["rig"] = rig
    content["trigger"]["interval_s"] = 1.35
    content["head"] = [
        {"sensor": s.name, "driver": "aravis", "address": f"{network}.{10 + i}", **(head or {})}
        for i, s in enumerate(find_rig(rig).sensors)
    ]
    return from_mapping(content, Path("service.toml"))


def test_the_full_camera_on_one_gigabit_is_refused_with_its_figures(kernel: Path) -> None:
    (result,) = link_budget(*configured("ultracam-x"))
    assert result.outcome is CheckOutcome.FAIL
    assert result.is_blocking
    assert "432 MB of 13 heads take 3.5 s of 1.35 s on eth1 (1000 Mbit/s" in result.sentence
    assert "spread the heads over more or faster interfaces" in result.sentence
    assert "expose every 3.9 s" in result.sentence


def test_thirteen_mini_heads_share_the_rate(kernel: Path) -> None:
    configuration, rig = configured()
    (result,) = link_budget(configuration, rig)
    assert result.outcome is CheckOutcome.PASS
    assert "27 MB of 13 heads take 0.22 s of 1.35 s at 1000 Mbit/s" in result.sentence
    specs = paced_specs(device_specs(configuration, rig), configuration, rig)
    rates = [spec.settings["stream_rate_mbps"] for spec in specs if spec.kind == "head"]
    assert len(rates) == 13
    assert sum(rates) == pytest.approx(900.0)
    assert not any("stream_rate_mbps" in spec.settings for spec in specs if spec.kind != "head")


def test_heads_on_the_loopback_are_not_paced(kernel: Path) -> None:
    configuration, rig = configured(network="127.0.0")
    specs = device_specs(configuration, rig)
    assert paced_specs(specs, configuration, rig) == specs
    assert not list(link_budget(configuration, rig))


def test_an_unknown_rate_is_reported_with_the_key_that_states_it(kernel: Path) -> None:
    (result,) = link_budget(*configured(network="10.0.1"))
    assert result.outcome is CheckOutcome.NOT_TRIED
    assert "network.link_mbps = { eth2 = 1000 }" in result.sentence


def test_the_configured_rate_replaces_that_of_the_interface(kernel: Path) -> None:
    (plan,), unknown = link_plans(
        *configured_with_network("10.0.1", {"link_mbps": {"eth2": 100.0}})
    )
    assert unknown == []
    assert plan.needed_s == pytest.approx(2.18, abs=0.01)
    assert not plan.fits


def configured_with_network(addresses: str, section: dict[str, Any]) -> tuple[Configuration, Rig]:
    configuration, rig = configured(network=addresses)
    network = type(configuration.network).model_validate(section)
    return configuration.model_copy(update={"network": network}), rig


def test_a_rate_of_an_interface_without_heads_is_reported(kernel: Path) -> None:
    wrong, fitting = link_budget(*configured_with_network("10.0.0", {"link_mbps": {"eth2": 100.0}}))
    assert wrong.outcome is CheckOutcome.FAIL
    assert not wrong.is_blocking
    assert "network.link_mbps has eth2" in wrong.sentence
    assert "heads are reached by eth1" in wrong.sentence
    assert fitting.outcome is CheckOutcome.PASS


def test_heads_that_are_configured_by_name_are_reported_as_not_counted(kernel: Path) -> None:
    results = list(link_budget(*configured(network="Basler-2134")))
    assert {result.outcome for result in results} == {CheckOutcome.NOT_TRIED}
    assert len(results) == 13
    assert "'Basler-2134.10' and not counted in a link budget" in results[0].sentence


def test_pacing_can_be_switched_off(kernel: Path) -> None:
    configuration, rig = configured_with_network("10.0.0", {"is_paced": False})
    specs = device_specs(configuration, rig)
    assert paced_specs(specs, configuration, rig) == specs


def test_what_is_configured_for_a_head_takes_precedence(kernel: Path) -> None:
    configuration, rig = configured(head={"stream_rate_mbps": 50.0})
    specs = paced_specs(device_specs(configuration, rig), configuration, rig)
    assert {s.settings["stream_rate_mbps"] for s in specs if s.kind == "head"} == {50.0}


@pytest.mark.parametrize(
    ("head", "packet_size", "payload"),
    [
        ({}, 8192, 2 * 1248 * 832),
        ({"packet_size_limit": 65535}, 9000, 2 * 1248 * 832),
        ({"packet_size": 1500, "pixel_format": "Mono12p"}, 1500, 1248 * 832 * 3 // 2),
        ({"pixel_format": "Mono12"}, 8192, 2 * 1248 * 832),
        ({"pixel_format": "Mono8"}, 8192, 1248 * 832),
    ],
)
def test_format_and_packet_size_follow_the_settings(
    kernel: Path, head: dict[str, Any], packet_size: int, payload: int
) -> None:
    (plan,), _ = link_plans(*configured(head=head))
    demand = plan.demands[0]
    assert demand.packet_size == packet_size
    assert payload < demand.payload_nbytes < payload + 4096


def test_a_buffer_of_four_packets_staggers_the_transfers(kernel: Path) -> None:
    configuration, rig = configured_with_network("10.0.0", {"switch_buffer_bytes": 33_000})
    specs = paced_specs(device_specs(configuration, rig), configuration, rig)
    delays = [s.settings.get("transfer_delay_us", 0.0) for s in specs if s.kind == "head"]
    assert len(set(delays)) == 4


def test_check_prints_the_budget_and_gives_it_as_json(
    kernel: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    configuration, rig = configured("ultracam-x")
    monkeypatch.setattr(
        "daemon.onboard.preflight.service_file.load", lambda _: (configuration, rig)
    )
    monkeypatch.setattr("daemon.cli.check.collect_results", lambda *_, **__: list(
        link_budget(configuration, rig)
    ))  # fmt: skip
    for as_json in (True, False):
        with pytest.raises(BaseException, match="1") as ended:
            check_flight(tmp_path / "service.toml", fire=False, as_json=as_json)
        assert getattr(ended.value, "exit_code", None) == 1
        text = capsys.readouterr().out
        if as_json:
            (link,) = json.loads(text)["links"]
            assert link["fits"] is False
            assert link["needed_s"] == pytest.approx(3.49, abs=0.01)
        else:
            assert "take 3.49 s of 1.35 s (does not fit" in " ".join(text.split())


@pytest.mark.parametrize(
    ("link", "assumed_mbps", "is_refused"),
    [
        ("100 Mbit/s", 1000, True),
        ("1000 Mbit/s", 1000, False),
        ("100 Mbit/s", 100, False),
        ("1000 Mbit/s", 2500, True),
        ("", 1000, False),
    ],
)
def test_a_head_that_is_connected_more_slowly_than_its_budget_assumes_is_refused(
    link: str, assumed_mbps: float, is_refused: bool
) -> None:
    configuration, _ = configured_with_network("10.0.0", {"head_link_mbps": assumed_mbps})
    problem = head_link_problem(configuration, "SU00", {"frame": "", "link": link})
    assert (problem is not None) == is_refused
    if problem is not None:
        rate = link.partition(" ")[0]
        assert f"connected at {rate} Mbit/s" in problem
        assert f"assumes {assumed_mbps} Mbit/s" in problem
        assert f"network.head_link_mbps = {rate}" in problem
    assert head_link_problem(configuration, "SU00", {"port": "tcp://"}) is None
