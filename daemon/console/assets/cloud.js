// Draws the last minute's points as seen from a side, without perspective: each pixel shows the nearest point.
import { number } from "./feed.js";
import { gestures } from "./gestures.js";
import { stripColour } from "./strips.js";
import { ticks } from "./profile.js";

const HEAD = 24;
const ROW = 24;
const START = { azimuth: 20, elevation: 40, closer: 1, east: 0, north: 0 };
const view = { ...START };
const turned = (degrees) => (degrees * Math.PI) / 180;
let points = null;
let canvas;
let perPixel = 1; // pixels a metre
let colouring = { by: "height", ramp: ["#000000", "#ffffff"], zeroM: 0, times: 1 };

// Reads recent.bin: docs/live.md. Null: it is of another version, or cut off.
export function readPoints(buffer) {
  const data = new DataView(buffer);
  if (buffer.byteLength < HEAD || data.getUint32(0, false) !== 0x53575452 || data.getUint16(4, true) !== 1) return null;
  const [head, row, count] = [data.getUint16(6, true), data.getUint32(8, true), data.getUint32(12, true)];
  if (row !== ROW || buffer.byteLength !== head + row * count) return null;
  const found = { count, east: new Float32Array(count), north: new Float32Array(count), up: new Float32Array(count), intensity: new Float32Array(count), strip: new Uint16Array(count), seconds: 0 };
  for (let k = 0, at = head; k < count; k++, at += row) {
    found.east[k] = data.getFloat32(at, true);
    found.north[k] = data.getFloat32(at + 4, true);
    found.up[k] = data.getFloat32(at + 8, true);
    found.intensity[k] = data.getFloat32(at + 12, true);
    found.seconds = Math.max(found.seconds, data.getFloat32(at + 16, true));
    found.strip[k] = data.getUint16(at + 20, true);
  }
  return found;
}

function range(values, low, high) {
  const sorted = Float32Array.from(values).sort();
  const at = (part) => sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))];
  return [at(low), at(high)];
}

function measure(found) {
  found.range = { height: range(found.up, 0.02, 0.98), intensity: range(found.intensity, 0.02, 0.98) };
  found.edges = { east: range(found.east, 0, 1), north: range(found.north, 0, 1) };
  found.middle = ["east", "north"].map((axis) => (found.edges[axis][0] + found.edges[axis][1]) / 2);
  found.middle.push((found.range.height[0] + found.range.height[1]) / 2);
  found.side = Math.max(1, Math.hypot(found.edges.east[1] - found.edges.east[0], found.edges.north[1] - found.edges.north[0]));
}

const packed = (hex) => (0xff000000 | (parseInt(hex.slice(5, 7), 16) << 16) | (parseInt(hex.slice(3, 5), 16) << 8) | parseInt(hex.slice(1, 3), 16)) >>> 0;

