"""The steps of a Containerfile in a root made by mmdebstrap, where no registry is at hand.

    python -m tests.support.container_root [--data FOLDER] CONTAINERFILE CONTEXT ROOT [COMMAND ...]

It runs as root. ARG, FROM, RUN, COPY, ENV, USER, ENTRYPOINT and CMD are known. Every FROM begins
with the same base, whatever image it names. Certificates and name servers of this machine are
visible in the root while its steps run. COMMAND is run by the user of the image, with the arguments
of its ENTRYPOINT in front, without network.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

CERTIFICATES = "/etc/ssl/certs/ca-certificates.crt"
SEEN_CERTIFICATES = "/run/certificates.crt"
SEEN = {
    CERTIFICATES: SEEN_CERTIFICATES,
    "/etc/resolv.conf": "/etc/resolv.conf",
    "/etc/hosts": "/etc/hosts",
}
"""Files of this machine by their place in the root."""
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class ContainerfileError(Exception):
    """A step that is not known, or that failed."""


@dataclass
class Stage:
    """A root and what its steps have set."""

    root: Path
    environment: dict[str, str] = field(default_factory=lambda: {"PATH": PATH, "HOME": "/root"})
    user: str = ""
    entrypoint: list[str] = field(default_factory=list)

    def run(self, command: Sequence[str], *, has_network: bool) -> None:
        """Run a command in the root.

        Raises:
            ContainerfileError: it failed.
        """
        mounts = [f"mount --rbind /dev {self.root}/dev", f"mount -t proc proc {self.root}/proc"]
        for path, seen in SEEN.items() if has_network else ():
            if Path(path).exists():
                place = self.root / seen[1:]
                place.parent.mkdir(parents=True, exist_ok=True)
                place.touch()
                mounts.append(f"mount --bind {path} {place}")
        user = f"--userspec={self.user}:{self.user}" if self.user else ""
        words = shlex.join(command)
        script = " && ".join([*mounts, f"exec /usr/sbin/chroot {user} {self.root} {words}"])
        namespaces = ["unshare", "--mount", "--pid", "--fork", *([] if has_network else ["--net"])]
        given = {"PIP_CERT": SEEN_CERTIFICATES} if has_network else {}
        done = subprocess.run(
            [*namespaces, "/bin/sh", "-c", script], env=self.environment | given, check=False
        )
        if done.returncode:
            raise ContainerfileError(f"{words}: status {done.returncode}")


def steps(text: str) -> Iterator[tuple[str, str]]:
    """Instructions and their arguments, without comments, continued lines joined."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        if line.strip():
            instruction, _, arguments = line.strip().partition(" ")
            yield instruction.upper(), arguments.strip()


def built(containerfile: Path, context: Path, folder: Path, suite: str) -> Stage:
    """The last stage of a Containerfile.

    Raises:
        ContainerfileError: a step that is not known, or that failed.
    """
    base = folder / "base.tar"
    if not base.exists():
        command = ["mmdebstrap", "--variant=minbase", "--quiet", suite, str(base)]
        subprocess.run(command, check=True)
    stages: dict[str, Stage] = {}
    stage = Stage(folder)
    for instruction, arguments in steps(containerfile.read_text("utf-8")):
        print(f"{instruction} {arguments}", file=sys.stderr, flush=True)
        words = shlex.split(arguments)
        if instruction == "ARG":
            continue
        if instruction == "FROM":
            name = words[2] if len(words) == 3 else str(len(stages))
            stage = stages[name] = Stage(folder / f"stage-{name}")
            stage.root.mkdir()
            subprocess.run(["tar", "xf", str(base), "-C", str(stage.root)], check=True)
        elif instruction == "RUN":
            stage.run(["/bin/sh", "-c", arguments], has_network=True)
        elif instruction == "COPY":
            copy(words, context, stages, stage)
        elif instruction == "ENV":
            stage.environment |= dict(word.split("=", 1) for word in words)
        elif instruction == "USER":
            stage.user = words[0]
            stage.environment["HOME"] = home_of(stage.root, words[0])
        elif instruction == "ENTRYPOINT":
            stage.entrypoint = json.loads(arguments)
        elif instruction != "CMD":
            raise ContainerfileError(f"{instruction} is not known")
    return stage


def copy(words: Sequence[str], context: Path, stages: dict[str, Stage], stage: Stage) -> None:
    """Copy from the context, or from another stage."""
    origin = context
    if words[0].startswith("--from="):
        origin, words = stages[words[0].removeprefix("--from=")].root, words[1:]
    *sources, target = words
    place = stage.root / target.lstrip("/")
    for source in sources:
        found = sorted(origin.glob(source.lstrip("/")))
        if not found:
            raise ContainerfileError(f"{source}: no such file in {origin}")
        for path in found:
            if path.is_dir():
                shutil.copytree(path, place, symlinks=True)
            else:
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, place)


def home_of(root: Path, user: str) -> str:
    """The home of a user by name or number."""
    for line in (root / "etc/passwd").read_text("utf-8").splitlines():
        name, _, number, _, _, home, _ = line.split(":")
        if user in (name, number):
            return home
    return "/"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.container_root", description=__doc__
    )
    parser.add_argument("containerfile", type=Path)
    parser.add_argument("context", type=Path)
    parser.add_argument("root", type=Path, help="new folder for base and stages")
    parser.add_argument("--suite", default="trixie", help="suite of Debian")
    parser.add_argument("--data", type=Path, help="folder that is /data for the command")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="arguments of the entry point")
    options = parser.parse_args()
    if os.geteuid():
        parser.error("run it as root: it mounts and changes root")
    options.root.mkdir(parents=True, exist_ok=True)
    stage = built(options.containerfile, options.context, options.root.resolve(), options.suite)
    if options.data is not None:
        shutil.copytree(options.data, stage.root / "data")
        subprocess.run(["chown", "-R", stage.user or "root", stage.root / "data"], check=True)
    if options.command:
        stage.run([*stage.entrypoint, *options.command], has_network=False)


if __name__ == "__main__":
    main()
