"""Why packets of GigE Vision heads do not arrive: each condition with its cure.

Heads are opened for a moment, so `syntopic check` runs this before it opens the devices. Nothing
found here prevents a flight. The budget of the links is in `daemon.onboard.capture.link_settings`.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from daemon.configuration.model import Configuration, HeadDeviceSection
from daemon.onboard.capture.link_settings import (
    GIGE_DRIVER,
    PACKET_SIZE_LIMIT,
    ROUTES,
    read_interface,
)
from daemon.onboard.capture.routes import network_heads, parse_routes, route_to
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed
from daemon.onboard.preflight.kernel_counters import KernelCounters, counter_problems, read_counters
from daemon.onboard.preflight.local_interfaces import (
    LocalInterface,
    has_strict_filter,
    local_interfaces,
    shared_subnets,
)
from drivers.cameras.aravis.broadcast_discovery import BroadcastHead, discover
from drivers.cameras.aravis.path_probe import PathProbe, PathState, probe_path
from drivers.contract import DeviceError
from processing.rig import Rig

RECEIVE_BUFFER_LIMIT: Final = Path("/proc/sys/net/core/rmem_max")
CORES: Final = Path("/sys/devices/system/cpu")
SOCKET_BUFFER_NBYTES: Final = 33_554_432
"""Default of the driver's socket_buffer_bytes."""
SLOW_GOVERNORS: Final = frozenset({"powersave", "ondemand", "conservative"})
NAMED_MAX: Final = 3


def network_diagnosis(configuration: Configuration, _rig: Rig) -> Iterator[CheckResult]:
    """One result for each condition, and one for the path of each head."""
    addresses = network_heads(configuration)
    heads = _gige_heads(configuration)
    if not heads:
        return
    yield receive_buffers(heads)
    yield governor()
    interfaces = local_interfaces()
    yield from subnets(interfaces)
    before = read_counters()
    missing: list[HeadDeviceSection] = []
    for head in heads:
        result = _path(head, addresses[head.sensor], missing)
        if result is not None:
            yield result
    if missing:
        yield from _missing_heads(missing, addresses, interfaces, before)


def kernel_results(configuration: Configuration, before: KernelCounters) -> list[CheckResult]:
    """What the kernel dropped since `before`, if there are heads on a network."""
    if not _gige_heads(configuration):
        return []
    after = read_counters()
    problems = list(counter_problems(before, after))
    if problems:
        return [failed("machine", name, sentence) for name, sentence in problems]
    return [passed("machine", "kernel drops", dropped_since_start=str(after.backlog_drops))]


