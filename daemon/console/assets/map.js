// The map: a level plane in metres, east and north of live's origin; the library draws it as a simple image map.
/* global L */
import { listen, number, text } from "./feed.js";
import { seek } from "./seek.js";

const TILE = 256;
const LINE_COLOURS = { planned: "#5b6770", flying: "#0072b2", good: "#00598c", remarks: "#b36200", again: "#d7191c" };
const $ = (id) => document.getElementById(id);
const GRID_PIXELS = 90; // between two lines of the grid, at least
let map, painted, aircraft, trail, plan, behind, grid;
let origin = [0, 0]; // of the frame in metres of its coordinate system, which the grid's lines are counted in
let place = null; // of the background
let drawn = "";
let placed = false;
let written = ""; // when the map was, as the console tells it

const at = (east, north) => [north, east];

function makeTiles() {
  const Painted = L.GridLayer.extend({
    createTile(where, done) {
      const image = document.createElement("img");
      image.alt = "";
      image.onload = () => done(null, image);
      image.onerror = () => done(null, image);
      image.src = address(where);
      image.dataset.where = `${where.z}/${where.x}/${where.y}`;
      return image;
    },
  });
  return new Painted({ tileSize: TILE, minZoom: -7, maxZoom: 3, updateWhenZooming: false });
}

const address = (where) => `/tiles/${$("layer").value}/${where.z}/${where.x}/${where.y}.png?s=${written}`;

// The user's map; its squares lie as those of the painted one.
function makeBackground() {
  const Behind = L.GridLayer.extend({
    createTile(where, done) {
      const image = document.createElement("img");
      image.alt = "";
      image.onload = image.onerror = () => done(null, image);
      image.src = `/background/${where.z}/${where.x}/${where.y}.png?s=${place}`;
      return image;
    },
  });
  return new Behind({ tileSize: TILE, minZoom: -7, maxZoom: 3, updateWhenZooming: false, pane: "behind" });
}

function gridStep(zoom) {
  const least = GRID_PIXELS / 2 ** zoom;
  const size = 10 ** Math.floor(Math.log10(least));
  return size * [1, 2, 5, 10].find((times) => times * size >= least);
}

function makeGrid() {
  const Lines = L.GridLayer.extend({
    createTile(where) {
      const square = document.createElement("canvas");
      square.width = square.height = TILE;
      const pen = square.getContext("2d");
      pen.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--grid");
      const step = gridStep(where.z);
      const pixels = step * 2 ** where.z;
      const first = (at, shift) => Math.ceil((at + shift) / pixels) * pixels - shift - at;
      const [east, north] = origin.map((metres) => (metres % step) * 2 ** where.z);
      for (let x = first(where.x * TILE, east); x < TILE; x += pixels) pen.fillRect(Math.round(x), 0, 1, TILE);
      for (let y = first(where.y * TILE, -north); y < TILE; y += pixels) pen.fillRect(0, Math.round(y), TILE, 1);
      return square;
    },
  });
  return new Lines({ tileSize: TILE, minZoom: -7, maxZoom: 3, updateWhenZooming: false, pane: "behind" });
}

function showBehind(found) {
  const shown = found.background;
  const live = found.live;
  const counted = Array.isArray(live.origin) && !String(live.crs).includes("4978") ? [0, 1].map((axis) => live.origin[axis] * live.origin_unit_m[axis]) : [0, 0];
  if (counted[0] !== origin[0] || counted[1] !== origin[1]) {
    origin = counted;
    grid.redraw();
  }
  $("background").hidden = !shown;
  const wanted = shown && shown.place !== null && $("background").getAttribute("aria-pressed") === "true";
  if (wanted && shown.place !== place) {
    place = shown.place;
    behind.redraw();
  }
  for (const [layer, is] of [[behind, wanted], [grid, !wanted]]) if (map.hasLayer(layer) !== Boolean(is)) is ? map.addLayer(layer) : map.removeLayer(layer);
  text("attribution", wanted ? shown.attribution : "");
  showGridStep();
}

const showGridStep = () => text("grid-step", map.hasLayer(grid) ? `grid ${number(gridStep(map.getZoom()), gridStep(map.getZoom()) < 1 ? 1 : 0)} m` : "");

function refresh() {
  for (const tile of Object.values(painted._tiles)) {
    const fresh = new Image();
    const { coords, el } = tile;
    fresh.onload = () => {
      el.src = fresh.src;
    };
    fresh.src = address(coords);
  }
}

function drawPlan(found) {
  const geometry = found.drawn ?? {};
  const key = JSON.stringify([geometry, (found.lines.lines ?? []).map((line) => [line.name, line.state])]);
  if (key === drawn) return;
  drawn = key;
  plan.clearLayers();
  for (const rings of geometry.area ?? []) L.polygon(rings.map((ring) => ring.map(([e, n]) => at(e, n))), { color: "#5b6770", weight: 2, dashArray: "6 6", fill: false }).addTo(plan);
  for (const line of found.lines.lines ?? []) {
    const places = (geometry.lines ?? {})[line.name];
    if (!places) continue;
    const style = { color: LINE_COLOURS[line.state] ?? "#5b6770", weight: line.state === "flying" ? 5 : 3, dashArray: line.state === "planned" ? "4 6" : line.state === "again" ? "12 5" : null };
    const label = document.createElement("span");
    label.textContent = `${line.name}: ${line.state}`;
    L.polyline(places.map(([e, n]) => at(e, n)), style).bindTooltip(label).addTo(plan);
  }
}

