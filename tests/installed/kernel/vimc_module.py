"""The kernel's vimc driver, built from Debian's sources for the kernel of the virtual machine.

Debian's kernel does not contain it. Packages are downloaded and unpacked, not installed; only the
sources of the driver are taken out of the archive of the kernel.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Final

DRIVER: Final = "drivers/media/test-drivers/vimc"
DOWNLOAD_LIMIT_S: Final = 900
BUILD_LIMIT_S: Final = 600


class ModuleBuildError(Exception):
    """The module cannot be built here; the sentence names what would help."""


def build_vimc(place: Path, kernel: str) -> Path:
    """Build `vimc.ko` without debugging information.

    Args:
        place: an empty folder; 250 MB are needed.
        kernel: name of the package of the kernel, such as `linux-image-6.1.0-56-amd64`.

    Raises:
        ModuleBuildError: a compiler or a package is missing, or it does not compile.
    """
    release = kernel.removeprefix("linux-image-")
    found = re.match(r"(\d+\.\d+)", release)
    if found is None:
        raise ModuleBuildError(f"{kernel} is no package of a Debian kernel")
    version = found[1]
    missing = [program for program in ("make", "gcc", "xz", "strip") if not shutil.which(program)]
    if missing:
        raise ModuleBuildError(f"install {', '.join(missing)}")
    own = f"linux-headers-{release}"
    try:
        common, kbuild = (_dependency(own, prefix) for prefix in ("linux-headers-", "linux-kbuild"))
    except (subprocess.SubprocessError, OSError, StopIteration) as error:
        raise ModuleBuildError(f"apt knows no {own} ({error}); run apt-get update") from error
    packages = [own, common, kbuild, f"linux-source-{version}"]
    # apt drops its rights to download, and the folder has to let that user in.
    place.chmod(0o755)
    try:
        _run(["apt-get", "download", "-q", "-o", "APT::Sandbox::User=root", *packages], place)
        for package in place.glob("*.deb"):
            _run(["dpkg-deb", "-x", package.name, "."], place)
        sources = place / f"usr/src/linux-source-{version}.tar.xz"
        folder = f"linux-source-{version}/{DRIVER}"
        _run(["tar", "-xJf", str(sources), "--wildcards", f"{folder}/*"], place)
        headers = place / "usr/src" / own
        (headers / "Makefile").write_text(f"include {place}/usr/src/{common}/Makefile\n")
        module = place / folder / "vimc.ko"
        _run(
            [
                *("make", "-C", str(headers), f"M={module.parent}"),
                *("CONFIG_VIDEO_VIMC=m", "modules"),
            ],
            place,
        )
        _run(["strip", "--strip-debug", str(module)], place)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired, OSError) as error:
        raise ModuleBuildError(f"vimc cannot be built for {release} ({error})") from error
    return module


def _dependency(package: str, prefix: str) -> str:
    listed = subprocess.run(
        ["apt-cache", "depends", package], capture_output=True, text=True, timeout=60, check=True
    ).stdout
    names = (line.split()[1] for line in listed.splitlines() if "Depends: " in line)
    return next(name for name in names if name.startswith(prefix))


def _run(command: list[str], place: Path) -> None:
    limit_s = DOWNLOAD_LIMIT_S if command[0] == "apt-get" else BUILD_LIMIT_S
    subprocess.run(command, cwd=place, timeout=limit_s, check=True)
