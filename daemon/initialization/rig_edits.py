"""Changing a rig file as text: a proposed virtual image is written in, comments stay.

The changed text is read again and compared with what was to be written.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from daemon import DaemonError
from processing.geometry.image_proposal import ImageProposal
from processing.rig import Rig, RigError, rig_from_mapping
from processing.rig.toml_text import TomlError, parse_toml

_KEY: Final = re.compile(
    r"^(?P<key>[A-Za-z_]+)\s*=\s*(?P<value>\[[^\]#]*\]|\"[^\"]*\")(?P<rest>.*)$"
)
_TABLE: Final = re.compile(r"^\[+(?P<name>[^\]]+)\]+")
_SAME: Final = 1e-8


class RigEditError(DaemonError, ValueError):
    """A rig file whose text cannot be changed; the message states why."""


def with_virtual_image(text: str, proposal: ImageProposal, *, written_by: str) -> str:
    """The text of a rig file with a proposed virtual image.

    The master cone becomes a comment, rotations and places of the cones are replaced, and
    `[virtual_image]` is inserted before the first cone. All other lines stay.

    Args:
        text: of the rig file.
        proposal: made from it.
        written_by: the command, for the comment.

    Raises:
        RigEditError: the file is written in another form than a key a line.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    cones = {cone.name: cone for cone in proposal.rig.cones}
    lines, table, cone = [], "", -1
    order = [c.name for c in proposal.rig.cones]
    inserted = False
    for line in text.splitlines():
        heading = _TABLE.match(line)
        if heading:
            table = heading["name"].strip()
            if table == "cone":
                cone += 1
                if not inserted:
                    lines += [*_image_lines(proposal, written_by), ""]
                    inserted = True
        key = _KEY.match(line)
        if key and not table and key["key"] == "master_cone":
            lines.append(f"# {line}  replaced by the virtual camera of [virtual_image]")
            continue
        if key and table == "cone" and key["key"] in ("rotation_rad", "position_mm"):
            own = cones[order[cone]]
            values = own.rotation_rad if key["key"] == "rotation_rad" else own.position_mm
            digits = 9 if key["key"] == "rotation_rad" else 4
            listed = ", ".join(repr(round(value, digits) or 0.0) for value in values)
            lines.append(f"{key['key']} = [{listed}]{key['rest']}")
            continue
        if table == "cone" and "against the master" in line and line.lstrip().startswith("#"):
            line = "# omega, phi, kappa against the virtual camera"
        lines.append(line)
    changed = newline.join(lines) + newline
    _verify(changed, proposal.rig)
    return changed


def _image_lines(proposal: ImageProposal, written_by: str) -> list[str]:
    image = proposal.image
    overlaps = [
        f"# {' and '.join(o.heads)} overlap by {o.width_px:.0f} x {o.length_px:.0f} px, "
        f"{o.share:.0%}"
        for o in proposal.overlaps
    ]
    return [
        f"# Proposed by `{written_by}`: the largest rectangle that the heads cover together,",
        f"# {proposal.covered:.0%} of what they see. There is no master cone: angles and places of",
        "# the cones refer to a virtual camera in the middle of their axes.",
        *overlaps,
        "[virtual_image]",
        f"width_px = {image.width_px}",
        f"height_px = {image.height_px}",
        f"pitch_um = {image.pitch_um!r}      # the largest of the heads",
        f"f_mm = {image.f_mm!r}         # the mean of the heads",
    ]


def _verify(text: str, wanted: Rig) -> None:
    try:
        found = rig_from_mapping(parse_toml(text.encode("utf-8")), "rig.toml")
    except (RigError, TomlError) as error:
        raise RigEditError(
            f"the rig file cannot be changed line by line ({error}); write one key a line"
        ) from error
    same = (
        found.virtual_image == wanted.virtual_image
        and found.master_cone is None
        and len(found.cones) == len(wanted.cones)
        and all(
            np.allclose(a.rotation_rad, b.rotation_rad, atol=_SAME)
            and np.allclose(a.position_mm, b.position_mm, atol=1e-3)
            and (a.lens, a.sensors, a.name) == (b.lens, b.sensors, b.name)
            for a, b in zip(found.cones, wanted.cones, strict=True)
        )
    )
    if not same:
        raise RigEditError(
            "the rig file cannot be changed line by line: write master_cone, rotation_rad and "
            "position_mm on lines of their own, and cones as [[cone]]"
        )
