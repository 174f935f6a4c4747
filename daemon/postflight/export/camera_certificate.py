"""The camera of Level-2 images as a calibration certificate: for programs, and as a page to print.

What is certified is the image that others get, without distortion; the physical lenses behind it
are in the rig file.
"""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from typing import Any

from daemon import DaemonError
from daemon.mission.exposure_batch import ExposureFailure
from daemon.mission.layout import Mission
from daemon.mission.store.durable import make_directories, replace_file
from daemon.orientation.exterior_orientation import sealed_exposures
from processing.pipelines.perspective import has_head_images, perspective_of
from processing.rig import Rig, VirtualImage, load_rig

AXES = (
    "x to the right, y up (nominal flight direction of the nadir image), origin at the principal "
    "point, which is the centre of the image; column = x / pixel + (width - 1) / 2, row = (height "
    "- 1) / 2 - y / pixel, whole numbers at pixel centres; the camera looks along -z, the image "
    "plane is at z = -principal distance"
)


class CameraCertificateError(DaemonError):
    """A rig whose images have no single perspective; the message states so."""


def certificate_of(rig: Rig) -> dict[str, Any]:
    """The certificate as JSON types.

    Raises:
        CameraCertificateError: an uncalibrated rig, or one whose bands are registered to one of
            them.
    """
    if not rig.is_calibrated:
        raise CameraCertificateError(
            f"rig {rig.name} is uncalibrated, so nothing can be certified; calibrate the camera, "
            "then process the mission again with its rig file"
        )
    if rig.virtual_image is not None:
        images = [("stitched PAN image", rig.virtual_image, [s.serial for s in rig.sensors])]
        if rig.colour_cones:
            images.append(("colour image", _colour(rig.virtual_image), []))
        valid = (
            "for images stitched with this calibration, as long as quality.json of an exposure "
            "does not say CALIBRATION_EXPIRED"
        )
    elif has_head_images(rig):
        images = [(c.name, perspective_of(c), [s.serial for s in c.sensors]) for c in rig.cones]
        valid = "for images resampled to strict perspective with this calibration"
    else:
        raise CameraCertificateError(
            f"rig {rig.name}: bands are registered to a reference band from their content; there "
            "is no camera to certify"
        )
    return {
        "camera": rig.title or rig.name,
        "rig": rig.name,
        "calibration": {"id": rig.calibration_id, "date": rig.calibration_date},
        "cameras": [
            {
                "name": name,
                "principal_distance_mm": image.f_mm,
                "principal_point_mm": [0.0, 0.0],
                "width_px": image.width_px,
                "height_px": image.height_px,
                "pixel_size_um": image.pitch_um,
                "format_mm": [image.width_px * image.pitch_mm, image.height_px * image.pitch_mm],
                "distortion": "none: removed when the image was made",
                "serial_numbers": [serial for serial in serials if serial],
            }
            for name, image, serials in images
        ],
        "lenses": {cone.name: cone.lens.serial for cone in rig.cones if cone.lens.serial},
        "axes": AXES,
        "valid": valid,
    }


def write_certificate(
    mission: Mission,
) -> tuple[dict[str, Any], Path, tuple[ExposureFailure, ...]]:
    """Write `export/certificate.json` and `certificate.html`.

    Returns:
        The content, the page, and the exposures whose record cannot be read.

    Raises:
        CameraCertificateError: as `certificate_of`.
    """
    content = certificate_of(load_rig(mission.rig_path))
    exposures = sealed_exposures(mission)
    content["mission"] = mission.id
    content["exposures"] = len(exposures.results)
    content["simulated"] = any(e.simulated for e in exposures.results.values())
    make_directories(mission.export_dir)
    text = json.dumps(content, indent=1) + "\n"
    replace_file(mission.export_dir / "certificate.json", text.encode("utf-8"))
    page = mission.export_dir / "certificate.html"
    replace_file(page, _page(content).encode("utf-8"))
    return content, page, exposures.failures


def _colour(image: VirtualImage) -> VirtualImage:
    return VirtualImage(
        image.colour_width_px,
        image.colour_height_px,
        image.pitch_um * image.colour_ratio,
        image.f_mm,
        1,
    )


def _page(content: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(c['name'])}</td><td>{c['principal_distance_mm']:.4f}</td>"
        f"<td>{c['principal_point_mm'][0]:.4f}, {c['principal_point_mm'][1]:.4f}</td>"
        f"<td>{c['width_px']} x {c['height_px']}</td><td>{c['pixel_size_um']:g}</td>"
        f"<td>{c['format_mm'][0]:.3f} x {c['format_mm'][1]:.3f}</td>"
        f"<td>{escape(', '.join(c['serial_numbers'])) or '&ndash;'}</td></tr>"
        for c in content["cameras"]
    )
    lenses = ", ".join(f"{name} {serial}" for name, serial in content["lenses"].items())
    simulated = (
        "<p><strong>SIMULATED: emulated hardware.</strong></p>" if content["simulated"] else ""
    )
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'><title>"
        f"{escape(content['camera'])}: camera "
        f"certificate</title><style>body{{font:15px/1.5 system-ui,"
        "sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}table{border-collapse:collapse}"
        "td,th{border-bottom:1px solid #8884;padding:.3rem .7rem;text-align:left}</style></head>"
        f"<body><h1>{escape(content['camera'])}</h1>{simulated}<p>Camera certificate of mission "
        f"{escape(content['mission'])}, {content['exposures']} exposures. Rig "
        f"{escape(content['rig'])}, calibration {escape(content['calibration']['id'])} of "
        f"{escape(content['calibration']['date'])}.</p><table><tr><th>image</th><th>principal "
        "distance mm</th><th>principal point x, y mm</th><th>pixels</th><th>pixel um</th>"
        "<th>format mm</th>"
        f"<th>serial numbers</th></tr>{rows}</table><p>Lenses: {escape(lenses) or '&ndash;'}.</p>"
        "<h2>Axes and signs</h2>"
        f"<p>{escape(content['axes'])}.</p><p>Distortion: none, it was removed when the images "
        f"were made.</p><h2>Validity</h2><p>Valid {escape(content['valid'])}.</p></body></html>\n"
    )
