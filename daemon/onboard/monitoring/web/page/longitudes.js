// Longitudes of one flight next to each other: across the antimeridian the map needs 181° next to 179°, not -179°.

let reference = null;

// The longitude within 180° of the first one that this page had.
export function near(longitude) {
  if (!Number.isFinite(longitude)) return longitude;
  reference ??= longitude;
  return longitude + 360 * Math.round((reference - longitude) / 360);
}

// Places, latitude and longitude each.
export const nearPlaces = (places) => places?.map(([latitude, longitude]) => [latitude, near(longitude)]) ?? null;
