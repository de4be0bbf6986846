// A place that another page links to, as #at=east,north,size in metres: the map goes there and marks it.
/* global L */
let sought = "";
let mark;

export function seek(map) {
  const found = /^#at=(-?[\d.]+),(-?[\d.]+),([\d.]+)$/.exec(location.hash);
  if (!found || location.hash === sought) return;
  sought = location.hash;
  const [east, north, size] = found.slice(1).map(Number);
  document.getElementById("follow").setAttribute("aria-pressed", "false");
  mark?.remove();
  mark = L.circle([north, east], { radius: Math.max(0.6 * size, 20), color: "#b3261e", weight: 3, fill: false, interactive: false }).addTo(map);
  const reach = Math.max(size, 60);
  map.fitBounds([[north - reach, east - reach], [north + reach, east + reach]], { animate: false });
}
