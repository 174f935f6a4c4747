"""The host's own sensors: found by name, read right, and found again when they vanish."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from drivers.contract import DeviceError, Record, TemperatureSample
from drivers.thermometers.host.thermometer import HostThermometer
from tests.drivers.fakes import FakeClock, RecordingSink


def chip(root: Path, number: int, name: str, device: str, **files: str) -> Path:
    """A chip as the kernel shows it: class/hwmon/hwmonN -> devices/.../hwmon/hwmonN."""
    device_folder = root / "devices" / device / "hwmon" / f"hwmon{number}"
    device_folder.mkdir(parents=True)
    (device_folder / "device").symlink_to("../..")
    for file, text in {"name": name, **files}.items():
        (device_folder / file).write_text(text + "\n", encoding="utf-8")
    link = root / "class" / "hwmon" / f"hwmon{number}"
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(device_folder)
    return device_folder


def iio(root: Path, number: int, name: str, **files: str) -> Path:
    device_folder = root / "bus" / "iio" / "devices" / f"iio:device{number}"
    device_folder.mkdir(parents=True)
    for file, text in {"name": name, **files}.items():
        (device_folder / file).write_text(text + "\n", encoding="utf-8")
    return device_folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    chip(
        tmp_path,
        0,
        "coretemp",
        "coretemp.0",
        temp1_input="45250",
        temp1_label="Package id 0",
        temp2_input="-5200",
    )
    chip(tmp_path, 1, "nvme", "nvme0", temp1_input="38850")
    chip(tmp_path, 2, "nvme", "nvme1", temp1_input="41000")
    chip(tmp_path, 3, "max31865", "spi0.0", temp1_input="850000", temp1_fault="1")
    iio(tmp_path, 0, "bme280", in_temp_input="21340")
    iio(tmp_path, 1, "adc", in_temp_raw="1512", in_temp_offset="-1000", in_temp_scale="62.5")
    return tmp_path


def read_once(root: Path, *sensors: str) -> dict[str, float | None]:
    settings = {"sensors": sensors, "channels": [str(i) for i in range(len(sensors))]}
    device = HostThermometer("host", settings, root=root, clock=FakeClock())
    device.bind()
    recorder = RecordingSink()

    def stop(record: Record) -> None:
        if isinstance(record, TemperatureSample) and record.probe == str(len(sensors) - 1):
            device._closing.set()

    recorder.stop = stop
    device.run(recorder)
    return {r.probe: r.value_c for r in recorder.records if isinstance(r, TemperatureSample)}


def test_chips_are_named_by_channel_label_or_device(root: Path) -> None:
    found = read_once(
        root, "coretemp/Package id 0", "coretemp/temp2", "nvme@nvme0/temp1", "nvme@nvme1/temp1"
    )
    assert list(found.values()) == pytest.approx([45.25, -5.2, 38.85, 41.0])


def test_iio_is_read_as_computed_or_scaled_by_offset_and_scale(root: Path) -> None:
    found = read_once(root, "bme280/temp", "adc/temp")
    assert list(found.values()) == pytest.approx([21.34, (1512 - 1000) * 62.5 / 1000])


def test_a_sensor_its_chip_calls_faulty_is_open(root: Path) -> None:
    assert read_once(root, "max31865/temp1") == {"0": None}


def test_a_name_that_is_not_unique_or_not_there_is_refused_with_the_choices(root: Path) -> None:
    settings = {"sensors": ["nvme/temp1", "k10temp/temp1"], "channels": ["a", "b"]}
    with pytest.raises(DeviceError) as caught:
        HostThermometer("host", settings, root=root).bind()
    twice, absent = str(caught.value).splitlines()
    assert "nvme@nvme0/temp1, nvme@nvme1/temp1" in twice
    assert "k10temp/temp1 is not there; the host has coretemp/temp1, coretemp/temp2" in absent


def test_a_host_without_sensors_reports_it(tmp_path: Path) -> None:
    device = HostThermometer("host", {"sensors": ["a/temp1"], "channels": ["a"]}, root=tmp_path)
    with pytest.raises(DeviceError, match="the host has none at all"):
        device.bind()


def test_a_sensor_that_vanishes_is_found_again_under_another_number(root: Path) -> None:
    clock = FakeClock()
    settings = {"sensors": ["bme280/temp", "coretemp/temp2"], "channels": ["air", "cpu"]}
    device = HostThermometer("host", settings, root=root, clock=clock)
    recorder = RecordingSink()
    cpu: list[float | None] = []

    def play(record: Record) -> None:
        if not isinstance(record, TemperatureSample) or record.probe != "cpu":
            return
        cpu.append(record.value_c)
        if len(cpu) == 2:
            shutil.rmtree(root / "bus" / "iio" / "devices" / "iio:device0")
        elif len(cpu) == 5:
            iio(root, 7, "bme280", in_temp_input="22000")
        elif len(cpu) == 7:
            device._closing.set()

    recorder.stop = play
    device.run(recorder)
    samples = [r for r in recorder.records if isinstance(r, TemperatureSample)]
    air_c = [sample.value_c for sample in samples if sample.probe == "air"]
    assert air_c == pytest.approx([21.34, 21.34, 22.0, 22.0])
    assert cpu == [-5.2] * 7, "the neighbour is read all the time"
    assert recorder.event_names == ["opened", "lost", "recovered"]
    assert device.statistics() == {"readings": 11, "failures": 3, "open_sensors": 0, "losses": 1}
    assert clock.waits_s == pytest.approx([1.0] * 7)


@pytest.mark.parametrize("text", ["", "abc", "nan", "9" * 200, "1 2", "\udcff"])
def test_a_file_without_a_number_is_a_lost_sensor(root: Path, text: str) -> None:
    path = root / "class" / "hwmon" / "hwmon0" / "temp2_input"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    device = HostThermometer("host", {"sensors": ["coretemp/temp2"], "channels": ["a"]}, root=root)
    with pytest.raises(DeviceError, match="which is no number"):
        device.bind()


def test_settings_that_do_not_fit_together_are_refused() -> None:
    section = {"sensors": ["coretemp", "a/temp1"], "channels": ["0", "0", "1"]}
    assert HostThermometer.problems(section) == [
        "channels has 3 names; sensors has 2",
        "channels names 0 twice; once is enough",
        "sensors names coretemp; chip/channel, as coretemp/temp1",
    ]