function ramp(colours) {
  const stops = colours.map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  return Uint32Array.from({ length: 256 }, (_, step) => {
    const at = (step / 255) * (stops.length - 1);
    const low = Math.min(stops.length - 2, Math.floor(at));
    const [red, green, blue] = stops[low].map((value, band) => Math.round(value + (at - low) * (stops[low + 1][band] - value)));
    return (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0;
  });
}

function coloursOf() {
  if (colouring.by === "strip") {
    const known = new Map();
    return Uint32Array.from(points.strip, (strip) => {
      if (!known.has(strip)) known.set(strip, packed(stripColour(strip)));
      return known.get(strip);
    });
  }
  const steps = ramp(colouring.ramp);
  const [low, high] = points.range[colouring.by];
  const values = colouring.by === "height" ? points.up : points.intensity;
  return Uint32Array.from(values, (value) => steps[Math.max(0, Math.min(255, Math.round((255 * (value - low)) / Math.max(1e-6, high - low))))]);
}

// Right and up in the picture, and away from the eye, each as east, north, up.
function axesOf() {
  const [azimuth, elevation] = [turned(view.azimuth), turned(view.elevation)];
  const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
  return { right: [ca, -sa, 0], up: [se * sa, se * ca, ce], away: [ce * sa, ce * ca, -se] };
}

function draw() {
  if (!points?.count || !canvas.clientWidth) return;
  const scale = devicePixelRatio;
  const width = (canvas.width = Math.round(canvas.clientWidth * scale));
  const height = (canvas.height = Math.round(canvas.clientHeight * scale));
  const pen = canvas.getContext("2d");
  const image = pen.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const nearest = new Float32Array(width * height).fill(Infinity);
  const perM = (perPixel = (Math.min(width, 1.6 * height) / points.side) * view.closer);
  const { right, up, away } = axesOf();
  const [east, north, level] = [points.middle[0] + view.east, points.middle[1] + view.north, points.middle[2]];
  const colours = coloursOf();
  for (let k = 0; k < points.count; k++) {
    const [x, y, z] = [points.east[k] - east, points.north[k] - north, (points.up[k] - level) * colouring.times];
    const column = Math.floor(width / 2 + (right[0] * x + right[1] * y) * perM);
    const row = Math.floor(height / 2 - (up[0] * x + up[1] * y + up[2] * z) * perM);
    const far = away[0] * x + away[1] * y + away[2] * z;
    for (let at = row * width; at <= (row + 1) * width; at += width) { // two by two pixels a point
      for (let across = column; across <= column + 1; across++) {
        if (across < 0 || across >= width || at < 0 || at >= pixels.length || far >= nearest[at + across]) continue;
        nearest[at + across] = far;
        pixels[at + across] = colours[k];
      }
    }
  }
  pen.putImageData(image, 0, 0);
  scaleBar(pen, scale, perM, height);
  canvas.dataset.view = JSON.stringify({ ...view, perM, east, north, level, times: colouring.times });
}

function scaleBar(pen, scale, perM, height) {
  const size = ticks(0, (140 * scale) / perM, 3).found.at(-1);
  pen.fillStyle = getComputedStyle(canvas).color;
  pen.fillRect(10 * scale, height - 12 * scale, size * perM, 3 * scale);
  pen.font = `${13 * scale}px system-ui, "DejaVu Sans", sans-serif`;
  pen.fillText(`${number(size, size < 1 ? 2 : 0)} m`, 10 * scale, height - 18 * scale);
}

export const redrawCloud = () => draw();

export const seenStrips = () => (points ? [...new Set(points.strip)].sort((one, other) => one - other) : []);

export const rangeShown = () => points?.range[colouring.by] ?? null;

export function cloudInWords(title) {
  if (!points?.count) return "No points of the last minute yet";
  const sides = ["east", "north"].map((axis) => number(points.edges[axis][1] - points.edges[axis][0]));
  const [low, high] = points.range.height.map((up) => number(up + colouring.zeroM, 1));
  const towards = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"][Math.round(view.azimuth / 45) % 8];
  return `${number(points.count)} points of the last ${number(points.seconds)} s, thinned, ${sides[0]} m from west to east and ${sides[1]} m from south to north; ${title} ${low} to ${high} m`
    + `. Seen towards ${towards} from ${number(view.elevation)}° above the horizon${colouring.times === 1 ? "" : `, heights ${colouring.times} times as large`}.`;
}

export function colourCloud(wanted) {
  colouring = { ...colouring, ...wanted };
  draw();
}

export function showPoints(found) {
  points = found;
  if (points.count) measure(points);
  draw();
}

export function prepareCloud(place, onMove) {
  canvas = place;
  const moved = (change) => {
    change();
    draw();
    onMove();
  };
  gestures(canvas, {
    move: (x, y) => moved(() => {
      const { right, up } = axesOf();
      const [across, along] = [(x * devicePixelRatio) / perPixel, (y * devicePixelRatio) / perPixel / Math.max(0.2, Math.hypot(up[0], up[1])) ** 2];
      view.east += along * up[0] - across * right[0];
      view.north += along * up[1] - across * right[1];
    }),
    drag: (x, y) => moved(() => {
      view.azimuth = (view.azimuth - x / 3 + 360) % 360;
      view.elevation = Math.max(0, Math.min(90, view.elevation + y / 3));
    }),
    zoom: (times) => moved(() => {
      view.closer = Math.max(0.3, Math.min(60, view.closer * times));
    }),
    reset: () => moved(() => Object.assign(view, START)),
  });
  return { above: () => moved(() => Object.assign(view, { azimuth: 0, elevation: 90 })), reset: () => moved(() => Object.assign(view, START)) };
}
