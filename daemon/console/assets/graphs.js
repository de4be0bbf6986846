// Graphs of the last ten minutes, one canvas a series.
import { number } from "./feed.js";

const SPAN_MS = 600_000;
const times = [];
const series = new Map();
let loaded = false;

async function load() {
  loaded = true;
  const found = await (await fetch("/history")).json();
  times.splice(0, times.length, ...found.time_ms);
  for (const [name, values] of Object.entries(found.series)) series.set(name, values);
}

function take(found) {
  if (times.length && found.now_ms <= times.at(-1)) return;
  times.push(found.now_ms);
  for (const name of Object.keys(found.series)) if (!series.has(name)) series.set(name, new Array(times.length - 1).fill(null));
  for (const [name, values] of series) values.push(found.series[name] ?? null);
  while (times[0] < found.now_ms - SPAN_MS) {
    times.shift();
    for (const values of series.values()) values.shift();
  }
}

function draw(canvas, values, now) {
  const width = (canvas.width = canvas.clientWidth * devicePixelRatio);
  const height = (canvas.height = canvas.clientHeight * devicePixelRatio);
  const known = values.filter((value) => value !== null);
  if (!known.length || !width) return;
  let [low, high] = [Math.min(...known), Math.max(...known)];
  if (high - low < 1e-9) [low, high] = [low - 1, high + 1];
  const pen = canvas.getContext("2d");
  pen.strokeStyle = getComputedStyle(canvas).color;
  pen.lineWidth = 1.5 * devicePixelRatio;
  pen.beginPath();
  let down = false;
  values.forEach((value, index) => {
    if (value === null) {
      down = false;
      return;
    }
    const x = width * (1 - (now - times[index]) / SPAN_MS);
    const y = 3 + (height - 6) * (1 - (value - low) / (high - low));
    if (down) pen.lineTo(x, y);
    else pen.moveTo(x, y);
    down = true;
  });
  pen.stroke();
}

// Times and values of the last ten minutes; empty if there is no such series.
export const seriesNamed = (name) => ({ times, values: series.get(name) ?? [] });

export function showGraphs(place, found) {
  if (!loaded) load();
  take(found);
  if (place.hidden) return;
  for (const name of [...series.keys()].sort()) {
    const id = `graph ${name}`;
    let graph = document.getElementById(id);
    if (!graph) {
      graph = document.createElement("div");
      graph.className = "graph";
      graph.id = id;
      graph.append(document.createElement("p"), document.createElement("canvas"));
      graph.firstChild.append(document.createElement("span"), document.createElement("span"));
      place.append(graph);
    }
    const values = series.get(name);
    const [label, value] = graph.firstChild.children;
    label.textContent = name;
    value.textContent = number(values.at(-1), 2);
    draw(graph.lastChild, values, found.now_ms);
  }
}
