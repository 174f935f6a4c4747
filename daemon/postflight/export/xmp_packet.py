"""The XMP packet of an exported picture, in the properties that photogrammetric programs read.

Pix4D's `Camera` namespace (attitude, accuracies, bands, rig), positions' accuracies and the
aircraft's attitude in DJI's, EXIF's body serial, and our own. Gimbal angles of DJI are left out:
readers take their pitch as -90 degrees at nadir, and only from cameras of DJI.

Source: Adobe XMP specification, part 3; Pix4D support, "Specifications for XMP tags"; MicaSense
knowledge base, "Image metadata".
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.sax.saxutils import escape, quoteattr

if TYPE_CHECKING:
    from daemon.postflight.export.exif import PictureMetadata

XMP_NAMESPACE = "urn:syntopic:exposure:1"
CAMERA_NAMESPACE = "http://pix4d.com/camera/1.0/"
DJI_NAMESPACE = "http://www.dji.com/drone-dji/1.0/"
TIFF_NAMESPACE = "http://ns.adobe.com/tiff/1.0/"


def xmp_bytes(shot: PictureMetadata) -> bytes:
    """The packet as UTF-8.

    Args:
        shot: metadata of the picture.

    Returns:
        The packet with its wrapper.
    """
    attributes = [f"Camera:{key}={quoteattr(value)}" for key, value in _camera(shot).items()]
    attributes += [f"drone-dji:{key}={quoteattr(value)}" for key, value in _dji(shot).items()]
    attributes += [f"tiff:{key}={quoteattr(value)}" for key, value in _tiff(shot).items()]
    attributes += [f"syntopic:{key}={quoteattr(value)}" for key, value in _own(shot).items()]
    body = "\n   ".join(attributes)
    lists = "".join(_sequence(f"Camera:{name}", values) for name, values in _bands(shot).items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        f'  <rdf:Description rdf:about="" xmlns:Camera="{CAMERA_NAMESPACE}" '
        f'xmlns:drone-dji="{DJI_NAMESPACE}" xmlns:tiff="{TIFF_NAMESPACE}" '
        f'xmlns:syntopic="{XMP_NAMESPACE}"\n   {body}>\n{lists}'
        "  </rdf:Description>\n </rdf:RDF>\n</x:xmpmeta>\n"
        '<?xpacket end="w"?>'
    ).encode()


def _camera(shot: PictureMetadata) -> dict[str, str]:
    yaw, pitch, roll = shot.yaw_pitch_roll_deg
    camera = {
        "Yaw": f"{yaw:.6f}",
        "Pitch": f"{pitch:.6f}",
        "Roll": f"{roll:.6f}",
        "PerspectiveFocalLength": f"{shot.f_mm:.6f}",
        "PerspectiveFocalLengthUnits": "mm",
        "HorizCS": "EPSG:4326",
        "VertCS": "ellipsoidal",
    }
    if shot.is_perspective:
        camera["ModelType"] = "perspective"
        camera["PrincipalPoint"] = ",".join(
            f"{side_px * shot.pixel_um * 5e-4:.6f}" for side_px in (shot.width_px, shot.height_px)
        )
        camera["PerspectiveDistortion"] = "0,0,0,0,0"
    elif shot.principal_point_px is not None:
        camera["PrincipalPoint"] = ",".join(
            f"{(place_px + 0.5) * shot.pixel_um * 1e-3:.6f}" for place_px in shot.principal_point_px
        )
    if shot.position_sigma_m is not None:
        camera["GPSXYAccuracy"] = f"{shot.position_sigma_m:.4f}"
    if shot.height_sigma_m is not None:
        camera["GPSZAccuracy"] = f"{shot.height_sigma_m:.4f}"
    if shot.roll_pitch_yaw_sigma_deg is not None:
        names = ("IMURollAccuracy", "IMUPitchAccuracy", "IMUYawAccuracy")
        camera |= {
            name: f"{sigma:.6f}"
            for name, sigma in zip(names, shot.roll_pitch_yaw_sigma_deg, strict=True)
        }
    if shot.rig is not None:
        camera |= {
            "RigName": shot.rig.name,
            "RigCameraIndex": str(shot.rig.index),
            "RigRelativesReferenceRigCameraIndex": str(shot.rig.reference),
            "RigRelatives": ",".join(
                f"{round(angle, 6) + 0.0:.6f}" for angle in shot.rig.relatives_deg
            ),
            "CaptureUUID": shot.rig.capture,
        }
    return camera


def _bands(shot: PictureMetadata) -> dict[str, tuple[str, ...]]:
    """Lists, one value a band: readers of several bands want them in the order of the planes."""
    lists = {"BandName": tuple(shot.bands)}
    if shot.wavelengths_nm:
        lists["CentralWavelength"] = tuple(f"{value:g}" for value in shot.wavelengths_nm)
    return {name: values for name, values in lists.items() if values}


def _sequence(name: str, values: tuple[str, ...]) -> str:
    items = "".join(f"<rdf:li>{escape(value)}</rdf:li>" for value in values)
    return f"   <{name}><rdf:Seq>{items}</rdf:Seq></{name}>\n"


def _dji(shot: PictureMetadata) -> dict[str, str]:
    yaw, pitch, roll = shot.yaw_pitch_roll_deg
    dji = {
        "GpsLatitude": f"{shot.latitude_deg:.10f}",
        "GpsLongitude": f"{shot.longitude_deg:.10f}",
        "AbsoluteAltitude": f"{shot.height_m:+.4f}",
        "FlightYawDegree": f"{(yaw + 180.0) % 360.0 - 180.0:+.4f}",
        "FlightPitchDegree": f"{pitch:+.4f}",
        "FlightRollDegree": f"{roll:+.4f}",
    }
    if shot.position_sigma_m is not None and shot.height_sigma_m is not None:
        dji |= {
            "RtkStdLat": f"{shot.position_sigma_m:.5f}",
            "RtkStdLon": f"{shot.position_sigma_m:.5f}",
            "RtkStdHgt": f"{shot.height_sigma_m:.5f}",
        }
    return dji


def _tiff(shot: PictureMetadata) -> dict[str, str]:
    return {"Make": "Syntopic", "Model": shot.camera}


def _own(shot: PictureMetadata) -> dict[str, str]:
    omega, phi, kappa = shot.omega_phi_kappa_deg
    return {
        "GpsNanoseconds": str(shot.gps_ns),
        "Crs": shot.crs,
        "East": f"{shot.centre_m[0]:.4f}",
        "North": f"{shot.centre_m[1]:.4f}",
        "Height": f"{shot.centre_m[2]:.4f}",
        "EllipsoidalHeight": f"{shot.height_m:.4f}",
        "Omega": f"{omega:.7f}",
        "Phi": f"{phi:.7f}",
        "Kappa": f"{kappa:.7f}",
        "AngleOrder": "R = Rx(omega) Ry(phi) Rz(kappa), camera to grid, degrees",
        "PixelSizeMicrometres": f"{shot.pixel_um:.6f}",
        "Remark": shot.remark,
    }
