"""Files for clusters: no root, no compiler, TLS everywhere, options that the commands have."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daemon.cli import app

FOLDER = Path(__file__).parents[4] / "systemd/cluster"


def test_the_image_has_no_root_and_no_compiler() -> None:
    text = (FOLDER / "Containerfile").read_text()
    final = text.rpartition("\nFROM ")[2]
    assert "\nUSER 10001\n" in final and "USER root" not in text
    assert final.index("USER 10001") < final.index("syntopic kernels")
    assert not re.search(r"\b(gcc|g\+\+|build-essential|python3-dev)\b", text)
    assert "--only-binary=:all:" in text and "requirements.lock" in text


def test_sources_have_times_that_a_layer_holds_before_kernels_are_compiled(tmp_path: Path) -> None:
    (source := tmp_path / "package/kernels.py").parent.mkdir()
    source.touch()
    os.utime(source, ns=(1_795_256_100_700_000_000,) * 2)
    text = (FOLDER / "Containerfile").read_text()
    (command,) = re.findall(r'^RUN /opt/syntopic/bin/python -c "(.*)"$', text, re.MULTILINE)
    assert text.index(command) < text.index("COPY --from=build") < text.index("syntopic kernels")
    code = command.replace("/opt/syntopic", str(tmp_path))
    subprocess.run([sys.executable, "-c", code], check=True)
    assert source.stat().st_mtime_ns == 1_795_256_100_000_000_000


def test_pods_have_no_root_and_every_connection_has_tls() -> None:
    yaml = pytest.importorskip("yaml")
    parts = list(yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text()))
    pods = [part["spec"]["template"]["spec"] for part in parts if "template" in part["spec"]]
    assert len(pods) == 3
    for pod in pods:
        assert pod["securityContext"]["runAsNonRoot"]
        (container,) = pod["containers"]
        words = [str(word) for word in [*container.get("command", []), *container.get("args", [])]]
        assert "tls" in words or any(word.startswith("tls://") for word in words)
        assert not any(word.startswith("tcp://") for word in words)


def test_objects_refer_to_each_other_and_to_options_that_the_commands_have() -> None:
    yaml = pytest.importorskip("yaml")
    scheduler = pytest.importorskip("distributed.cli.dask_scheduler").main
    service, *others = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
    name, (port,) = service["metadata"]["name"], service["spec"]["ports"]
    address = f"tls://{name}:{port['port']}"
    for part in others:
        template = part["spec"]["template"]
        (container,) = template["spec"]["containers"]
        assert container["image"] == f"syntopic:{version('syntopic')}"
        assert {one["name"] for one in container["volumeMounts"]} == {
            one["name"] for one in template["spec"]["volumes"]
        }
        words = [str(word) for word in [*container.get("command", []), *container.get("args", [])]]
        if words[0] == "dask":
            assert template["metadata"]["labels"] == service["spec"]["selector"]
            assert words[words.index("--port") + 1] == str(port["port"])
            known = {option for one in scheduler.params for option in one.opts}
        else:
            assert address in words
            shown = CliRunner().invoke(app, [words[0], "--help"], env={"COLUMNS": "200"}).output
            known = set(re.findall(r"--[a-z-]+", shown))
        used = {word for word in words if word.startswith("--")}
        assert used and used <= known, used - known


@pytest.mark.parametrize(("file", "command"), [("slurm.sh", "worker"), ("slurm.sh", "process")])
def test_the_options_exist(file: str, command: str) -> None:
    path = FOLDER / file
    subprocess.run(["sh", "-n", str(path)], check=True)
    text = path.read_text()
    shown = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).output
    for option in ("--tls-ca", "--tls-certificate", "--tls-key"):
        assert f"{option} " in text and option in shown
