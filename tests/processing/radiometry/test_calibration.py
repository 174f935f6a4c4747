"""Radiometric calibration files: contents, and errors of hostile ones."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.radiometry.calibration import CalibrationError, load_radiometry, neutral_radiometry
from processing.radiometry.corrector import corrector_for
from processing.rig import find_rig

SHAPE = (12, 16)


def content(**changes: Any) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "bias_dn": np.full(SHAPE, 64, np.float32),
        "dark_dn_per_s": np.full(SHAPE, 30, np.float32),
        "doubling_k": np.float64(6.5),
        "reference_c": np.float64(20),
        "gain": np.full(SHAPE, 1.02, np.float32),
        "defect": np.zeros(SHAPE, np.uint8),
    }
    return {key: value for key, value in (arrays | changes).items() if value is not None}


def written(path: Path, **changes: Any) -> Path:
    np.savez(path, **content(**changes))
    return path


def test_a_good_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = load_radiometry(written(tmp_path / "SU00.npz"))
    assert found.gain.dtype == np.float32 and found.gain.shape == SHAPE
    assert found.doubling_k == 6.5 and found.reference_c == 20.0
    assert found.response_per_k == 0.0
    warming = load_radiometry(written(tmp_path / "SU01.npz", response_per_k=np.float64(1e-4)))
    assert warming.response_per_k == 1e-4
    assert np.all(found.bias_dn == 64) and found.defect.dtype == np.uint8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": None}, "it holds bias_dn.npy"),
        ({"extra": np.zeros(3)}, "it holds bias_dn.npy"),
        ({"gain": np.array([{}, {}], dtype=object)}, "gain is of type object"),
        ({"gain": np.full((3, 4), 1, np.float32)}, r"bias_dn is \(12, 16\), gain is \(3, 4\)"),
        ({"gain": np.full(SHAPE, 0, np.float32)}, "gain runs from 0 to 0"),
        ({"gain": np.full(SHAPE, np.nan, np.float32)}, "gain runs from nan"),
        ({"bias_dn": np.full(SHAPE, -3, np.float32)}, "bias_dn runs from -3"),
        ({"dark_dn_per_s": np.full(SHAPE, np.inf, np.float32)}, "dark_dn_per_s runs from inf"),
        ({"doubling_k": np.float64(0)}, "doubling_k is 0.0; it is positive"),
        ({"reference_c": np.zeros(2)}, "reference_c has shape"),
        ({"response_per_k": np.float64(0.5)}, "response_per_k is 0.5; it stays within 0.01"),
        ({"defect": np.zeros(SHAPE, np.complex128)}, "defect is of type complex128"),
        ({"bias_dn": np.zeros((2, 3, 4), np.float32)}, "bias_dn has shape"),
    ],
)
def test_a_file_with_other_content_is_refused_with_what_was_found(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        load_radiometry(written(tmp_path / "SU00.npz", **changes))


def test_an_announced_giant_is_refused_before_it_is_allocated(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (1_000_000, 1_000_000)}
    )
    path = written(tmp_path / "good.npz")
    bad = tmp_path / "SU00.npz"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            target.writestr(name, header.getvalue() if name == "gain.npy" else source.read(name))
    with pytest.raises(CalibrationError, match="announces 1000000000000 pixels"):
        load_radiometry(bad)


@pytest.mark.parametrize("cut", [0, 1, 40, 300, -30])
def test_a_truncated_file_is_refused_in_one_sentence(tmp_path: Path, cut: int) -> None:
    path = written(tmp_path / "SU00.npz")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(CalibrationError, match=r"SU00.npz: damaged"):
        load_radiometry(path)


def test_flipped_bytes_never_raise_anything_else(tmp_path: Path) -> None:
    path = written(tmp_path / "SU00.npz")
    good = path.read_bytes()
    rng = np.random.default_rng(2)
    for _ in range(150):
        bad = bytearray(good)
        for at in rng.integers(0, len(bad), 3):
            bad[at] = rng.integers(0, 256)
        path.write_bytes(bytes(bad))
        try:
            load_radiometry(path)
        except CalibrationError as error:
            assert "SU00.npz" in str(error)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_radiometry(tmp_path / "SU00.npz")


def test_maps_of_another_sensor_size_are_refused(tmp_path: Path) -> None:
    sensor = find_rig("ultracam-x-mini").sensor("SU00")
    with pytest.raises(
        CalibrationError, match=r"maps are \(12, 16\), sensor SU00 is \(832, 1248\)"
    ):
        corrector_for(sensor, load_radiometry(written(tmp_path / "SU00.npz")))


def test_the_neutral_calibration_costs_no_memory() -> None:
    sensor = find_rig("ultracam-x").sensor("SU00")
    neutral = neutral_radiometry(sensor)
    assert neutral.gain.strides == (0, 0)
    assert corrector_for(sensor, neutral).response is None