function showAircraft(pose) {
  const place = at(pose.east_m, pose.north_m);
  const grid = (pose.map_heading_deg ?? pose.heading_deg) - pose.heading_deg; // from true north to the map's
  if (!aircraft) {
    aircraft = L.marker(place, { icon: plane(), interactive: false, keyboard: false, alt: "aircraft" }).addTo(map);
    trail = L.polyline([], { color: "#7b8790", weight: 2 }).addTo(map);
    map.setView(place, -1);
  }
  aircraft.setLatLng(place);
  aircraft.getElement()?.firstElementChild?.setAttribute("transform", `rotate(${pose.heading_deg + grid})`);
  trail.addLatLng(place);
  const points = trail.getLatLngs();
  if (points.length > 3600) trail.setLatLngs(points.slice(-3600));
  if ($("follow").getAttribute("aria-pressed") === "true") map.panTo(place, { animate: false });
  turn(pose.track_deg + grid);
}

function plane() {
  const svg = '<svg viewBox="-12 -12 24 24" width="36" height="36"><path class="aircraft" d="M0-11 2-3 11 3V5L2 3 1.500 8 4 10V11L0 10-4 11V10L-1.500 8-2 3-11 5V3L-2-3z"/></svg>';
  return L.divIcon({ html: svg, className: "", iconSize: [36, 36], iconAnchor: [18, 18] });
}

function turn(trackDeg) {
  const up = $("track-up").getAttribute("aria-pressed") === "true";
  const frame = $("map-frame");
  const degrees = up ? -trackDeg : 0;
  if (up && !frame.dataset.up) {
    const side = Math.ceil(Math.hypot(frame.parentElement.clientWidth, frame.parentElement.clientHeight));
    frame.style.width = frame.style.height = `${side}px`;
    frame.dataset.up = "1";
    map.dragging.disable();
    map.invalidateSize({ animate: false });
  } else if (!up && frame.dataset.up) {
    frame.style.width = frame.style.height = "";
    delete frame.dataset.up;
    map.dragging.enable();
    map.invalidateSize({ animate: false });
  }
  // not turned, its pixels are those of the screen: no seams between squares
  frame.style.transform = up ? `translate(-50%, -50%) rotate(${degrees}deg)` : "";
  $("north").style.transform = `rotate(${degrees}deg)`;
}

function showLegend(legend) {
  const place = $("legend");
  const one = legend?.[$("layer").value];
  const key = JSON.stringify(one ?? null);
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  place.replaceChildren();
  if (!one) return;
  const title = document.createElement("div");
  title.textContent = one.title;
  const bar = document.createElement("canvas");
  bar.width = 200;
  bar.height = 10;
  const pen = bar.getContext("2d");
  one.colours.forEach((colour, index) => {
    pen.fillStyle = colour;
    pen.fillRect((index * 200) / one.colours.length, 0, 200 / one.colours.length + 1, 10);
  });
  const ends = document.createElement("div");
  ends.className = "ends";
  for (const value of [one.low, one.high]) {
    const end = document.createElement("span");
    end.textContent = value;
    ends.append(end);
  }
  place.append(title, bar, ends);
  for (const [name, words] of one.also ?? []) {
    const row = document.createElement("div");
    row.className = name;
    row.append(document.createElement("i"), words);
    place.append(row);
  }
}

export function startMap() {
  map = L.map("map", { crs: L.CRS.Simple, minZoom: -7, maxZoom: 3, zoomControl: false, attributionControl: false, touchZoom: "center", renderer: L.canvas({ padding: 0.5 }) });
  map.setView([0, 0], -2);
  new ResizeObserver(() => map.invalidateSize({ animate: false })).observe($("map")); // also when the header grows
  const scale = L.control.scale({ imperial: false, maxWidth: 160 }).addTo(map);
  $("scale").append(scale.getContainer()); // beside the map, which may be turned
  $("zoom-in").addEventListener("click", () => map.zoomIn());
  $("zoom-out").addEventListener("click", () => map.zoomOut());
  map.createPane("behind").style.zIndex = 150;
  behind = makeBackground();
  grid = makeGrid().addTo(map);
  map.on("zoomend", showGridStep);
  new MutationObserver(() => grid.redraw()).observe(document.documentElement, { attributeFilter: ["data-night"] });
  painted = makeTiles().addTo(map);
  plan = L.layerGroup().addTo(map);
  const toggle = (id) => $(id).addEventListener("click", () => $(id).setAttribute("aria-pressed", String($(id).getAttribute("aria-pressed") !== "true")));
  toggle("follow");
  toggle("track-up");
  toggle("background");
  $("background").addEventListener("click", () => listen(showBehind, { once: true }));
  map.on("dragstart", () => $("follow").setAttribute("aria-pressed", "false"));
  $("track-up").addEventListener("click", () => $("follow").setAttribute("aria-pressed", "true"));
  $("layer").addEventListener("change", () => painted.redraw());
  listen((found) => {
    if (found.live.pose) showAircraft(found.live.pose);
    else if (found.extent_m && !placed) {
      const [west, south, east, north] = found.extent_m;
      map.fitBounds([at(west, south), at(east, north)]);
      placed = true;
    }
    showBehind(found);
    seek(map);
    drawPlan(found);
    showLegend(found.legend);
    if (found.map !== written) {
      written = found.map;
      refresh();
    }
    text("map-note", found.live_is_current || found.live.state ? found.background?.trouble ?? "" : "swath live does not run: no map");
  });
}
