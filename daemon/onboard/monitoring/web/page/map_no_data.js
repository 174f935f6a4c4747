// Parts of an image without valid pixels, such as those of a lost head, hatched at their place on the map.

const HATCH = "no-data-hatch";
const HATCH_PX = 6;

// A place of the image on the ground, bilinear between the corners: lower left, lower right, upper right, upper left.
function placeOf([lowerLeft, lowerRight, upperRight, upperLeft], right, down) {
  const between = (a, b, share) => [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])];
  return between(between(upperLeft, upperRight, right), between(lowerLeft, lowerRight, right), down);
}

// Rings of the parts without data, of any band. Boxes of the area are [first column, first row, last column + 1, last row + 1].
export function noDataRings(footprint, area) {
  if (footprint?.length !== 4 || !(area?.columns > 0) || !(area?.rows > 0)) return [];
  return Object.values(area.gaps || {}).flat().map(([left, top, right, bottom]) =>
    [[left, top], [right, top], [right, bottom], [left, bottom]]
      .map(([column, row]) => placeOf(footprint, column / area.columns, row / area.rows)));
}

// The pattern of the hatch: a fill that no colour of a verdict has.
function addHatch(container) {
  const svg = (name, attributes) => {
    const created = L.SVG.create(name);
    for (const [key, value] of Object.entries(attributes)) created.setAttribute(key, value);
    return created;
  };
  const pattern = svg("pattern", { id: HATCH, width: HATCH_PX, height: HATCH_PX, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" });
  pattern.append(svg("line", { y2: HATCH_PX, stroke: "currentColor", "stroke-width": 3 }));
  const definitions = svg("svg", { width: 0, height: 0, "aria-hidden": "true", class: "hatch" });
  definitions.append(pattern);
  container.append(definitions);
}

export function startNoData(map, feed) {
  addHatch(document.getElementById("map"));
  const drawn = new Map();
  const drop = (number) => {
    drawn.get(number).layer?.remove();
    drawn.delete(number);
  };
  feed.subscribe((record, isFirstRecord) => {
    if (!record?.exposures && !isFirstRecord) return;
    const { exposures } = feed.flight;
    for (const number of [...drawn.keys()]) if (isFirstRecord || !exposures.has(number)) drop(number);
    for (const one of exposures.values()) {
      const rings = noDataRings(one.footprint, one.valid_area);
      const key = rings.length ? JSON.stringify(rings) : "";
      if ((drawn.get(one.number)?.key ?? "") === key) continue;
      if (drawn.has(one.number)) drop(one.number);
      if (!key) continue;
      const layer = L.polygon(rings.map((ring) => [ring]),
        { className: "no-data", fillColor: `url(#${HATCH})`, fillOpacity: 1, weight: 1, interactive: false }).addTo(map);
      drawn.set(one.number, { key, layer });
    }
  });
}
