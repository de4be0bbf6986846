// Draws the profile across track: heights by strip, with axes and scale.
import { gestures } from "./gestures.js";
import { number } from "./feed.js";
import { stripColour } from "./strips.js";

const EDGE = { left: 58, right: 10, top: 8, bottom: 34 }; // for the axes' figures
const view = { acrossM: 0, upM: 0, closer: 1 };
let latest = null;
let zeroM = 0;
let canvas;

const quantile = (sorted, part) => sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))];

export function ticks(low, high, most) {
  const raw = (high - low) / most;
  const size = 10 ** Math.floor(Math.log10(raw));
  const step = size * [1, 2, 5, 10].find((times) => times * size >= raw);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

function extent(strips) {
  const across = strips.flatMap(([, strip]) => strip.across_m).sort((one, other) => one - other);
  const up = strips.flatMap(([, strip]) => strip.up_m).sort((one, other) => one - other);
  const low = quantile(up, 0.002);
  const high = quantile(up, 0.998);
  const room = Math.max(0.5, 0.1 * (high - low));
  return { west: across[0] - 2, east: across.at(-1) + 2, low: low - room, high: high + room };
}

// What the canvas shows, metres, and where in CSS pixels; the tests read it as the reader reads the axes.
function frameOf(strips) {
  const whole = extent(strips);
  const half = { across: (whole.east - whole.west) / 2 / view.closer, up: (whole.high - whole.low) / 2 / view.closer };
  const middle = { across: (whole.west + whole.east) / 2 + view.acrossM, up: (whole.low + whole.high) / 2 + view.upM };
  return {
    west: middle.across - half.across, east: middle.across + half.across, low: middle.up - half.up, high: middle.up + half.up,
    left: EDGE.left, top: EDGE.top, width: canvas.clientWidth - EDGE.left - EDGE.right, height: canvas.clientHeight - EDGE.top - EDGE.bottom,
  };
}

function axes(pen, frame, ink, edge) {
  pen.font = '13px system-ui, "DejaVu Sans", sans-serif';
  pen.lineWidth = 1;
  pen.strokeStyle = edge;
  pen.fillStyle = ink;
  const x = (m) => frame.left + ((m - frame.west) / (frame.east - frame.west)) * frame.width;
  const y = (m) => frame.top + ((frame.high - m) / (frame.high - frame.low)) * frame.height;
  const bottom = frame.top + frame.height;
  pen.strokeRect(frame.left + 0.5, frame.top + 0.5, frame.width, frame.height);
  pen.textAlign = "center";
  const across = ticks(frame.west, frame.east, frame.width / 70);
  for (const m of across.found) {
    pen.fillRect(x(m), bottom, 1, 4);
    const side = Math.abs(m) < 1e-9 ? "track" : number(Math.abs(m), across.digits);
    pen.fillText(side, x(m), bottom + 16);
  }
  pen.fillText("← left        metres across track        right →", frame.left + frame.width / 2, bottom + 31);
  pen.textAlign = "right";
  const up = ticks(frame.low + zeroM, frame.high + zeroM, frame.height / 30);
  for (const m of up.found) {
    pen.beginPath();
    pen.moveTo(frame.left, Math.round(y(m - zeroM)) + 0.5);
    pen.lineTo(frame.left + frame.width, Math.round(y(m - zeroM)) + 0.5);
    pen.stroke();
    pen.fillText(number(m, up.digits), frame.left - 5, y(m - zeroM) + 4);
  }
  return { x, y };
}

function draw() {
  if (!latest || !canvas.clientWidth) return;
  const strips = Object.entries(latest.strips).filter(([, strip]) => strip.across_m.length);
  if (!strips.length) return;
  const scale = devicePixelRatio;
  canvas.width = Math.round(canvas.clientWidth * scale);
  canvas.height = Math.round(canvas.clientHeight * scale);
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  const colours = getComputedStyle(canvas);
  const frame = frameOf(strips);
  const at = axes(pen, frame, colours.color, colours.borderColor);
  pen.save();
  pen.beginPath();
  pen.rect(frame.left, frame.top, frame.width, frame.height);
  pen.clip();
  const newest = Math.max(...strips.map(([name]) => Number(name)));
  for (const [name, strip] of strips) {
    pen.fillStyle = stripColour(Number(name));
    strip.across_m.forEach((m, index) => {
      const [x, y] = [at.x(m), at.y(strip.up_m[index])];
      if (Number(name) === newest) pen.fillRect(x - 1, y - 1, 2, 2);
      else { // a cross, so that strips are told apart without colours
        pen.fillRect(x - 3, y - 0.5, 6, 1);
        pen.fillRect(x - 0.5, y - 3, 1, 6);
      }
    });
  }
  pen.restore();
  const times = ((frame.east - frame.west) / frame.width) / ((frame.high - frame.low) / frame.height);
  canvas.dataset.frame = JSON.stringify(frame);
  canvas.dataset.times = String(times);
  canvas.dispatchEvent(new CustomEvent("drawn"));
}

export const redrawProfile = () => draw();

export function profileInWords(title) {
  if (!latest) return "No profile yet";
  const strips = Object.entries(latest.strips).filter(([, strip]) => strip.across_m.length);
  if (!strips.length) return "No points in the profile";
  const whole = extent(strips);
  const parts = strips.map(([name, strip]) => `${name === "0" ? "between strips" : `strip ${name}`}: ${number(strip.across_m.length)} points`);
  const times = Number(canvas.dataset.times ?? 0);
  return `From ${number(-whole.west)} m left to ${number(whole.east)} m right of the track, flown towards ${number(latest.track_deg)}°; ${title} ${number(whole.low + zeroM, 1)} to ${number(whole.high + zeroM, 1)} m`
    + `, drawn ${number(times, times < 10 ? 1 : 0)} times as high as wide. ${parts.join("; ")}.`;
}

export function showProfile(found, zero) {
  latest = found;
  zeroM = zero;
  draw();
}

export function prepareProfile(place) {
  canvas = place;
  gestures(canvas, {
    drag(x, y) {
      const frame = canvas.dataset.frame && JSON.parse(canvas.dataset.frame);
      if (!frame) return;
      view.acrossM -= (x * (frame.east - frame.west)) / frame.width;
      view.upM += (y * (frame.high - frame.low)) / frame.height;
      draw();
    },
    zoom(times) {
      view.closer = Math.max(1, Math.min(200, view.closer * times));
      draw();
    },
    reset() {
      Object.assign(view, { acrossM: 0, upM: 0, closer: 1 });
      draw();
    },
  });
}
