"""Pix4D's geolocation, external camera parameters and internal parameters as text.

Positions and angles are in the coordinate system of the orientation, R = Rx(omega) Ry(phi)
Rz(kappa) in degrees, as Pix4D defines them.

Source: Pix4D support, "Input files", "How are yaw, pitch, roll and omega, phi, kappa defined".
"""

from __future__ import annotations

from typing import Final

from daemon.orientation.exterior_orientation import ExteriorOrientation
from daemon.postflight.exchange.block import Block, BlockError, BlockImage, fitted
from daemon.postflight.exchange.colmap import CENTRE_PX
from processing.geometry.forward_distortion import ForwardDistortion

EXTERNAL_HEADER: Final = "imageName X Y Z Omega Phi Kappa"


def pix4d_texts(block: Block, suffix: str) -> tuple[dict[str, str], dict[str, float]]:
    """Geolocation with accuracies, external parameters, and a camera file for each camera.

    Args:
        block: with orientations in a coordinate system.
        suffix: of the image files' names.

    Returns:
        Texts by file name, and the largest residual of each camera's fit by its name, px.

    Raises:
        BlockError: a camera does not fit, or an image has no orientation in a coordinate system.
    """
    if block.georeference is None:
        raise BlockError("Pix4D wants a coordinate system; that of this block is not known")
    residuals, texts = {}, {}
    for camera in block.cameras:
        _, model, residuals[camera.name] = fitted(camera, ("pinhole", "brown"))
        pitch_mm = camera.pitch_mm if camera.pitch_mm is not None else 1.0
        texts[f"{camera.name}.cam"] = camera_text(
            model, pitch_mm, camera.width_px, camera.height_px
        )
    geolocation, external = [], [EXTERNAL_HEADER]
    for image in block.images:
        eo = _oriented(image)
        place = [f"{value:.4f}" for value in eo.centre_m]
        angles = [f"{angle:.7f}" for angle in eo.omega_phi_kappa_deg]
        accuracy = ["", ""]
        if image.sigma_m is not None:
            accuracy = [f"{max(image.sigma_m[:2]):.4f}", f"{image.sigma_m[2]:.4f}"]
        geolocation.append(",".join([image.name + suffix, *place, *angles, *accuracy]))
        external.append(" ".join([image.name + suffix, *place, *angles]))
    texts["geolocation.csv"] = "\n".join(geolocation) + "\n"
    texts["external_camera_parameters.txt"] = "\n".join(external) + "\n"
    texts["coordinate_system.prj"] = block.georeference.crs.to_wkt("WKT1_GDAL") + "\n"
    return texts, residuals


def _oriented(image: BlockImage) -> ExteriorOrientation:
    if image.eo is None:
        raise BlockError(f"image {image.name} has no orientation in a coordinate system")
    return image.eo


def camera_text(model: ForwardDistortion, pitch_mm: float, width_px: int, height_px: int) -> str:
    """Pix4D's camera file: principal point from the upper left corner, radial and tangential."""
    width_mm, height_mm = width_px * pitch_mm, height_px * pitch_mm
    return "\n".join(
        [
            "Pix4D camera calibration file 0",
            f"#Focal Length mm assuming a sensor width of {width_mm:g}x{height_mm:g}mm",
            f"F {model.fx_px * pitch_mm!r}",
            "#Principal Point mm",
            f"Px {(model.cx_px + CENTRE_PX) * pitch_mm!r}",
            f"Py {(model.cy_px + CENTRE_PX) * pitch_mm!r}",
            "#Symmetrical Lens Distortion Coeffs",
            *(
                f"K{power} {value!r}"
                for power, value in enumerate((model.k1, model.k2, model.k3), 1)
            ),
            "#Tangential Lens Distortion Coeffs",
            f"T1 {model.p1!r}",
            f"T2 {model.p2!r}",
            "",
        ]
    )
