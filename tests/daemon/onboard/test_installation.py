"""The service is laid out whole and hardened, and taken away leaving the rest as it was."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path, PurePosixPath

import pytest

from daemon.onboard.installation import (
    DROP_IN,
    MANIFEST,
    TARGETS,
    InstallationError,
    contents,
    install,
    steps,
    uninstall,
)

COMMAND = Path("/opt/syntopic/bin/syntopic")
CONFIGURATION = PurePosixPath("/etc/syntopic/service.toml")
UNIT = str(TARGETS["syntopic.service"])
EXPOSURE_MAX = 1.5


def ignore(_line: str) -> None: ...


def lay_out(root: Path, *, replace: bool = False, missions: Path | None = None) -> list[str]:
    texts = contents(COMMAND, CONFIGURATION, missions)
    return install(texts, steps(COMMAND, None), root=root, log=ignore, replace=replace).files


def systemd_analyze() -> str:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not here; apt-get install systemd")
    return program


def test_an_image_gets_every_file_and_a_note_of_them(tmp_path: Path) -> None:
    written = lay_out(tmp_path)
    assert sorted(written) == sorted(map(str, TARGETS.values()))
    for path in written:
        assert (tmp_path / path.lstrip("/")).stat().st_mode & 0o777 == 0o644
    noted = json.loads((tmp_path / str(MANIFEST).lstrip("/")).read_text())
    assert sorted(noted) == sorted(written)


def test_the_unit_runs_the_command_that_was_installed() -> None:
    texts = contents(Path("/srv/cam/bin/syntopic"), PurePosixPath("/etc/cam.toml"), None)
    assert "ExecStart=/srv/cam/bin/syntopic run /etc/cam.toml\n" in texts[UNIT]
    assert "/opt/syntopic" not in texts[UNIT]


def test_missions_on_a_disk_of_their_own_are_let_through_the_hardening(tmp_path: Path) -> None:
    lay_out(tmp_path, missions=Path("/data/flights"))
    drop_in = (tmp_path / str(DROP_IN).lstrip("/")).read_text()
    assert drop_in == "[Service]\nReadWritePaths=/data/flights\n"
    assert str(DROP_IN) not in contents(COMMAND, CONFIGURATION, Path("/var/lib/syntopic/flights"))


def test_a_mirror_is_let_through_the_hardening_and_may_be_missing_at_the_start() -> None:
    texts = contents(COMMAND, CONFIGURATION, Path("/a/flights"), Path("/b/flights"))
    assert texts[str(DROP_IN)] == (
        "[Service]\nReadWritePaths=-/a/flights\nReadWritePaths=-/b/flights\n"
    )
    with_home = contents(COMMAND, CONFIGURATION, Path("/var/lib/syntopic/flights"), Path("/b"))
    assert with_home[str(DROP_IN)] == "[Service]\nReadWritePaths=-/b\n"


def test_the_helper_that_asks_the_disks_is_valid_and_closed_to_all_else(tmp_path: Path) -> None:
    program = systemd_analyze()
    name = "syntopic-disk-health.service"
    unit = tmp_path / name
    text = contents(COMMAND, CONFIGURATION, None)[str(TARGETS[name])]
    assert f"ExecStart={COMMAND} disk-health" in text
    unit.write_text(text)
    completed = subprocess.run(
        [program, "security", "--offline=true", str(unit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    found = re.search(rf"Overall exposure level for {re.escape(name)}: ([0-9.]+)", completed.stdout)
    assert found, completed.stdout + completed.stderr
    assert float(found.group(1)) <= EXPOSURE_MAX


def test_the_shutdown_helper_is_valid_answers_the_service_only_and_is_not_enabled(
    tmp_path: Path,
) -> None:
    program = systemd_analyze()
    texts = contents(COMMAND, CONFIGURATION, None, copy_to=[Path("/media/shuttle")])
    assert texts[str(DROP_IN)] == "[Service]\nReadWritePaths=-/media/shuttle\n"
    names = ("syntopic-poweroff.service", "syntopic-poweroff.socket")
    for name in names:
        (tmp_path / name).write_text(texts[str(TARGETS[name])])
    lines = texts[str(TARGETS["syntopic-poweroff.socket"])].splitlines()
    assert {"SocketUser=syntopic", "SocketMode=0600"} <= set(lines)
    completed = subprocess.run(
        [program, "security", "--offline=true", str(tmp_path / names[0])],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    found = re.search(rf"exposure level for {re.escape(names[0])}: ([0-9.]+)", completed.stdout)
    assert found, completed.stdout + completed.stderr
    assert float(found.group(1)) <= EXPOSURE_MAX
    assert not any("poweroff" in " ".join(step.command) for step in steps(COMMAND, "rig"))


@pytest.mark.parametrize("path", ["/home/pilot/venv/bin/syntopic", "/root/syn/bin/syntopic"])
def test_a_command_the_service_could_not_see_is_refused(path: str) -> None:
    with pytest.raises(InstallationError, match="python3 -m venv /opt/syntopic"):
        contents(Path(path), CONFIGURATION, None)


def test_what_was_edited_by_hand_is_not_overwritten(tmp_path: Path) -> None:
    lay_out(tmp_path)
    lay_out(tmp_path)  # a second time is no harm
    unit = tmp_path / UNIT.lstrip("/")
    unit.write_text(unit.read_text() + "# mine\n")
    with pytest.raises(InstallationError, match="systemctl edit syntopic"):
        lay_out(tmp_path)
    assert unit.read_text().endswith("# mine\n")
    lay_out(tmp_path, replace=True)
    assert "# mine" not in unit.read_text()


def test_uninstalling_removes_what_was_brought_and_nothing_else(tmp_path: Path) -> None:
    lay_out(tmp_path, missions=Path("/data"))
    rules = tmp_path / str(TARGETS["udev.rules"]).lstrip("/")
    rules.write_text("# mine\n")
    mission = tmp_path / "var/lib/syntopic/flight/mission.json"
    kernel = tmp_path / "var/cache/syntopic/level1_1/correct.py311.nbi"
    for path in (mission, kernel, kernel.with_name(f"{kernel.name}.part")):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    done = uninstall(root=tmp_path, log=ignore)
    assert done.retained == [str(TARGETS["udev.rules"])]
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert left == [str(rules.relative_to(tmp_path)), str(mission.relative_to(tmp_path))]
    with pytest.raises(InstallationError, match="nothing was installed"):
        uninstall(root=tmp_path, log=ignore)


def test_a_forged_note_does_not_make_uninstall_remove_other_files(tmp_path: Path) -> None:
    lay_out(tmp_path)
    noted = tmp_path / str(MANIFEST).lstrip("/")
    noted.write_text(json.dumps({"/etc/passwd": "0" * 64}))
    with pytest.raises(InstallationError, match="not ours"):
        uninstall(root=tmp_path, log=ignore)


def test_the_unit_and_its_companions_are_valid(tmp_path: Path) -> None:
    program = systemd_analyze()
    command = tmp_path / "bin" / "syntopic"
    command.parent.mkdir()
    command.write_text("#!/bin/sh\n")
    command.chmod(0o755)
    template = contents(COMMAND, CONFIGURATION, None)[UNIT]
    unit = tmp_path / "syntopic.service"
    unit.write_text(template.replace(str(COMMAND), str(command)))
    # The unit is valid whether or not the manual pages it names are installed.
    verified = subprocess.run(
        [program, "verify", "--man=no", str(unit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr
    assert "syntopic" not in verified.stderr
    for tool, name in (
        ("systemd-sysusers", "sysusers.conf"),
        ("systemd-tmpfiles", "tmpfiles.conf"),
    ):
        if shutil.which(tool) is None:
            continue
        copy = tmp_path / name
        copy.write_text(contents(COMMAND, CONFIGURATION, None)[str(TARGETS[name])])
        parsed = subprocess.run(
            [tool, f"--root={tmp_path}", "--create" if "tmp" in tool else "--dry-run", str(copy)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        # Creation may fail without permissions or user; an invalid line must not occur.
        assert not re.search(r"Invalid|Unknown|Failed to parse|syntax", parsed.stderr), (
            parsed.stderr
        )


def test_the_unit_is_hardened(tmp_path: Path) -> None:
    program = systemd_analyze()
    unit = tmp_path / "syntopic.service"
    unit.write_text(contents(COMMAND, CONFIGURATION, None)[UNIT])
    completed = subprocess.run(
        [program, "security", "--offline=true", str(unit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    found = re.search(r"Overall exposure level for syntopic\.service: ([0-9.]+)", completed.stdout)
    assert found, completed.stdout + completed.stderr
    assert float(found.group(1)) <= EXPOSURE_MAX
