"""Each condition of the network that keeps packets from a computer, made to occur.

Computer and heads are network namespaces of this kernel; what passes is decided by the kernel.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator

import pytest

from tests.support.head_network import HeadNetwork, head_network

pytestmark = pytest.mark.timeout(120)

HEAD = {"address": "10.77.0.2"}
SMALL_BUFFER = {"socket_buffer_bytes": 65536}


@pytest.fixture
def network() -> Iterator[HeadNetwork]:
    with head_network() as made:
        yield made


def test_a_head_in_order_passes_with_its_packet_size(network: HeadNetwork) -> None:
    network.serve(HEAD)
    found = network.diagnose({**HEAD, **SMALL_BUFFER})
    assert {item["outcome"] for item in found.values()} == {"pass"}
    assert found["path of SU00"]["sentence"] == ""
    assert found["path of SU00"]["found"] == {"packet_size": "1500"}
    assert "kernel drops" in found


def test_packets_beyond_the_mtu_of_the_path_are_found_by_test_packets() -> None:
    with head_network(mtu=9000) as network:
        # The computer's interface takes 9,000 bytes; the head's way out takes 4,000.
        network.ip(network.heads, "link", "set", "eth1", "mtu", "4000")
        network.serve(HEAD)
        given = network.diagnose({**HEAD, "packet_size": 8192})["path of SU00"]
        negotiated = network.diagnose(HEAD)["path of SU00"]
    assert given["outcome"] == "fail"
    assert "packets of 8192 bytes of head SU00 do not arrive, those of 4000 do" in given["sentence"]
    assert given["sentence"].endswith("jumbo frames), or packet_size = 4000")
    assert negotiated["outcome"] == "pass"
    assert negotiated["sentence"].startswith("caution: packets of 8192 bytes")


def test_packets_beyond_the_mtu_of_the_computer_name_its_interface(network: HeadNetwork) -> None:
    network.ip(network.heads, "link", "set", "eth1", "mtu", "9000")
    network.serve(HEAD)
    found = network.diagnose({**HEAD, "packet_size": 8192})["path of SU00"]
    assert found["outcome"] == "fail"
    assert "(MTU of eth1: 1500); run: sudo ip link set eth1 mtu 8192" in found["sentence"]


def test_a_firewall_that_lets_control_through_differs_from_a_silent_head(
    network: HeadNetwork,
) -> None:
    network.serve(HEAD)
    # Rules of routing in place of a packet filter: port 3956 passes, every other one is dropped.
    rule = ("rule", "add", "pref", "10", "iif", "eth1", "ipproto", "udp")
    for ports in ("1-3955", "3957-65534"):
        network.ip(network.computer, *rule, "sport", ports, "blackhole")
    network.ip(network.computer, "rule", "add", "pref", "20", "lookup", "local")
    network.ip(network.computer, "rule", "delete", "pref", "0")
    found = network.diagnose(HEAD)["path of SU00"]
    assert found["outcome"] == "fail"
    assert (
        "head SU00 answers at 10.77.0.2, and none of its test packets arrives" in found["sentence"]
    )
    assert "sudo nft insert rule inet filter input ip saddr 10.77.0.2" in found["sentence"]


def test_the_reverse_path_filter_is_found_by_its_own_counter(network: HeadNetwork) -> None:
    network.link("eth2", "10.78.0.1/24", "10.78.0.2/24")
    network.serve({**HEAD, "interface": ""})
    # The route to the head leads to eth2, and its answers arrive on eth1.
    network.ip(network.computer, "route", "add", "10.77.0.2/32", "dev", "eth2")
    network.ip(network.heads, "route", "add", "10.78.0.1/32", "dev", "eth1")
    mac = network.at_computer("cat", "/sys/class/net/eth1/address").stdout.strip()
    network.ip(network.heads, "neigh", "add", "10.78.0.1", "lladdr", mac, "dev", "eth1")
    network.sysctl(network.computer, "net.ipv4.conf.all.rp_filter", 1)
    found = network.diagnose(HEAD)["path of SU00"]
    assert found["outcome"] == "fail"
    assert "reverse-path filter of the kernel dropped" in found["sentence"]
    assert "net.ipv4.conf.all.rp_filter=2" in found["sentence"]


def test_a_head_on_another_interface_than_its_route(network: HeadNetwork) -> None:
    network.link("eth2", "10.77.1.1/24", "10.77.1.2/24")
    network.serve({"address": "10.77.1.2", "interface": "eth2"})
    network.ip(network.computer, "route", "add", "10.77.1.2/32", "dev", "eth1")
    network.sysctl(network.heads, "net.ipv4.conf.all.arp_ignore", 1)
    found = network.diagnose({"address": "10.77.1.2"})["path of SU00"]
    assert found["outcome"] == "fail"
    assert "is connected to eth2" in found["sentence"]
    assert "sudo ip route add 10.77.1.2/32 dev eth2" in found["sentence"]


def test_two_interfaces_in_one_subnet(network: HeadNetwork) -> None:
    network.link("eth2", "10.77.0.200/24")
    network.serve(HEAD)
    found = network.diagnose(HEAD)["eth1 and eth2"]
    assert found["outcome"] == "fail"
    assert "both in 10.77.0.0/24" in found["sentence"]


def test_a_limit_of_receive_buffers_below_those_of_the_streams(network: HeadNetwork) -> None:
    network.serve(HEAD)
    asked = {**HEAD, "socket_buffer_bytes": 1 << 30}
    found = network.diagnose(asked)["receive buffers"]
    assert found["outcome"] == "fail"
    assert "a stream asks for 1073741824" in found["sentence"]
    assert "sudo sysctl -w net.core.rmem_max=1073741824" in found["sentence"]


def test_a_silent_head_is_looked_for_and_reported_as_silent(network: HeadNetwork) -> None:
    found = network.diagnose(HEAD)["path of SU00"]
    assert found["outcome"] == "fail"
    assert (
        "nothing answers at 10.77.0.2, and no broadcast finds head SU00 on eth1"
        in found["sentence"]
    )


@pytest.mark.parametrize("rp_filter", [0, 1])
def test_a_head_in_another_subnet_is_found_and_moved_by_the_command_of_the_check(
    rp_filter: int,
) -> None:
    with head_network(heads="192.168.5.7/24") as network:
        network.sysctl(network.computer, "net.ipv4.conf.all.rp_filter", rp_filter)
        network.serve(
            {"address": "192.168.5.7", "serial": "S-9"},
        )
        wanted = {"address": "10.77.0.9", "serial": "S-9"}
        sentence = network.diagnose(wanted)["path of SU00"]["sentence"]
        assert "on eth1 has the address 192.168.5.7, outside of the subnet 10.77.0.0/24" in sentence
        command = sentence.rpartition("run: sudo syntopic ")[2].split()
        assert command[0] == "force-ip"
        assert command[3:] == ["10.77.0.9", "--mask", "255.255.255.0"]
        ended = network.at_computer(sys.executable, "-m", "daemon", *command, "--json")
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert json.loads(ended.stdout)["address"] == "10.77.0.9"
        after = network.diagnose({**wanted, **SMALL_BUFFER})
    assert after["path of SU00"]["outcome"] == "pass"


def test_aravis_own_discovery_finds_the_emulated_head_on_its_interface(
    network: HeadNetwork,
) -> None:
    arv_tool = shutil.which("arv-tool-0.8")
    if arv_tool is None:
        pytest.skip("arv-tool-0.8 is absent; install Debian's aravis-tools-cli")
    network.serve({**HEAD, "serial": "S-9"})
    assert network.at_computer(arv_tool).stdout == "Peer-Emulated-S-9 (10.77.0.2)\n"


def test_a_controlled_head_keeps_its_address_and_the_command_reports_it(
    network: HeadNetwork,
) -> None:
    network.serve(HEAD)
    held = """
