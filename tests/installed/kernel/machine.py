"""`python -m tests.installed.kernel.machine`: the tests of this folder inside a virtual machine.

The machine runs Debian's own kernel, whose vivid driver emulates capture devices and their faults,
and has a parallel port, which takes pulses per second; build machines seldom have these. The vimc
driver, a sensor with its pipeline, is built for that kernel. Its root
file system is this host's, read-only.
"""

from __future__ import annotations

import argparse
import hashlib
import lzma
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from tests.installed.kernel.vimc_module import ModuleBuildError, build_vimc

HERE: Final = Path(__file__).parent
REPOSITORY: Final = HERE.parents[2]
PROGRAMS: Final = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "depmod": "kmod",
    "modprobe": "kmod",
    "v4l2-ctl": "v4l-utils",
    "apt-get": "apt",
    "dpkg-deb": "dpkg",
}
"""What is needed, and the Debian package that has it."""
METAPACKAGE: Final = "linux-image-amd64"
BOOT_MODULES: Final = ("virtio_pci", "9pnet_virtio", "9p")
TESTED_MODULES: Final = ("vivid", "parport_pc", "pps_parport")
"""The tests load and unload them as they need it."""
MEMORY_MIB: Final = 1536
LIMIT_S: Final = 600
DOWNLOAD_LIMIT_S: Final = 900
XZ_MAGIC: Final = b"\xfd7zXZ\x00"
ELF_MAGIC: Final = b"\x7fELF"
NO_STATUS: Final = 125
KERNEL_ARGUMENTS: Final = (
    "console=ttyS0 quiet loglevel=4 panic=-1 tsc=reliable no_timer_check mitigations=off "
    "random.trust_cpu=on nokaslr audit=0 security=none cryptomgr.notests"
)


class CannotRunError(Exception):
    """The machine cannot be had here; the sentence names what would help."""


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.installed.kernel.machine", description=__doc__
    )
    parser.add_argument("--required", action="store_true", help="fail where it cannot run")
    parser.add_argument(
        "--kvm",
        action="store_true",
        help="use KVM where it can be had: faster, but where KVM is itself virtual it may not boot",
    )
    parser.add_argument(
        "--module",
        type=Path,
        action="append",
        default=[],
        help="a further kernel module that the tests may load",
    )
    parser.add_argument("--command", help="a shell command to run instead of pytest")
    parser.add_argument("pytest", nargs="*", help="arguments for pytest, after --")
    options = parser.parse_args()
    try:
        image = prepare()
    except CannotRunError as error:
        print(f"SKIPPED: the tests against the kernel need a virtual machine: {error}")
        sys.exit(1 if options.required else 0)
    # No plugins but the one that is needed: every file is read by an emulated processor.
    python = [str(REPOSITORY / ".venv/bin/python"), "-m", "pytest", "-p", "pytest_timeout"]
    python += ["-p", "no:cacheprovider", "--color=no"]
    chosen = options.pytest or ["-v", "--durations=5", "tests/installed/kernel"]
    command = options.command or shlex.join([*python, *chosen])
    started = time.monotonic()
    status = run(image, command, with_kvm=options.kvm, modules=options.module)
    print(f"virtual machine: {time.monotonic() - started:.0f} s, exit status {status}")
    sys.exit(status)


