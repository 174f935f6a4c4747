"""Reads the interfaces of the heads, and gives each head its share of the link.

The computation is in `daemon.onboard.capture.link_budget`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from daemon.configuration.model import Configuration, HeadDeviceSection
from daemon.onboard.capture.link_budget import HeadDemand, Link, LinkPlan, plan_link
from daemon.onboard.capture.routes import network_heads, parse_routes, route_to
from daemon.onboard.preflight.check_results import CheckOutcome, CheckResult, failed, passed
from daemon.onboard.service.messages import DeviceSpec
from drivers.cameras.aravis.gvcp import is_ip_address
from processing.rig import Rig

INTERFACES: Final = Path("/sys/class/net")
ROUTES: Final = Path("/proc/net/route")
BYTES_PER_S_OF_MBPS: Final = 125_000
GIGE_DRIVER: Final = "aravis"
PACKET_SIZE_LIMIT: Final = 8192
"""Default of the driver's packet_size_limit."""
CHUNKS_NBYTES: Final = 256
"""Allowance for chunk data behind the pixels of a frame."""
BITS_PER_PIXEL: Final = {"8": 8, "10p": 10, "12p": 12, "10Packed": 12, "12Packed": 12}
"""By the end of the pixel format's name; all others take 16."""


@dataclass(frozen=True)
class Interface:
    """An interface as the kernel reports it; `rate_mbps` is None if it reports none."""

    name: str
    mtu: int
    rate_mbps: float | None


def read_interface(name: str) -> Interface:
    """MTU and rate of an interface; OSError: there is none."""
    folder = INTERFACES / name
    mtu = int((folder / "mtu").read_text("ascii"))
    try:
        rate = float((folder / "speed").read_text("ascii"))
    except (OSError, ValueError):
        rate = -1.0
    return Interface(name, mtu, rate if rate > 0 else None)


def link_plans(configuration: Configuration, rig: Rig) -> tuple[list[LinkPlan], list[str]]:
    """The budget of each interface with heads, and the interfaces whose rate is unknown."""
    by_interface = _heads_by_interface(configuration)
    interval_s = exposure_interval_s(configuration, rig)
    plans, unknown = [], []
    for name, heads in by_interface.items():
        try:
            interface = read_interface(name)
        except (OSError, ValueError):
            unknown.append(name)
            continue
        network = configuration.network
        rate_mbps = network.link_mbps.get(name, interface.rate_mbps)
        if rate_mbps is None:
            unknown.append(name)
            continue
        link = Link(
            name,
            rate_mbps * BYTES_PER_S_OF_MBPS,
            network.head_link_mbps * BYTES_PER_S_OF_MBPS,
            network.switch_buffer_bytes,
        )
        demands = [_demand(head, rig, interface.mtu) for head in heads]
        plans.append(plan_link(link, demands, interval_s))
    return plans, unknown


def paced_specs(
    specs: Sequence[DeviceSpec], configuration: Configuration, rig: Rig
) -> tuple[DeviceSpec, ...]:
    """The devices, with the pacing of every head that shares a link.

    What is configured for a head takes precedence.
    """
    if not configuration.network.is_paced:
        return tuple(specs)
    pacing = {
        share.demand.head: _settings(share, plan)
        for plan in link_plans(configuration, rig)[0]
        for share in plan.shares
        if share.packet_delay_s > 0 or share.transfer_delay_s > 0
    }
    return tuple(
        replace(spec, settings={**pacing[spec.name], **spec.settings})
        if spec.kind == "head" and spec.name in pacing
        else spec
        for spec in specs
    )


def link_budget(configuration: Configuration, rig: Rig) -> Iterator[CheckResult]:
    """One result for each interface that leads to heads; what cannot fit prevents a flight."""
    plans, unknown = link_plans(configuration, rig)
    yield from _uncounted(configuration)
    for name in unknown:
        yield CheckResult(
            "link",
            name,
            CheckOutcome.NOT_TRIED,
            f"the rate of {name} is unknown, so its heads are not paced; set network.link_mbps = "
            f"{{ {name} = 1000 }} to the rate of its link",
        )
    for plan in plans:
        name = plan.link.interface
        if plan.fits:
            yield passed("link", name, _fitting_sentence(plan))
        else:
            yield failed("link", name, refusal(plan), is_blocking=True)


def _uncounted(configuration: Configuration) -> Iterator[CheckResult]:
    """Heads that are configured by their name, and rates of interfaces without heads."""
    addresses = network_heads(configuration)
    for head in configuration.head:
        address = str(head.settings.get("address", ""))
        if head.driver == GIGE_DRIVER and not is_ip_address(address):
            yield CheckResult(
                "link",
                head.sensor,
                CheckOutcome.NOT_TRIED,
                f"head {head.sensor} is configured by its name {address!r} and not counted in a "
                "link budget; configure a GigE Vision head by its IP address",
            )
    reached = _heads_by_interface(configuration)
    for name in configuration.network.link_mbps:
        if addresses and name not in reached:
            yield failed(
                "link",
                name,
                f"network.link_mbps has {name}, and the route to no head leads there; heads are "
                f"reached by {', '.join(reached) or 'no interface'}",
            )


