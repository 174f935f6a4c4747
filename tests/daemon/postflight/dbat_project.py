"""A project of DBAT to import: the published camera calibration with a script in other forms.

The measurements are those of the camera calibration that `test_adjusting` compares with its result.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from tests.daemon.postflight.test_adjusting import FOLDER

SCRIPT: Final = """<document dbat_script_version="1.0">
  <input base_dir="$HERE">
    <ctrl_pts>
      <file format="id,label,x,y,z,sxyz">reference/camcal-weighted.txt</file>
      <filter id="1003">remove</filter>
    </ctrl_pts>
    <check_pts>
      <file format="id,label,x,y,z,sxyz">reference/camcal-weighted.txt</file>
      <filter id="1003">keep</filter>
    </check_pts>
    <images><file format="id,path">images/images.txt</file></images>
    <image_pts><file format="id,im,x,y" sxy="0.5">marks.txt</file></image_pts>
    <cameras><file>camera.xml</file></cameras>
  </input>
  <operations>
    <operation min_rays="2">check_ray_count</operation>
    <operation><set_initial_values><io>loaded</io><op>loaded</op></set_initial_values></operation>
    <operation><set_bundle_estimate_params>
      <io><all>true</all><skew>false</skew><K3>false</K3></io>
      <eo><all>true</all></eo><op><all>default</all></op>
    </set_bundle_estimate_params></operation>
    <operation>bundle_adjustment</operation>
  </operations>
</document>
"""


def write_dbat_project(tmp_path: Path) -> Path:
    """The example with measurements as id, image, x, y, and the camera in its own file."""
    for name in ("images/images.txt", "reference/camcal-weighted.txt"):
        target = tmp_path / name
        target.parent.mkdir(parents=True)
        target.write_bytes((FOLDER / name).read_bytes())
    rows = [
        [cell.strip() for cell in line.split(",")]
        for line in (FOLDER / "measurements/markpts.txt").read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    (tmp_path / "marks.txt").write_text("".join(f"{p},{i},{x},{y}\n" for i, p, x, y, _ in rows))
    camera = (FOLDER / "result/c4040z.xml").read_text()
    # The result has an affinity, which a camera that begins an adjustment does not.
    camera = re.sub(r"<sensor>.*</sensor>", "<sensor>auto,5.43764</sensor>", camera)
    camera = re.sub(r"<aspect>.*</aspect>", "<aspect>1</aspect>", camera, count=1)
    (tmp_path / "camera.xml").write_text(camera)
    (tmp_path / "script.xml").write_text(SCRIPT)
    return tmp_path