def receive_buffers(heads: Sequence[HeadDeviceSection]) -> CheckResult:
    """The kernel's limit of receive buffers against the buffers of the streams."""
    wanted = max(int(h.settings.get("socket_buffer_bytes", SOCKET_BUFFER_NBYTES)) for h in heads)
    try:
        granted = int(RECEIVE_BUFFER_LIMIT.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return CheckResult(
            "machine",
            "receive buffers",
            CheckOutcome.NOT_TRIED,
            f"{RECEIVE_BUFFER_LIMIT} cannot be read; run the check outside of the container",
        )
    if granted >= wanted:
        return passed("machine", "receive buffers", bytes=str(granted))
    return failed(
        "machine",
        "receive buffers",
        f"net.core.rmem_max is {granted} bytes and a stream asks for {wanted}, so packets are lost "
        f"while the receiver is busy; run: sudo sysctl -w net.core.rmem_max={wanted}",
    )


def governor(cores: Path = CORES) -> CheckResult:
    """The frequency governors of the cores."""
    files = sorted(cores.glob("cpu[0-9]*/cpufreq/scaling_governor"))
    if not files:
        sentence = "the kernel does not scale the frequency of the cores; nothing to do"
        return CheckResult("machine", "frequency", CheckOutcome.PASS, sentence)
    found = {file.parent.parent.name: file.read_text(encoding="ascii").strip() for file in files}
    slow = sorted(core for core, name in found.items() if name in SLOW_GOVERNORS)
    if not slow:
        return passed("machine", "frequency", governor=", ".join(sorted(set(found.values()))))
    names = ", ".join(sorted({found[core] for core in slow}))
    return failed(
        "machine",
        "frequency",
        f"the frequency governor of {len(slow)} cores is {names}, so that bursts of packets meet "
        "slow cores; run: sudo cpupower frequency-set -g performance",
    )


def subnets(interfaces: Sequence[LocalInterface]) -> Iterator[CheckResult]:
    """Interfaces that share a subnet: packets to a head leave by one of them only."""
    for one, other, network in shared_subnets(interfaces):
        yield failed(
            "network",
            f"{one} and {other}",
            f"{one} and {other} are both in {network}, so packets to a head at {other} leave by "
            f"{one}; give each interface a subnet of its own, and its heads addresses of it",
        )


def _gige_heads(configuration: Configuration) -> list[HeadDeviceSection]:
    addresses = network_heads(configuration)
    return [h for h in configuration.head if h.driver == GIGE_DRIVER and h.sensor in addresses]


def _path(
    head: HeadDeviceSection, address: ipaddress.IPv4Address, missing: list[HeadDeviceSection]
) -> CheckResult | None:
    """The path of a head that answers; one that does not is added to `missing`."""
    route = _interface_of(address)
    try:
        mtu = read_interface(route).mtu if route else 0
    except (OSError, ValueError):
        mtu = 0
    settings = head.settings
    given = int(settings.get("packet_size", 0))
    limit = int(settings.get("packet_size_limit", PACKET_SIZE_LIMIT))
    wanted = given or (min(limit, mtu) if mtu else limit)
    filtered = read_counters().reverse_path_drops
    probe = probe_path(str(address), wanted)
    filtered = read_counters().reverse_path_drops - filtered
    name = f"path of {head.sensor}"
    if probe.state is PathState.BUSY:
        sentence = f"another program controls head {head.sensor}; end it and check again"
        return CheckResult("network", name, CheckOutcome.NOT_TRIED, sentence)
    if filtered > 0:
        return failed("network", name, _filter_sentence(head.sensor, route, filtered))
    if probe.state is PathState.NO_CONTROL:
        missing.append(head)
        return None
    if probe.state is PathState.NO_STREAM:
        return failed(
            "network",
            name,
            f"head {head.sensor} answers at {address}, and none of its test packets arrives: a "
            "firewall of this computer or of the network drops the stream; allow UDP from "
            f"{address}, for example: sudo nft insert rule inet filter input ip saddr {address} "
            "udp sport 1-65535 accept",
        )
    return _packet_size_result(head.sensor, name, route, mtu, probe, is_given=bool(given))


def _packet_size_result(
    sensor: str, name: str, route: str, mtu: int, probe: PathProbe, *, is_given: bool
) -> CheckResult:
    if probe.largest >= probe.wanted:
        return passed("network", name, packet_size=str(probe.largest))
    if is_given and probe.wanted > mtu:
        cure = f"run: sudo ip link set {route} mtu {probe.wanted}, or set packet_size = "
    else:
        cure = (
            f"set the MTU of the switch and of the head to at least {probe.wanted} (jumbo frames), "
            "or packet_size = "
        )
    sentence = (
        f"packets of {probe.wanted} bytes of head {sensor} do not arrive, those of "
        f"{probe.largest} do (MTU of {route}: {mtu}); {cure}{probe.largest}"
    )
    if is_given:
        return failed("network", name, sentence)
    return passed("network", name, f"caution: {sentence}", packet_size=str(probe.largest))


def _filter_sentence(sensor: str, route: str, count: int) -> str:
    return (
        f"the reverse-path filter of the kernel dropped {count} packets while head {sensor} was "
        "asked, since the route to their sender leads to another interface; connect the head to "
        f"{route or 'the interface of its subnet'}, or run: sudo sysctl -w "
        "net.ipv4.conf.all.rp_filter=2"
    )


def _missing_heads(
    missing: Sequence[HeadDeviceSection],
    addresses: Mapping[str, ipaddress.IPv4Address],
    interfaces: Sequence[LocalInterface],
    before: KernelCounters,
) -> Iterator[CheckResult]:
    """Heads that do not answer: looked for by broadcast on every interface."""
    found: list[BroadcastHead] = []
    for interface in interfaces:
        try:
            found += discover(interface.name)
        except DeviceError:
            continue
    filtered = read_counters().reverse_path_drops - before.reverse_path_drops
    by_interface = {interface.name: interface for interface in interfaces}
    configured = {str(address) for address in addresses.values()}
    for head in missing:
        name = f"path of {head.sensor}"
        address = str(addresses[head.sensor])
        route = _interface_of(addresses[head.sensor])
        same = [other for other in found if other.address == address]
        unexpected = [
            other for other in found if other.address not in configured and _is_wanted(head, other)
        ]
        if same:
            yield failed("network", name, _wrong_interface(head.sensor, same[0], route))
        elif unexpected:
            other = unexpected[0]
            yield failed("network", name, _other_subnet(head.sensor, address, other, by_interface))
        elif filtered > 0:
            yield failed("network", name, _filter_sentence(head.sensor, route, filtered))
        else:
            yield failed(
                "network",
                name,
                f"nothing answers at {address}, and no broadcast finds head {head.sensor} on "
                f"{_listed([i.name for i in interfaces])}; check its power and cable",
            )


def _is_wanted(head: HeadDeviceSection, other: BroadcastHead) -> bool:
    serial = str(head.settings.get("serial", ""))
    return not serial or serial == other.serial


def _wrong_interface(sensor: str, head: BroadcastHead, route: str) -> str:
    strict = (
        " (its reverse-path filter is strict, too)" if has_strict_filter(head.interface) else ""
    )
    return (
        f"head {sensor} ({head.address}) is connected to {head.interface}{strict}, and the route "
        f"to it leads to {route or 'no interface'}; connect it there, or run: sudo ip route add "
        f"{head.address}/32 dev {head.interface}"
    )


def _other_subnet(
    sensor: str, address: str, head: BroadcastHead, interfaces: Mapping[str, LocalInterface]
) -> str:
    local = interfaces[head.interface].address
    identity = f"{head.model} {head.serial}".strip()
    if ipaddress.IPv4Address(address) in local.network:
        mask = local.network.netmask
        command = f"sudo syntopic force-ip {head.interface} {head.mac} {address} --mask {mask}"
    else:
        command = (
            f"sudo ip address add {ipaddress.IPv4Address(address) + 1}/24 dev {head.interface}; "
            f"sudo syntopic force-ip {head.interface} {head.mac} {address}"
        )
    where = "outside of" if ipaddress.IPv4Address(head.address) not in local.network else "in"
    return (
        f"nothing answers at {address}; the head {identity} with MAC address {head.mac} on "
        f"{head.interface} has the address {head.address}, {where} the subnet {local.network} of "
        f"this computer; if it is {sensor}, run: {command}"
    )


def _interface_of(address: ipaddress.IPv4Address) -> str:
    try:
        route = route_to(address, parse_routes(ROUTES.read_text("ascii")))
    except OSError:
        return ""
    return "" if route is None else route.interface


def _listed(names: Sequence[str]) -> str:
    shown: list[Any] = list(names[:NAMED_MAX])
    if len(names) > NAMED_MAX:
        shown.append(f"{len(names) - NAMED_MAX} more")
    return ", ".join(shown) or "any interface"