def run(image: Path, command: str, *, with_kvm: bool = False, modules: Sequence[Path] = ()) -> int:
    """Run a shell command as root of the machine, its output on ours; its exit status.

    `NO_STATUS` if the machine ended, or had to be ended, without reporting one.
    """
    has_kvm = with_kvm and os.access("/dev/kvm", os.R_OK | os.W_OK)
    with tempfile.TemporaryDirectory(prefix="kernel-machine-") as name:
        out = Path(name)
        copies = "".join(
            f"cp {shlex.quote(str(module.resolve()))} /dev/kernel-guest/modules/\n"
            for module in modules
        )
        (out / "command.sh").write_text(_script(copies + command), encoding="utf-8")
        qemu = [
            *("qemu-system-x86_64", "-nodefaults", "-no-user-config", "-no-reboot"),
            *("-display", "none", "-serial", "stdio", "-machine", "q35", "-cpu", "max"),
            *(("-accel", "kvm") if has_kvm else ()),
            *("-accel", "tcg", "-smp", "2", "-m", str(MEMORY_MIB)),
            *("-kernel", str(image / "kernel"), "-initrd", str(image / "initrd.cpio")),
            *("-append", KERNEL_ARGUMENTS),
            *("-virtfs", _share("/", "host") + ",readonly=on,multidevs=remap"),
            *("-virtfs", _share(name, "out")),
            *("-chardev", "null,id=nobody", "-device", "isa-parallel,chardev=nobody"),
        ]
        try:
            subprocess.run(qemu, stdin=subprocess.DEVNULL, timeout=LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            print(f"the virtual machine was ended after {LIMIT_S} s")
        try:
            return int((out / "status").read_text(encoding="ascii"))
        except (OSError, ValueError):
            return NO_STATUS


def _share(path: str, tag: str) -> str:
    return f"local,path={path},mount_tag={tag},security_model=none"


def _script(command: str) -> str:
    parameters = {
        "HOME": "/dev/kernel-guest/tmp",
        "TMPDIR": "/dev/kernel-guest/tmp",
        "PATH": "/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "KERNEL_GUEST": "/dev/kernel-guest",
        "COLUMNS": "100",
    }
    exports = "".join(f"export {name}={value}\n" for name, value in parameters.items())
    return f"{exports}cd {shlex.quote(str(REPOSITORY))}\n{command}\n"


# The image


def prepare() -> Path:
    """The folder with `kernel` and `initrd.cpio`, made and kept where it is not there yet.

    Raises:
        CannotRunError: something is missing here.
    """
    if platform.machine() != "x86_64":
        raise CannotRunError(f"this is a {platform.machine()}, and only x86_64 is provided for")
    missing = sorted({package for program, package in PROGRAMS.items() if not _which(program)})
    busybox = _which("busybox")
    if busybox is not None and b"/ld-" in Path(busybox).read_bytes()[:4096]:
        # Needs libraries, and there are none before the root file system is mounted.
        missing.append("busybox-static")
    if missing:
        raise CannotRunError(f"install Debian's {' '.join(missing)}")
    kernel = _kernel_package()
    texts = (Path(__file__), HERE / "guest.sh", HERE / "vimc_module.py")
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in texts))
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    image = cache / "syntopic" / "kernel-machine" / f"{kernel}-{digest.hexdigest()[:12]}"
    if (image / "initrd.cpio").exists():
        return image
    image.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="making-", dir=image.parent) as name:
        place = Path(name)
        _build(place, kernel)
        image_part = place / "image"
        try:
            image_part.rename(image)
        except OSError:
            # Another run was faster; what it made is the same.
            if not (image / "initrd.cpio").exists():
                raise
    for old in image.parent.iterdir():
        # Of an older kernel or an older text of this file; 100 MB each.
        if old != image and not old.name.startswith("making-"):
            shutil.rmtree(old, ignore_errors=True)
    return image


def _which(program: str) -> str | None:
    return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin:/bin")


def _kernel_package() -> str:
    """The package of Debian's current kernel; its name moves with security updates."""
    for _ in range(2):
        output = subprocess.run(
            ["apt-cache", "depends", METAPACKAGE],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        ).stdout
        for line in output.splitlines():
            parameters = line.split()
            if parameters[:1] == ["Depends:"] and parameters[1].startswith("linux-image-"):
                return parameters[1]
        if os.geteuid() != 0:
            break
        subprocess.run(["apt-get", "update", "-qq"], timeout=DOWNLOAD_LIMIT_S, check=False)
    raise CannotRunError(f"apt knows no {METAPACKAGE}; run apt-get update on a Debian or Ubuntu")


