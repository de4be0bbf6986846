// The panel of the data: profile across track, recent points, overlap of the present strip with those before it.
import { cloudInWords, colourCloud, prepareCloud, rangeShown, readPoints, redrawCloud, seenStrips, showPoints } from "./cloud.js";
import { number, text } from "./feed.js";
import { seriesNamed } from "./graphs.js";
import { prepareProfile, profileInWords, redrawProfile, showProfile } from "./profile.js";
import { stripColour, stripName } from "./strips.js";

const SERIES = { median: "overlap, median dz m", rms: "overlap, RMSDz m" };
const signs = { profile: "", recent: "" };
const $ = (id) => document.getElementById(id);
let title = "height";
let zeroM = 0;
let ramp = ["#000000", "#ffffff"];
let profileStrips = [];
let asking = false;
let last = null; // figures of the newest strip that had any

const centimetres = (m) => (m === undefined || m === null ? "–" : `${number(100 * m, 1)} cm`);

async function news(name) {
  const found = await fetch(`/look/${name}`, { headers: signs[name] ? { "if-none-match": signs[name] } : {} });
  if (found.status !== 200) return null;
  signs[name] = found.headers.get("etag") ?? "";
  return found;
}

async function ask() {
  if (asking) return;
  asking = true;
  try {
    const [profile, recent] = await Promise.all([news("profile"), news("recent")]);
    if (profile) {
      const found = await profile.json();
      profileStrips = Object.keys(found.strips).map(Number);
      showProfile(found, zeroM);
    }
    const points = recent && readPoints(await recent.arrayBuffer());
    if (points) showPoints(points);
  } catch {
    // the next second asks again
  } finally {
    asking = false;
    words();
  }
}

function words() {
  text("profile-words", profileInWords(title));
  text("cloud-words", cloudInWords(title));
  keyOf($("profile-key"), profileStrips);
  const byStrip = $("cloud-colour").value === "strip";
  keyOf($("cloud-key"), byStrip ? seenStrips() : []);
  const range = byStrip ? null : rangeShown();
  $("cloud-ramp").hidden = !range;
  if (range) {
    const shift = $("cloud-colour").value === "height" ? zeroM : 0;
    const unit = shift || $("cloud-colour").value === "height" ? " m" : "";
    text("cloud-low", `${number(range[0] + shift, 1)}${unit}`);
    text("cloud-high", `${number(range[1] + shift, 1)}${unit}`);
    drawRamp();
  }
}

function drawRamp() {
  const bar = $("cloud-bar");
  const pen = bar.getContext("2d");
  const fill = pen.createLinearGradient(0, 0, bar.width, 0);
  ramp.forEach((colour, index) => fill.addColorStop(index / (ramp.length - 1), colour));
  pen.fillStyle = fill;
  pen.fillRect(0, 0, bar.width, bar.height);
}

function keyOf(place, strips) {
  const key = JSON.stringify([strips, document.documentElement.hasAttribute("data-night")]);
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  place.replaceChildren(...strips.map((strip) => {
    const item = document.createElement("li");
    const sign = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    sign.setAttribute("viewBox", "0 0 10 10");
    sign.setAttribute("aria-hidden", "true");
    const shape = document.createElementNS("http://www.w3.org/2000/svg", "path");
    const cross = place.id === "profile-key" && strip !== Math.max(...strips);
    shape.setAttribute("d", cross ? "M1 4h8v2H1zM4 1h2v8H4z" : "M2 2h6v6H2z");
    shape.setAttribute("fill", stripColour(strip));
    sign.append(shape);
    item.append(sign, stripName(strip));
    return item;
  }));
}

function verdict(overlap, rms) {
  if (rms === undefined) return ["", ""];
  const limit = overlap.limits_m?.[overlap.wanted];
  if (limit !== undefined) {
    const kept = rms <= limit;
    return [`${kept ? "within" : "BEYOND"} ${overlap.wanted} (${centimetres(limit)})`, kept ? "good" : "bad"];
  }
  const best = Object.entries(overlap.limits_m ?? {}).find(([, most]) => rms <= most);
  return [best ? `within ${best[0]} (${centimetres(best[1])})` : "within no quality level", ""];
}