import sys
from drivers.cameras.aravis.broadcast_discovery import discover, force_address
from drivers.cameras.aravis.gvcp_channel import GvcpChannel
from drivers.contract import DeviceError
(head,) = discover("eth1")
with GvcpChannel(head.address):
    try:
        force_address("eth1", head.mac, "10.77.0.77", "255.255.255.0")
    except DeviceError as error:
        print(error)
"""
    ended = network.at_computer(sys.executable, "-c", held)
    assert "keeps its address 10.77.0.2; end the program that controls it" in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("eth1", "00:11", "10.77.0.9"), "is no MAC address"),
        (("eth1", "00:11:22:33:44:55", "10.77.0.0"), "is no address of a host"),
        (("eth1", "00:11:22:33:44:55", "10.77.0.999"), "give an IPv4 address"),
        (("eth7", "00:11:22:33:44:55", "10.77.0.9"), "interface eth7 cannot be used"),
        (("eth1", "00:11:22:33:44:55", "10.77.0.9"), "no head with MAC address"),
    ],
)
def test_what_force_ip_refuses(
    network: HeadNetwork, arguments: tuple[str, ...], sentence: str
) -> None:
    ended = network.at_computer(sys.executable, "-m", "daemon", "force-ip", *arguments)
    assert ended.returncode == 1
    assert sentence in " ".join(ended.stderr.split())
