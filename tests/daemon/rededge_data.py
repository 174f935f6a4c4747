"""Where the recorded exposures of a foreign five-head camera are, and a small one made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

RECORDED = Path(__file__).parents[3] / "shared" / "data" / "rededge"

needs_recording = pytest.mark.skipif(
    not RECORDED.is_dir(), reason="needs the RedEdge exposures in ../shared/data/rededge"
)

BAND_NAMES = ("Blue", "Green", "Red", "NIR", "Red edge")


def packet(band="Blue", capture="c1", extra="", **changes):
    """An XMP packet as the camera writes it."""
    values = {
        "PrincipalPoint": "0.3,0.2",
        "PerspectiveFocalLength": "180.0",
        "ModelType": "perspective",
        "CentralWavelength": "475",
        "WavelengthFWHM": "20",
        **changes,
    }
    sequences = {
        "RadiometricCalibration": "1e-4 1e-7 1e-6",
        "VignettingCenter": "80 60",
        "VignettingPolynomial": "0 0 0 0 0 0",
        "PerspectiveDistortion": "-0.1 0.1 0 0.0002 0.0003",
    }
    plain = "".join(f"<c:{key}>{value}</c:{key}>" for key, value in values.items())
    listed = "".join(
        f"<c:{key}><r:Seq>{''.join(f'<r:li>{v}</r:li>' for v in text.split())}</r:Seq></c:{key}>"
        for key, text in sequences.items()
    )
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{extra}'
        f'<r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<r:Description xmlns:c="http://pix4d.com/1.0"><c:BandName>{band}</c:BandName>'
        f"<c:CaptureId>{capture}</c:CaptureId>{plain}{listed}</r:Description></r:RDF></x:xmpmeta>"
    ).encode()


def write_tiff(path, xmp, *, black=4800):
    """A small image with an XMP packet and a black level, but without EXIF."""
    pixels = np.full((120, 160), 8000, np.uint16)
    tags = [(700, 7, len(xmp), xmp, True), (50714, 3, 4, (black,) * 4, True)]
    tifffile.imwrite(path, pixels, photometric="minisblack", metadata=None, extratags=tags)