function showOverlap(found) {
  const overlap = found.live.overlap ?? {};
  if (overlap.against?.length) last = overlap;
  const shown = last ?? overlap;
  const [said, name] = verdict(shown, shown.rms_m);
  const ended = last && overlap.strip !== last.strip ? ", ended" : "";
  $("overlap-words").className = name;
  text("overlap-words", shown.cells
    ? `Strip ${shown.strip}${ended}: median ${centimetres(shown.median_m)}, RMSDz ${centimetres(shown.rms_m)} in ${number(shown.cells)} cells, ${said}`
    : overlap.strip ? `Strip ${overlap.strip} has no cell in common with a strip before it yet` : "No strip is flown");
  $("overlap-rows").replaceChildren(...(shown.against ?? []).map((one) => {
    const row = document.createElement("tr");
    const [judged, style] = verdict(shown, one.rms_m);
    for (const words of [`${one.first} − ${one.second}`, number(one.cells), centimetres(one.median_m), centimetres(one.rms_m), judged]) {
      const cell = document.createElement("td");
      cell.textContent = words;
      row.append(cell);
    }
    row.lastChild.className = style;
    return row;
  }));
  $("overlap-table").hidden = !shown.against?.length;
  growth(shown.limits_m?.[shown.wanted]);
}

// Median and RMSDz of the last ten minutes, zero in the middle, and the limit wanted as dashes.
function growth(limit) {
  const canvas = $("overlap-growth");
  const { times, values: rms } = seriesNamed(SERIES.rms);
  const { values: median } = seriesNamed(SERIES.median);
  const width = (canvas.width = canvas.clientWidth * devicePixelRatio);
  const height = (canvas.height = canvas.clientHeight * devicePixelRatio);
  const known = [...rms, ...median].filter((value) => value !== null);
  if (!width || !known.length) return;
  const most = 1.15 * Math.max(limit ?? 0, 0.01, ...known.map(Math.abs));
  const pen = canvas.getContext("2d");
  const y = (m) => (height / 2) * (1 - m / most);
  const x = (ms) => width * (1 - (times.at(-1) - ms) / 600_000);
  const ink = getComputedStyle(canvas);
  const path = (values, colour, dashes) => {
    pen.strokeStyle = colour;
    pen.lineWidth = 2 * devicePixelRatio;
    pen.setLineDash(dashes);
    pen.beginPath();
    let down = false;
    values.forEach((value, index) => {
      if (value !== null) pen[down ? "lineTo" : "moveTo"](x(times[index]), y(value));
      down = value !== null;
    });
    pen.stroke();
  };
  const whole = [times[0], times.at(-1)];
  pen.fillStyle = ink.borderColor;
  pen.fillRect(0, Math.round(y(0)), width, 1);
  for (const level of limit ? [limit, -limit] : []) {
    pen.setLineDash([6, 6]);
    pen.strokeStyle = ink.color;
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(x(whole[0]), y(level));
    pen.lineTo(width, y(level));
    pen.stroke();
  }
  path(rms, stripColour(1), []);
  path(median, stripColour(3), [3, 3]);
  text("overlap-scale", `last ten minutes, ±${centimetres(most)}; line: RMSDz, dots: median${limit ? ", dashes: limit" : ""}`);
}

export function prepareLook() {
  prepareProfile($("profile"));
  $("profile").addEventListener("drawn", words);
  const { above, reset } = prepareCloud($("cloud"), words);
  $("cloud-above").addEventListener("click", above);
  $("cloud-reset").addEventListener("click", reset);
  $("cloud-colour").addEventListener("change", () => {
    colourCloud({ by: $("cloud-colour").value });
    words();
  });
  const times = $("cloud-times");
  times.addEventListener("click", () => {
    const on = times.getAttribute("aria-pressed") !== "true";
    times.setAttribute("aria-pressed", String(on));
    colourCloud({ times: on ? 5 : 1 });
    words();
  });
  $("hold").addEventListener("click", () => $("hold").setAttribute("aria-pressed", String($("hold").getAttribute("aria-pressed") !== "true")));
  const redraw = () => {
    redrawProfile();
    redrawCloud();
    words();
  };
  addEventListener("resize", redraw);
  new MutationObserver(redraw).observe(document.documentElement, { attributeFilter: ["data-night"] });
  new ResizeObserver(redraw).observe($("profile"));
}

export function showLook(place, found) {
  const heights = found.legend?.height;
  if (heights) {
    [title, zeroM] = [heights.title, heights.zero_m ?? 0];
    ramp = heights.colours;
  }
  if (place.hidden) return;
  colourCloud({ ramp, zeroM });
  text("look-note", found.live_is_current ? "" : found.live.state ? "swath live does not run now; these are its last moments" : "swath live does not run");
  showOverlap(found);
  if ($("hold").getAttribute("aria-pressed") !== "true") ask();
}
