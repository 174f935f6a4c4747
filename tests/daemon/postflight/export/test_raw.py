"""A receiver's bytes come out of the log unchanged, over several runs of one flight."""

from __future__ import annotations

from pathlib import Path

from daemon.mission.layout import Mission
from daemon.mission.log.flight_log import FlightLog
from daemon.postflight.export.raw import export_raw

SERVICE = b'[[navigator]]\nname = "gnss"\ndriver = "ublox"\n'


def test_bytes_come_out_as_they_came_in_over_two_runs_and_other_devices_stay_out(
    tmp_path: Path,
) -> None:
    mission = Mission(tmp_path, tmp_path.name)
    for folder in ("L0", "log", "export"):
        (tmp_path / folder).mkdir()
    (tmp_path / "service.toml").write_bytes(SERVICE)
    (tmp_path / "L0/000007").mkdir()
    (tmp_path / "L0/000007/exposure.json").write_text(
        '{"number":7,"mark_gps_ns":"1479300424815345071","mark_sigma_ns":25,'
        '"mark_source":"event-mark","mark_count":7,"navigation":null,"frames":['
        '{"sensor":"G","mid_exposure_gps_ns":"1479300424815345070","time_sigma_ns":1415,'
        '"time_source":"event-mark"},{"sensor":"R","mid_exposure_gps_ns":null}]}'
    )
    for run in range(2):
        log = FlightLog.create(mission.log_dir)
        for part in range(3):
            log.append("raw/gnss", part, bytes([0xB5, 0x62, run, part]))
            log.append("raw/probes", part, b"noise")
        log.close()
    done = export_raw(mission)
    written = (done.folder / "gnss.ubx").read_bytes()
    assert written == bytes(b for r in range(2) for p in range(3) for b in (0xB5, 0x62, r, p))
    assert done.nbytes == {"gnss.ubx": 24}
    header, row = (done.folder / "events.csv").read_text().splitlines()
    assert header.startswith("exposure,gps_week,seconds_of_week")
    assert row.startswith("7,2445,564424.815345071,25,event-mark,7,")
    frames = (done.folder / "frames.csv").read_text().splitlines()
    assert frames[1:] == ["7,G,2445,564424.815345070,1415,event-mark"]
