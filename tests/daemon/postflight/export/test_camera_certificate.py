"""The certificate of a rig: that of its virtual camera where it has one."""

from __future__ import annotations

import pytest

from daemon.postflight.export.camera_certificate import CameraCertificateError, certificate_of
from processing.rig import load_rig, shipped_rigs


def test_the_certificate_of_a_stitched_rig_is_that_of_its_virtual_camera() -> None:
    output = certificate_of(load_rig(shipped_rigs()["ultracam-x"]))
    pan, colour = output["cameras"]
    assert (pan["width_px"], pan["height_px"], pan["pixel_size_um"]) == (14430, 9420, 7.2)
    assert pan["principal_distance_mm"] == 100.5
    assert colour["pixel_size_um"] == pytest.approx(21.6) and colour["width_px"] == 4810
    with pytest.raises(CameraCertificateError, match="no camera to certify"):
        certificate_of(load_rig(shipped_rigs()["rededge"]))
