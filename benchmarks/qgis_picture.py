"""`python3 benchmarks/qgis_picture.py MISSION PNG`: GIS files and COGs of a mission in QGIS.

Run by the Python for which QGIS is installed (python3-qgis); nothing of Syntopic is imported. QGIS
loads each layer with the style that it finds in the GeoPackage, and draws one map of all.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path
from typing import Any

LAYERS = ("centres", "lines", "gaps", "footprints", "tie_points")
SIZE_PX = (900, 700)


def classes_of(renderer: Any) -> list[str]:
    """Values or ranges of a style with their colours."""
    if renderer.type() == "categorizedSymbol":
        return [
            f"{c.value() or 'other'} {c.symbol().color().name()}" for c in renderer.categories()
        ]
    if renderer.type() == "graduatedSymbol":
        return [
            f"{r.lowerValue():g} to {r.upperValue():g} {r.symbol().color().name()}"
            for r in renderer.ranges()
        ]
    return [renderer.symbol().color().name()]


def rasters_of(core: Any, mission: Path) -> dict[str, Any]:
    """COGs as QGIS reads them: bands with their colour interpretation, and how it shows them."""
    found = {}
    for path in sorted((mission / "export" / "cog").rglob("*.tif")):
        raster = core.QgsRasterLayer(str(path), path.name)
        provider = raster.dataProvider()
        found[path.name] = {
            "is_valid": raster.isValid(),
            "crs": raster.crs().authid(),
            "bands": [provider.colorInterpretationName(k + 1) for k in range(raster.bandCount())],
            "renderer": raster.renderer().type(),
        }
    return found


def draw(core: Any, layers: list[Any], png: Path) -> None:
    """One map of all layers, the first one on top, in web Mercator."""
    gui = importlib.import_module("qgis.PyQt.QtGui")
    settings = core.QgsMapSettings()
    settings.setLayers(layers)
    settings.setBackgroundColor(gui.QColor("white"))
    settings.setOutputSize(importlib.import_module("qgis.PyQt.QtCore").QSize(*SIZE_PX))
    settings.setDestinationCrs(core.QgsCoordinateReferenceSystem("EPSG:3857"))
    convert = core.QgsCoordinateTransform(
        layers[0].crs(), settings.destinationCrs(), core.QgsProject.instance()
    )
    extent = core.QgsRectangle()
    for layer in layers:
        if layer.featureCount():
            extent.combineExtentWith(convert.transformBoundingBox(layer.extent()))
    extent.scale(1.1)
    settings.setExtent(extent)
    job = core.QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    if not job.renderedImage().save(str(png)):
        sys.exit(f"{png}: cannot be written")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mission", type=Path)
    parser.add_argument("png", type=Path)
    arguments = parser.parse_args()
    core = importlib.import_module("qgis.core")
    application = core.QgsApplication([], False)
    application.initQgis()
    mission = arguments.mission.resolve()
    package = mission / "export" / "gis" / "mission.gpkg"
    layers = [core.QgsVectorLayer(f"{package}|layername={n}", n, "ogr") for n in LAYERS]
    content: dict[str, Any] = {"qgis": core.Qgis.QGIS_VERSION}
    content["layers"] = {
        layer.name(): {
            "is_valid": layer.isValid(),
            "features": layer.featureCount(),
            "classes": classes_of(layer.renderer()),
        }
        for layer in layers
    }
    document = f"/vsizip/{package.with_suffix('.kmz')}/doc.kml"
    whole = core.QgsVectorLayer(document, "kmz", "ogr")
    titles = [row.split("!!::!!")[1] for row in whole.dataProvider().subLayers()]
    content["kmz"] = {
        title: core.QgsVectorLayer(f"{document}|layername={title}", title, "ogr").featureCount()
        for title in titles
    }
    content["cogs"] = rasters_of(core, mission)
    draw(core, layers, arguments.png)
    print(json.dumps(content, indent=1))
    application.exitQgis()


if __name__ == "__main__":
    main()
