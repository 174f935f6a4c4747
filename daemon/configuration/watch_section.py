"""The section `[watch]` of `service.toml`: who may watch and command, and what is shown."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, field_validator, model_validator

from daemon.configuration.section import ConfigurationSection, FilePath, Several

MAP_SUFFIXES: Final = (".mbtiles", ".pmtiles", ".tif", ".tiff")


class MavlinkCameraSection(ConfigurationSection):
    """The rig as one camera of a vehicle (docs/how-to/flight/mavlink-camera.md).

    `connect` is "udpout:HOST:PORT", the address of a ground station or autopilot, or
    "udpin:HOST:PORT". `commands` from others are executed when "signed" (with `signing_key`, a file
    of 64 hexadecimal digits), from "any", or from "none". `signing_state` is the file for
    the last timestamps of signed messages (default: in the folder of missions).
    """

    connect: str = "udpout:127.0.0.1:14550"
    """Address: `udpout:HOST:PORT` or `udpin:HOST:PORT`."""
    system_id: int = Field(default=1, ge=1, le=255)
    """MAVLink system, that of the vehicle."""
    component_id: int = Field(default=100, ge=100, le=105)
    """MAVLink component."""
    commands: Literal["signed", "any", "none"] = "none"
    """Whose commands are executed."""
    signing_key: FilePath | None = None
    """File with the signing key of 64 hexadecimal digits."""
    signing_state: FilePath | None = None
    """File of the last timestamps of signed messages; default: below the missions."""
    feedback: bool = False
    """Whether `CAMERA_FEEDBACK` is sent for autopilots."""

    @model_validator(mode="after")
    def _check_connection(self) -> MavlinkCameraSection:
        scheme, _, rest = self.connect.partition(":")
        host, _, port = rest.rpartition(":")
        is_valid_port = port.isdecimal() and 0 < int(port) < 65536
        if scheme not in ("udpin", "udpout") or not host or not is_valid_port:
            raise ValueError(
                f"connect is {self.connect!r}; write udpout:HOST:PORT or udpin:HOST:PORT"
            )
        if self.commands == "signed" and self.signing_key is None:
            raise ValueError("commands are 'signed' and signing_key is missing; give its file")
        return self


class WatchSection(ConfigurationSection):
    """Access for monitoring and commands (docs/how-to/flight/watching.md).

    Commands over the network require a token. At the Unix socket `control` members of
    `control_group` are operators, and members of `control_administrator_group` administrators.
    """

    host: str = "127.0.0.1"
    """Address on which page and API listen."""
    port: int = Field(default=8470, ge=0, le=65535)
    """TCP port of page and API; 0 takes any free port."""
    anonymous_read: bool = True
    """Whether reading requires no token. Commands always require one."""
    tokens: FilePath | None = None
    """File with the hashes of the tokens; without it there are no commands over the network."""
    tls_certificate: FilePath | None = None
    """Certificate of the server, PEM."""
    tls_key: FilePath | None = None
    """Private key of the certificate, PEM."""
    announce: bool = True
    """Whether the service is announced by mDNS."""
    udp: Several[str] = Field(default=(), max_length=8)
    """Receivers of telemetry datagrams, `HOST:PORT` each."""
    udp_bytes_per_s: float = Field(default=4000.0, ge=1000)
    """Highest rate of datagrams to each receiver."""
    mavlink: MavlinkCameraSection | None = None
    control: FilePath | None = None
    """Path of the Unix socket for commands on this computer."""
    control_group: str | None = None
    """Group whose members are operators; default: the group of the service."""
    control_administrator_group: str | None = None
    """Group whose members are administrators, in addition to root."""
    hosts: Several[str] = Field(default=(), max_length=16)
    """Names under which the page is served, in addition to the computer's own."""
    maps: Several[FilePath] = Field(default=(), max_length=16)
    """Base maps of the page: MBTiles, PMTiles and GeoTIFF files."""
    proxies: Several[str] = Field(default=(), max_length=8)
    """IP addresses of reverse proxies whose forwarding headers count."""

    @property
    def udp_addresses(self) -> dict[str, tuple[str, int]]:
        """Addresses of datagrams by their text in the configuration."""
        return {text: (text.rpartition(":")[0], int(text.rpartition(":")[2])) for text in self.udp}

    @model_validator(mode="after")
    def _check_udp(self) -> WatchSection:
        for text in self.udp:
            host, _, port = text.rpartition(":")
            if not host or not port.isdecimal() or not 0 < int(port) < 65536:
                raise ValueError(f"udp has {text!r}; write HOST:PORT")
        return self

    @field_validator("maps")
    @classmethod
    def _check_maps(cls, paths: tuple[Path, ...]) -> tuple[Path, ...]:
        for path in paths:
            if path.suffix.lower() not in MAP_SUFFIXES:
                raise ValueError(
                    f"maps has {path.name!r}; a base map ends in {', '.join(MAP_SUFFIXES)}"
                )
        return paths

    @field_validator("hosts")
    @classmethod
    def _check_hosts(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.\-]{0,251}[A-Za-z0-9])?", name):
                raise ValueError(f"hosts has {name!r}; write a host name without scheme and port")
        return names

    @field_validator("proxies")
    @classmethod
    def _check_proxies(cls, addresses: tuple[str, ...]) -> tuple[str, ...]:
        for address in addresses:
            try:
                ipaddress.ip_address(address)
            except ValueError:
                raise ValueError(f"proxies has {address!r}; write an IP address") from None
        return addresses

    @model_validator(mode="after")
    def _check_tls(self) -> WatchSection:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key belong together; give both or none")
        is_remote = not (self.host.startswith("127.") or self.host in ("::1", "localhost"))
        if is_remote and self.tokens is not None and self.tls_certificate is None:
            raise ValueError(
                f"host {self.host} is not on this machine, and tokens would be sent without "
                "encryption; give tls_certificate and tls_key, or no tokens (no commands)"
            )
        return self
