"""One sentence for a head without what a triggered frame needs, with the kind of the device.

Source: GenICam SFNC 2.7, chapters 2 and 27 to 30 (modules of a GenTL producer); CoaXPress 2.1,
section 12.3 (bootstrap registers).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from drivers.cameras.aravis.feature_access import Features

MODULES: Final = (("TLID", "system"), ("InterfaceID", "interface"), ("StreamID", "data stream"))
"""Features that identify the modules of a frame grabber."""
GIGE_VISION: Final = (
    *("GevCurrentIPAddress", "GevHeartbeatTimeout", "GevVersionMajor", "GevMACAddress"),
    *("GevSCDA", "GevStreamChannelCount"),
)
"""Without GevSCPSPacketSize and GevSCPD, which Aravis adds to every description."""
USB3_VISION: Final = (
    *("U3VMaxDeviceResponseTime", "U3VDeviceCapability", "U3VAccessPrivilege"),
    *("U3VVersionMajor", "U3VMessageChannelID"),
)
COAXPRESS: Final = (
    *("CxpLinkConfiguration", "CxpConnectionSelector", "ConnectionConfig", "MasterHostLinkID"),
    *("MasterHostConnectionID", "Image1StreamID", "Img1StreamId"),
)
CAMERA_LINK: Final = ("ClConfiguration", "DeviceTapGeometry")
FRAME_GRABBER_LINKS: Final = ((COAXPRESS, "CoaXPress"), (CAMERA_LINK, "Camera Link"))


def missing_sentence(features: Features, missing: Sequence[str]) -> str:
    """What a head is, what it does not have, and the remedy.

    Args:
        features: the head's features.
        missing: what it does not have, such as `no feature Width`; not empty.

    Returns:
        One sentence.
    """

    def has_any(names: Sequence[str]) -> bool:
        return any(features.kind(name) is not None for name in names)

    module = next((what for name, what in MODULES if features.kind(name) is not None), "")
    if module and features.kind("AcquisitionStart") is None:
        return (
            f"the head is the {module} module of a frame grabber, which is no camera and has no "
            "command AcquisitionStart; choose a GigE Vision or USB3 Vision head"
        )
    what = " and ".join(filter(None, (", ".join(missing[:-1]), missing[-1])))
    if not has_any(GIGE_VISION) and not has_any(USB3_VISION):
        for names, link in FRAME_GRABBER_LINKS:
            if has_any(names):
                return (
                    f"the head is a {link} camera, which needs a frame grabber, and has {what}; "
                    "choose a GigE Vision or USB3 Vision head"
                )
    is_usb = has_any(USB3_VISION) and not has_any(GIGE_VISION)
    kind = "is a USB3 Vision camera and " * is_usb
    return f"the head {kind}has {what}, so it cannot be used; choose another head"
