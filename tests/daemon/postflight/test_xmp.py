"""XMP packets: what is read from them, and that hostile ones end in a sentence."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.postflight.importers.xmp import XMP_MAX_BYTES, XmpError, read_xmp
from tests.daemon.rededge_data import packet


def test_values_and_sequences_are_read_by_their_names():
    xmp = read_xmp(packet(), "a.tif")
    assert xmp.text("BandName") == "Blue"
    assert xmp.number("CentralWavelength") == 475.0
    assert xmp.numbers("RadiometricCalibration", 3) == (1e-4, 1e-7, 1e-6)
    assert xmp.numbers("PrincipalPoint", 2) == (0.3, 0.2)
    assert "ModelType" in xmp and "Irradiance" not in xmp


def test_a_missing_value_and_a_wrong_number_are_reported_with_file_and_key():
    xmp = read_xmp(packet(CentralWavelength="blue"), "a.tif")
    with pytest.raises(XmpError, match=r"a\.tif: XMP Irradiance has 0 values"):
        xmp.text("Irradiance")
    with pytest.raises(XmpError, match="CentralWavelength is 'blue'; a finite number"):
        xmp.number("CentralWavelength")
    with pytest.raises(XmpError, match="VignettingPolynomial has 6 values; 2 are needed"):
        xmp.numbers("VignettingPolynomial", 2)
    with pytest.raises(XmpError, match="finite"):
        read_xmp(packet(CentralWavelength="nan"), "a.tif").number("CentralWavelength")


@pytest.mark.parametrize(
    ("hostile", "sentence"),
    [
        (b"<a>" + b" " * XMP_MAX_BYTES + b"</a>", "at most"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "document type"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>'.encode("utf-16"), "not UTF-8"),
        (b"<a>\xff\xfe</a>", "not UTF-8"),
        (b"<a><b></a>", "not valid XML"),
        (b"", "not valid XML"),
        (packet(extra="").replace(b"<r:li>80</r:li>", b"<r:li/>" * 20_000), "more than"),
    ],
)
def test_a_hostile_packet_is_refused_with_a_sentence(hostile, sentence):
    with pytest.raises(XmpError, match=sentence):
        read_xmp(hostile, "a.tif")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(packet()) - 1), st.binary(max_size=6))
def test_a_damaged_packet_is_read_or_refused_but_never_more(at, noise):
    intact = packet()
    try:
        xmp = read_xmp(intact[:at] + noise + intact[at + len(noise) :], "a.tif")
        xmp.numbers("VignettingPolynomial", 6)
    except XmpError:
        pass
