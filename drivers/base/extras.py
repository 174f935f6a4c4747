"""Optional libraries: their purpose, their presence, and the command that installs them.

The names are those of `[project.optional-dependencies]`. The checks import no library,
except that the check for Aravis imports GObject introspection.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.contract import DeviceError


@dataclass(frozen=True)
class OptionalDependency:
    """An optional dependency: its purpose, its modules, and its Debian packages."""

    purpose: str
    modules: tuple[str, ...]
    packages: str = ""


EXTRAS: Final[Mapping[str, OptionalDependency]] = {
    "aravis": OptionalDependency(
        "GigE Vision and USB3 Vision heads need Aravis",
        ("gi",),
        "gir1.2-aravis-0.8 libgirepository1.0-dev",
    ),
    "geotiff": OptionalDependency("GeoTIFF files need rasterio", ("rasterio",)),
    "catalog": OptionalDependency(
        "tables of missions need geopandas and pyarrow", ("geopandas", "pyarrow")
    ),
    "stores": OptionalDependency("object stores need obstore", ("obstore",)),
    "cluster": OptionalDependency("clusters need dask.distributed", ("distributed",)),
    "plots": OptionalDependency("plots of reports need matplotlib", ("matplotlib",)),
    "colmap": OptionalDependency("COLMAP's database needs pycolmap", ("pycolmap",)),
    "mavlink": OptionalDependency("MAVLink needs pymavlink", ("pymavlink",)),
    "watch": OptionalDependency(
        "the page, the API and telemetry need the packages of [watch]",
        ("fastapi", "uvicorn", "websockets", "msgpack", "zeroconf", "ifaddr", "prometheus_client"),
    ),
}


class MissingExtraError(DeviceError):
    """A library is not installed; the message contains the command that installs it."""


def require(*names: str) -> None:
    """Make sure that optional libraries can be loaded.

    Args:
        names: keys of EXTRAS.

    Raises:
        MissingExtraError: one cannot; the message contains the command that installs it.
    """
    for name in names:
        for module in EXTRAS[name].modules:
            if not _is_there(module):
                raise missing(name, f"no module {module}")
        if name == "aravis":
            _require_typelib()


def missing(name: str, reason: object) -> MissingExtraError:
    """The error for an extra that cannot be loaded.

    Args:
        name: key of EXTRAS.
        reason: what failed, for the message.

    Returns:
        The error; its message has the purpose of the extra and the command that installs it.
    """
    extra = EXTRAS[name]
    sentence = f"{extra.purpose}, which cannot be loaded ({reason})"
    if extra.modules[1:]:
        sentence = f"{extra.purpose}, which cannot all be loaded ({reason})"
    system = f" and the system library: sudo apt install {extra.packages}" if extra.packages else ""
    return MissingExtraError(f"{sentence}. Run: pip install 'syntopic[{name}]'{system}")


def missing_module(error: ImportError) -> MissingExtraError | None:
    """The error for an import that failed.

    Args:
        error: the error of the import statement.

    Returns:
        As `missing`; None if the module belongs to no extra.
    """
    module = (error.name or "").partition(".")[0]
    for name, extra in EXTRAS.items():
        if module in (*extra.modules, "starlette" if name == "watch" else ""):
            return missing(name, error)
    return None


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def _require_typelib() -> None:
    """Check for Aravis, a system library that is described by a typelib file."""
    try:
        importlib.import_module("gi").require_version("Aravis", "0.8")
    except (ImportError, ValueError) as error:
        raise missing("aravis", error) from error
