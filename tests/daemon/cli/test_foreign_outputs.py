"""A command replaces what it wrote before, and refuses to replace what somebody else did."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

import processing.rig
from daemon.cli import app, disk_health, sim
from daemon.cli.benchmark.pipeline import benchmark_exposure
from daemon.mission.layout import Mission
from daemon.mission.store import health
from daemon.mission.store.output_places import OutputPlaceError
from daemon.onboard.monitoring.access.certificate_authority import issue_certificate
from daemon.onboard.monitoring.access.certificates import TlsCertificateError
from daemon.postflight.exchange.mission_export import _own_files
from daemon.postflight.export.stac import _FILES as STAC_FILES
from daemon.postflight.export.support_bundle import write_bundle
from processing.rig import find_rig
from tests.daemon.postflight.small_adjustment_block import write_small_block

RUN = CliRunner()
MINE = "mine\n"


def refused(*arguments: object) -> str:
    done = RUN.invoke(app, [str(argument) for argument in arguments])
    assert isinstance(done.exception, OutputPlaceError), done.exception
    return str(done.exception)


def done(*arguments: object) -> None:
    result = RUN.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output + repr(result.exception)


def write_foreign(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(MINE)
    return path


@pytest.fixture
def mission(tmp_path: Path) -> Mission:
    rig = (Path(processing.rig.__file__).parent / "files/ultracam-l-mini.toml").read_bytes()
    started = datetime(2026, 11, 30, tzinfo=UTC)
    return Mission.create(
        tmp_path / "missions", rig_name="r", rig_toml=rig, service_toml=b"", started_utc=started
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_block(tmp_path_factory.mktemp("block") / "project")


def test_adjust_writes_into_an_empty_folder_only(project: Path, tmp_path: Path) -> None:
    table = write_foreign(tmp_path / "survey/points.csv")
    assert "points.csv" in refused("adjust", project, "--out", table.parent)
    assert table.read_text() == MINE
    assert "holds" in refused("adjust", project / "project.toml", "--out", tmp_path)


def test_adjust_replaces_its_own_protocol_and_covariances(project: Path, tmp_path: Path) -> None:
    protocol, covariances = tmp_path / "protocol.txt", tmp_path / "c.npz"
    for _ in range(2):
        done("adjust", project, "--protocol", protocol, "--covariance", covariances)
    points = project / "points.csv"
    before = points.read_bytes()
    assert "--protocol" in refused("adjust", project, "--protocol", points)
    assert "--covariance" in refused("adjust", project, "--covariance", points)
    assert "--protocol" in refused("adjust", project, "--protocol", covariances)
    assert points.read_bytes() == before


def test_imported_projects_take_an_empty_folder(project: Path, tmp_path: Path) -> None:
    from daemon.postflight.adjustment.project_writer import new_project

    table = write_foreign(tmp_path / "images.csv")
    with pytest.raises(OutputPlaceError), new_project(tmp_path) as part:
        (part / "images.csv").write_text("images")
    assert table.read_text() == MINE


def test_triangulate_refuses_a_folder_with_the_points_it_reads(
    mission: Mission, tmp_path: Path
) -> None:
    table = write_foreign(tmp_path / "survey/points.csv")
    arguments = ("triangulate", mission.path, "--points", table)
    assert "points.csv" in refused(*arguments, "--out", table.parent)
    for place in (mission.path, mission.path / "L2/000001", mission.path / "L0"):
        assert "mission" in refused(*arguments, "--out", place)
    assert table.read_text() == MINE


def test_reports_replace_those_of_the_same_mission(mission: Mission, tmp_path: Path) -> None:
    out = tmp_path / "reports"
    for _ in range(2):
        done("report", mission.path, "--out", out)
        write_bundle(mission, out=out)
    for name in ("report.html", "support.zip"):
        write_foreign(out / name)
    assert "report.html" in refused("report", mission.path, "--out", out)
    with pytest.raises(OutputPlaceError, match=r"support\.zip"):
        write_bundle(mission, out=out)
    other = f"<title>{mission.id}-2</title>"
    (out / "report.html").write_text(other)
    assert "report.html" in refused("report", mission.path, "--out", out)
    assert (out / "report.html").read_text() == other


def test_disk_health_replaces_only_a_report_of_disks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "collect", lambda: health.failed_report(OSError("none")))
    path = tmp_path / "disks.json"
    for _ in range(2):
        disk_health.disk_health(path)
    path.write_text('{"id": "mission"}')
    with pytest.raises(OutputPlaceError):
        disk_health.disk_health(path)
    assert path.read_text() == '{"id": "mission"}'


@pytest.mark.parametrize("name", ["service.toml", "calibration/radiometry/SU01.json"])
def test_the_emulator_refuses_a_configured_folder(tmp_path: Path, name: str) -> None:
    path = write_foreign(tmp_path / name)
    assert "--out" in refused("sim", "ultracam-x-mini", "--out", tmp_path)
    assert path.read_text() == MINE


def test_the_emulator_replaces_its_own_configuration(tmp_path: Path) -> None:
    sim.refuse_foreign_flight(tmp_path / "new")
    (tmp_path / "truth").mkdir()
    write_foreign(tmp_path / "calibration/radiometry/SU01.json")
    text = f"#:schema x\n{sim._WRITTEN_BY.decode()} for the devices it emulates.\n"
    (tmp_path / "service.toml").write_text(text)
    sim.refuse_foreign_flight(tmp_path)


def test_the_bench_renders_into_an_empty_folder_or_its_own(tmp_path: Path) -> None:
    table = write_foreign(tmp_path / "trajectory.csv")
    with pytest.raises(OutputPlaceError, match=r"trajectory\.csv.*--folder"):
        benchmark_exposure("ultracam-x-mini", find_rig("ultracam-x-mini"), tmp_path)
    assert table.read_text() == MINE


def test_a_certificate_of_another_authority_is_not_replaced(tmp_path: Path) -> None:
    first = issue_certificate(tmp_path / "a")
    assert issue_certificate(tmp_path / "a").certificate == first.certificate
    first.authority.unlink()
    assert issue_certificate(tmp_path / "a").is_new_authority
    other = tmp_path / "b/server.pem"
    other.parent.mkdir()
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=camera1"]
    subprocess.run(
        [*command, "-keyout", str(other.with_suffix(".key")), "-out", str(other)],
        check=True, capture_output=True,
    )  # fmt: skip
    before = other.read_bytes()
    with pytest.raises(TlsCertificateError, match="another authority"):
        issue_certificate(other.parent)
    assert other.read_bytes() == before
    other.write_text(MINE)
    with pytest.raises(TlsCertificateError, match="another authority"):
        issue_certificate(other.parent)


def test_exported_blocks_are_distinguished_from_results_of_the_program() -> None:
    own = _own_files({"sparse/cameras.txt": "", "sparse/images.txt": ""})
    for name in ("sparse/rigs.txt", "images/a/1.jpg", "about.json", "database.db"):
        assert own.fullmatch(name), name
    for name in ("sparse/0/cameras.bin", "dense/fused.ply", "images/1.png", "notes.txt"):
        assert not own.fullmatch(name), name
    own = _own_files({"reconstruction.json": "", "image_groups.txt": ""})
    assert own.fullmatch("rig_cameras.json") and not own.fullmatch("tracks.csv")
    assert not own.fullmatch("/points.txt")


def test_items_of_stac_are_distinguished_from_files_of_others() -> None:
    for name in ("collection.json", "000001/000001.json", "m-pan-8/m-pan-8.json"):
        assert STAC_FILES.fullmatch(name), name
    for name in ("catalog.json", "000001/notes.json", "notes.txt", "000001/000001.json.bak"):
        assert not STAC_FILES.fullmatch(name), name