def _build(place: Path, kernel: str) -> None:
    print(f"making the virtual machine's image from {kernel}", flush=True)
    unpacked, image = place / "unpacked", place / "image"
    image.mkdir()
    # apt drops its rights to download, and the folder has to let that user in.
    place.chmod(0o755)
    try:
        subprocess.run(
            ["apt-get", "download", "-q", "-o", "APT::Sandbox::User=root", kernel],
            cwd=place,
            timeout=DOWNLOAD_LIMIT_S,
            check=True,
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        raise CannotRunError(
            f"{kernel} cannot be downloaded ({error}); run apt-get update, or check the network"
        ) from error
    (package,) = place.glob("linux-image-*.deb")
    subprocess.run(["dpkg-deb", "-x", package, unpacked], timeout=300, check=True)
    (modules,) = (unpacked / "lib/modules").iterdir()
    compressed = next((unpacked / "boot").glob("vmlinuz-*")).read_bytes()
    (image / "kernel").write_bytes(_uncompressed(compressed))
    depmod, modprobe = _which("depmod"), _which("modprobe")
    assert depmod is not None
    assert modprobe is not None
    subprocess.run([depmod, "-b", unpacked, modules.name], timeout=300, check=True)

    def needed(names: Iterable[str]) -> list[Path]:
        found: dict[Path, None] = {}
        for name in names:
            output = subprocess.run(
                [modprobe, "-d", unpacked, "-S", modules.name, "--show-depends", name],
                capture_output=True,
                text=True,
                timeout=60,
                check=True,
            ).stdout
            found |= {
                Path(line.split()[1]): None for line in output.splitlines() if "insmod" in line
            }
        return list(found)

    try:
        (place / "vimc").mkdir()
        vimc = build_vimc(place / "vimc", kernel)
    except ModuleBuildError as error:
        raise CannotRunError(str(error)) from error
    boot, tested = needed(BOOT_MODULES), needed(TESTED_MODULES)
    load = dict.fromkeys(_plain_name(m) for m in (*boot, *tested))
    for name in TESTED_MODULES:
        del load[f"{name}.ko"]
    busybox = _which("busybox")
    assert busybox is not None
    files = [
        ("init", (HERE / "guest.sh").read_bytes(), 0o755),
        ("bin/busybox", Path(busybox).read_bytes(), 0o755),
        ("modules.load", "\n".join(load).encode(), 0o644),
        *((f"modules/{_plain_name(m)}", _module(m), 0o644) for m in {*boot, *tested}),
        ("modules/vimc.ko", vimc.read_bytes(), 0o644),
    ]
    (image / "initrd.cpio").write_bytes(_archive(files))


def _plain_name(module: Path) -> str:
    return module.name.removesuffix(".xz")


def _module(path: Path) -> bytes:
    content = path.read_bytes()
    return lzma.decompress(content) if path.suffix == ".xz" else content


def _uncompressed(vmlinuz: bytes) -> bytes:
    """The kernel proper: an emulated processor would take seconds to unpack it at every start."""
    at = vmlinuz.find(XZ_MAGIC)
    while at >= 0:
        try:
            kernel = lzma.LZMADecompressor(format=lzma.FORMAT_XZ).decompress(vmlinuz[at:])
        except lzma.LZMAError:
            kernel = b""
        if kernel.startswith(ELF_MAGIC):
            return kernel
        at = vmlinuz.find(XZ_MAGIC, at + 1)
    return vmlinuz


def _archive(files: Sequence[tuple[str, bytes, int]]) -> bytes:
    """A cpio archive in the kernel's "newc" format (Documentation/driver-api/early-userspace)."""
    folders = sorted({str(Path(name).parent) for name, *_ in files} - {"."})
    entries = [(name, b"", stat.S_IFDIR | 0o755) for name in folders]
    entries += [(name, content, stat.S_IFREG | mode) for name, content, mode in files]
    entries.append(("TRAILER!!!", b"", 0))
    archive = bytearray()
    for number, (name, content, mode) in enumerate(entries, 1):
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(path), 0)
        archive += b"070701" + b"".join(b"%08X" % field for field in fields) + path
        archive += bytes(-len(archive) % 4) + content
        archive += bytes(-len(archive) % 4)
    return bytes(archive)


if __name__ == "__main__":
    main()
