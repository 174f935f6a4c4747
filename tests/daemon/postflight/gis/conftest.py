"""One flown mission with COGs, a plan and a triangulation, exported once."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daemon.cli import app
from daemon.orientation.local_frame import LocalFrame
from daemon.postflight.adjustment.csv_tables import write_table
from daemon.postflight.adjustment.project import SIGMAS, XYZ
from tests.daemon.postflight.exchange.flown_block import FLIGHT, FlownBlock, fly

CRS = "EPSG:32633"
GROUND_M = 395.0


@dataclass(frozen=True)
class Exported:
    """The mission and what `export stac` and `export gis` printed."""

    flown: FlownBlock
    stac: dict
    gis: dict


def run(*arguments: str) -> dict:
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, done.output + repr(done.exception)
    return json.loads(done.stdout)


def tie_points(folder: Path) -> np.ndarray:
    """A triangulation with 40 points in the west of its area and 4 in the east; (n, 2) degrees."""
    folder.mkdir(parents=True)
    place = FLIGHT.geodetic(FLIGHT.pose(1_479_300_000_000_000_000 + 5 * 10**9).position_enu_m)
    frame = LocalFrame(place[0], place[1])
    rng = np.random.default_rng(4)
    xyz = np.vstack(
        [
            np.column_stack([rng.uniform(0, 10, 40), rng.uniform(0, 10, 40), np.full(40, 395.0)]),
            [[0, 0, 395.0], [200, 0, 395.0], [195, 5, 395.0], [199, 9, 395.0]],
        ]
    )
    rows = [(f"t{k}", *map(float, point), 0.1, 0.1, 0.1, "3") for k, point in enumerate(xyz)]
    rows.append(("t99", 900.0, 900.0, 395.0, 0.1, 0.1, 0.1, "0"))
    rows.append(("control", 900.0, 900.0, 395.0, 0.1, 0.1, 0.1, "4"))
    write_table(folder / "adjusted_points.csv", "t", ("point", *XYZ, *SIGMAS, "rays"), rows)
    frame_json = {"latitude_deg": place[0], "longitude_deg": place[1]}
    (folder / "frame.json").write_text(json.dumps(frame_json))
    return frame.to_geodetic(xyz)[:, :2]


@pytest.fixture(scope="session")
def exported(tmp_path_factory) -> Exported:
    pytest.importorskip("rasterio", reason="pip install 'syntopic[geotiff]'")
    folder = tmp_path_factory.mktemp("gis") / "mission"
    flown = fly(folder, "ultracam-l-mini", seconds=(5.0, 7.0, 9.0), lens="f_number = 5.6")
    places = [FLIGHT.geodetic(FLIGHT.pose(m).position_enu_m) for m in flown.marks.values()]
    line = [[longitude, latitude] for latitude, longitude, _ in (places[0], places[-1])]
    plan = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {"id": "planned 1"},
                "geometry": {"type": "LineString", "coordinates": line},
            }
        ],
    }
    (folder / "plan.geojson").write_text(json.dumps(plan))
    verdicts = ("good", "refly", "usable")
    for number, verdict in enumerate(verdicts, 1):
        finding = {"sentence": "The image is blurred.", "flag": "BLUR", "verdict": "refly"}
        report = {"verdict": verdict, "findings": [finding] if verdict == "refly" else []}
        (folder / f"L2/{number:06d}/quality.json").write_text(json.dumps(report))
    tie_points(folder / "export/triangulation/pan")
    options = ("--trajectory", str(flown.trajectory), "--crs", CRS)
    run("export", "pictures", str(folder), "--as", "cog", *options)
    gis = run("export", "gis", str(folder), *options)
    stac = run("export", "stac", str(folder), "--license", "CC-BY-4.0", *options)
    return Exported(flown, stac, gis)
