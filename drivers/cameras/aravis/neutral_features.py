"""Features that are switched off before a head is configured, since they falsify its frames.

Automatic functions change exposure and gain from frame to frame and lock the features that set
them. Processing inside the head (gamma, sharpening, look-up tables, defect correction) changes
radiometry; mirroring, binning, decimation, offsets and test patterns change geometry.

Source: GenICam SFNC 2.7 for the standard names; the descriptions of Allied Vision, Basler,
FLIR and Point Grey heads for the others. Names of JAI: roboception/rc_genicam_camera#4, and the
GO-X series manual. Names of Hikrobot: its MVS client, "GigE Area Scan Camera User Manual", section
12.2. `flatfieldCorrectionMode`: Teledyne DALSA Linea manual, "Flat Field Category";
`turboTransferEnable`: Genie Nano manual, "TurboDrive". `AutoGain`: examples of Emergent's eSDK.
Names of Daheng: enumeration of features in examples of its Galaxy SDK for MERCURY GigE heads.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from drivers.cameras.aravis.feature_access import FeatureError, Features
from drivers.cameras.aravis.presets import FeatureValue

NEUTRAL: Final[tuple[tuple[str, FeatureValue], ...]] = (
    ("SequencerMode", "Off"),
    ("SequenceEnable", False),
    ("TransferControlMode", "Basic"),
    ("GenDCStreamingMode", "Off"),
    ("turboTransferEnable", False),
    ("HDRMode", "Off"),
    ("pgrHDRModeEnabled", False),
    ("HDREnable", False),
    ("MultiRoiMode", "Off"),
    ("ExposureModeOption", "Off"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("BalanceRatioAuto", "Off"),
    ("SharpnessAuto", "Off"),
    ("ContrastAuto", "Off"),
    ("HueAuto", "Off"),
    ("SaturationAuto", "Off"),
    ("IrisAuto", "Off"),
    ("AutoGain", False),
    ("pgrExposureCompensationAuto", "Off"),
    ("AcquisitionFrameRateAuto", "Off"),
    ("AcquisitionFrameRateEnable", False),
    ("AcquisitionFrameRateEnabled", False),
    ("AcquisitionFrameRateMode", "Off"),
    ("GammaEnable", False),
    ("GammaEnabled", False),
    ("Gamma", 1.0),
    ("SharpeningEnable", False),
    ("SharpnessEnable", False),
    ("SharpnessEnabled", False),
    ("SharpnessMode", "Off"),
    ("ContrastEnable", False),
    ("HueEnabled", False),
    ("SaturationEnable", False),
    ("SaturationEnabled", False),
    ("SaturationMode", "Off"),
    ("NoiseReductionEnable", False),
    ("DenoisingEnable", False),
    ("DigitalNoiseReductionMode", "Off"),
    ("NoiseReductionMode", "Off"),
    ("LUTEnable", False),
    ("LUTMode", "Off"),
    ("GradationCompressionMode", "Off"),
    ("EnhancerEnable", False),
    ("EdgeEnhancerEnable", False),
    ("ColorEnhancerEnable", False),
    ("DigitalShiftEnable", False),
    ("DigitalShift", 0),
    ("ColorTransformationEnable", False),
    ("ColorTransformationMode", "Off"),
    ("ColorTransformationRGBMode", "Off"),
    ("RgbTransformLightSource", "Off"),
    ("OnBoardColorProcessEnabled", False),
    ("ProcessedRawEnable", False),
    ("FlatFieldCorrection", "Off"),
    ("flatfieldCorrectionMode", "Off"),
    ("FfcEnable", False),
    ("NUCEnable", False),
    ("FPNCEnable", False),
    ("PRNUCEnable", False),
    ("ShadingEnable", False),
    ("ShadingMode", "Off"),
    ("LensShadingCorrectionMode", "Off"),
    ("VignettingCorrectionMode", "Off"),
    ("CorrectionMode", "Off"),
    ("DefectCorrectionEnable", False),
    ("DefectCorrectStaticEnable", False),
    ("DefectMaskEnable", False),
    ("BlemishEnable", False),
    ("PixelDefectControl", "Off"),
    ("DeadPixelCorrect", "Off"),
    ("StaticDefectCorrection", "Off"),
    ("FixedPatternNoiseCorrectMode", "Off"),
    ("BSLPixelDefectCorrectionMode", "Off"),
    ("BslStaticDefectPixelCorrectionMode", "Off"),
    ("pgrDefectPixelCorrectionEnable", False),
    ("TestPattern", "Off"),
    ("TestImageSelector", "Off"),
    ("TestPatternGeneratorSelector", "Off"),
    ("OverlayMode", "Off"),
    ("FrameSpecInfo", False),
    ("ImageCompressionMode", "Off"),
    ("AdaptiveCompressionEnable", False),
    ("pgrPixelBigEndian", False),
    ("GevSCPSBigEndian", False),
    ("DeviceStreamChannelEndianness", "Little"),
    ("ReverseX", False),
    ("ReverseY", False),
    ("ImageScalingMode", "Off"),
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    ("CenterX", False),
    ("CenterY", False),
    ("OffsetX", 0),
    ("OffsetY", 0),
)
"""Feature and its neutral value, in the order in which they are written."""
OFF: Final = ("Off", "OFF", "False", "Disable", "Disabled", "None", "Manual")
"""Entries that switch a feature off."""
ENTRIES: Final[Mapping[str, tuple[str, ...]]] = {"TransferControlMode": ("Basic", "Automatic")}
"""Entries of other features; with one that is not among them, frames wait for a command."""
PASSES: Final = 2
# Quirk: heads lock the processing of colour images while they send monochrome or Bayer images. It
# has no effect then, so a locked feature is no refusal.
# Upstream: manual: GenICam description PGR_Blackfly_50S5C, OBCPLocked_Int.
WITHOUT_EFFECT_WHILE_LOCKED: Final = frozenset(
    {"OnBoardColorProcessEnabled", "HueEnabled", "SaturationEnabled", "SharpnessEnabled"}
    | {"SaturationEnable", "ColorTransformationEnable", "RgbTransformLightSource"}
    | {"ColorTransformationRGBMode", "ColorEnhancerEnable"}
)
"""Processing of colour images."""
SELECTED: Final[Mapping[str, str]] = {
    "BinningHorizontal": "BinningSelector",
    "BinningVertical": "BinningSelector",
    "FrameSpecInfo": "FrameSpecInfoSelector",
    "EnhancerEnable": "EnhancerSelector",
}
"""Selectors whose entries each have a value of the feature."""
GATED: Final[Mapping[str, tuple[str, ...]]] = {
    "Gamma": ("GammaEnable", "GammaEnabled", "LUTMode"),
    "DigitalShift": ("DigitalShiftEnable",),
}
"""Features that have no effect while one of these switches exists and is off."""


def switch_off(
    features: Features, chosen: Collection[str]
) -> tuple[dict[str, FeatureValue], list[str]]:
    """Write the neutral value of every feature in `NEUTRAL` that the head offers.

    Args:
        features: the head's features.
        chosen: features whose value the configuration states; they are left alone.

    Returns:
        The values that the head now holds, and one sentence for each feature that keeps another.
    """
    held: dict[str, FeatureValue] = {}
    waiting = [name for name, _ in NEUTRAL if name not in chosen]
    refused: dict[str, str] = {}
    # A feature may be locked by one that stands later in the list.
    for _ in range(PASSES):
        refused = {}
        for name in waiting:
            try:
                _switch_off_one(features, name, held)
            except FeatureError as error:
                if not (name in WITHOUT_EFFECT_WHILE_LOCKED and features.is_locked(name)):
                    refused[name] = str(error)
        waiting = list(refused)
    return held, [
        f"{reason}; switch {name} off in the head, or state its value under features"
        for name, reason in refused.items()
    ]


def _switch_off_one(features: Features, name: str, held: dict[str, FeatureValue]) -> None:
    """Write the neutral value of a feature, of each entry of its selector where it has one."""
    selector = SELECTED.get(name, "")
    places = features.entries(selector) if selector else []
    before = features.text(selector) if places else ""
    # The entry that is selected comes last, so that it stays selected.
    for place in sorted(places, key=lambda entry: entry == before) or [""]:
        if place and features.is_writable(selector):
            features.set(selector, place)
        wanted = _wanted(features, name)
        if wanted is not None:
            held[name] = features.set(name, wanted)


def _wanted(features: Features, name: str) -> FeatureValue | None:
    """The neutral value of a feature; None if it is absent or has no effect."""
    if not features.is_available(name):
        return None
    if any(features.text(switch) in ("False", "Off") for switch in GATED.get(name, ())):
        return None
    return _neutral(features, name, dict(NEUTRAL)[name])


def _neutral(features: Features, name: str, value: FeatureValue) -> FeatureValue | None:
    """The neutral value in the type of this head's feature; None if it has none."""
    kind = features.kind(name)
    if kind == "enumeration":
        numbered = (str(value), f"X{value}", f"{name}{value}")
        wanted = OFF if value in (False, "Off") else ENTRIES.get(name, numbered)
        found = features.first_entry(name, wanted)
        if found is None and features.text(name) == "Continuous":
            offered = ", ".join(features.entries(name))
            raise FeatureError(
                f"{name} is Continuous and cannot be switched off (it has {offered})"
            )
        return found
    if kind == "boolean":
        return False if value in (False, "Off") else None
    if kind in ("integer", "float") and not isinstance(value, str):
        low, high = features.bounds(name)
        neutral = float(value) if kind == "float" else int(value)
        return neutral if low <= neutral <= high else None
    return None