def refusal(plan: LinkPlan) -> str:
    """Why the heads of a link cannot send an exposure in time, with figures and the action."""
    interval = f"{plan.interval_s:g} s"
    amount = f"{plan.payload_nbytes / 1e6:.0f} MB"
    rate = f"{plan.link.rate_bytes_per_s / BYTES_PER_S_OF_MBPS:g} Mbit/s"
    heads = _heads(plan)
    if plan.needed_s <= plan.usable_s:
        return (
            f"{heads} of {plan.link.interface} fit {rate} only if they send at the same time, and "
            f"the buffer of the switch ({plan.link.buffer_nbytes} bytes) takes no packet of each; "
            "use a switch with a larger buffer and set network.switch_buffer_bytes, or spread the "
            "heads over more interfaces"
        )
    return (
        f"{amount} of {heads} take {plan.needed_s:.1f} s of {interval} on {plan.link.interface} "
        f"({rate}; {plan.usable_s:.2f} s are usable); spread the heads over more or faster "
        f"interfaces, use a packed pixel format, or expose every "
        f"{plan.needed_s * plan.interval_s / plan.usable_s:.1f} s"
    )


def plan_as_json(plan: LinkPlan) -> dict[str, Any]:
    """A budget as plain JSON types."""
    return {
        "interface": plan.link.interface,
        "rate_mbps": plan.link.rate_bytes_per_s / BYTES_PER_S_OF_MBPS,
        "interval_s": plan.interval_s,
        "payload_bytes": plan.payload_nbytes,
        "wire_bytes": plan.wire_nbytes,
        "needed_s": plan.needed_s,
        "usable_s": plan.usable_s,
        "fits": plan.fits,
        "transfer_s": plan.duration_s if plan.fits else None,
        "waves": plan.wave_count,
        "heads": [
            {
                "head": share.demand.head,
                "packet_size": share.demand.packet_size,
                "packets": share.demand.packet_count,
                "wire_bytes": share.demand.wire_nbytes,
                "rate_mbps": share.rate_bytes_per_s / BYTES_PER_S_OF_MBPS,
                "packet_delay_us": share.packet_delay_s * 1e6,
                "transfer_delay_us": share.transfer_delay_s * 1e6,
                "transfer_s": share.duration_s,
            }
            for share in plan.shares
        ],
    }


def head_link_problem(
    configuration: Configuration, head: str, found: Mapping[str, str]
) -> str | None:
    """A sentence if a head's own link is slower than its link budget assumes.

    Args:
        configuration: the service's configuration.
        head: name of the head.
        found: what its driver reports; `link` is the rate that the head reports, such as
            "100 Mbit/s".
    """
    reported, _, unit = found.get("link", "").partition(" ")
    assumed_mbps = configuration.network.head_link_mbps
    if unit != "Mbit/s" or float(reported) >= assumed_mbps:
        return None
    return (
        f"head {head} is connected at {reported} Mbit/s, and its link budget assumes "
        f"{assumed_mbps:g} Mbit/s; check its cable and the port of the switch, or set "
        f"network.head_link_mbps = {reported}"
    )


def _fitting_sentence(plan: LinkPlan) -> str:
    rate = plan.link.rate_bytes_per_s / BYTES_PER_S_OF_MBPS
    return (
        f"{plan.payload_nbytes / 1e6:.0f} MB of {_heads(plan)} take {plan.needed_s:.2f} s of "
        f"{plan.interval_s:g} s at {rate:g} Mbit/s"
    )


def _heads(plan: LinkPlan) -> str:
    count = len(plan.demands)
    return f"{count} heads" if count > 1 else f"head {plan.demands[0].head}"


def _settings(share: Any, plan: LinkPlan) -> Mapping[str, float]:
    own_link = plan.link.head_rate_bytes_per_s / BYTES_PER_S_OF_MBPS
    settings = {
        "stream_rate_mbps": share.rate_bytes_per_s / BYTES_PER_S_OF_MBPS,
        "head_link_mbps": own_link if share.is_gap_exact else 0.0,
    }
    if share.transfer_delay_s > 0:
        settings["transfer_delay_us"] = share.transfer_delay_s * 1e6
    return settings


def _heads_by_interface(configuration: Configuration) -> dict[str, list[HeadDeviceSection]]:
    addresses = network_heads(configuration)
    if not addresses:
        return {}
    try:
        table = parse_routes(ROUTES.read_text("ascii"))
    except OSError:
        return {}
    found: dict[str, list[HeadDeviceSection]] = {}
    for head in configuration.head:
        if head.driver != GIGE_DRIVER or head.sensor not in addresses:
            continue
        route = route_to(addresses[head.sensor], table)
        if route is not None:
            found.setdefault(route.interface, []).append(head)
    return found


def _demand(head: HeadDeviceSection, rig: Rig, mtu: int) -> HeadDemand:
    """What the head sends; the driver's settings decide on format and packets."""
    sensor, settings = rig.sensor(head.sensor), head.settings
    pixel_format = str(settings.get("pixel_format", ""))
    bits = next((b for end, b in BITS_PER_PIXEL.items() if pixel_format.endswith(end)), 16)
    pixels = sensor.width_px * sensor.height_px
    largest = int(settings.get("packet_size_limit", PACKET_SIZE_LIMIT))
    packet_size = int(settings.get("packet_size", 0)) or min(largest, mtu)
    return HeadDemand(head.sensor, -(-pixels * bits // 8) + CHUNKS_NBYTES, packet_size)


def exposure_interval_s(configuration: Configuration, rig: Rig) -> float:
    """The shortest time between exposures that the trigger asks for, at the planned speed."""
    trigger = configuration.trigger
    interval_s = trigger.interval_s
    if trigger.distance_m is not None:
        interval_s = trigger.distance_m / configuration.plan.ground_speed_mps
    return max(interval_s, rig.frame_interval_s)
