// The operator's page: header, panels and marks. The map has a module of its own.
import { ask, begin, clock, listen, number, pressed, text } from "./feed.js";
import { showGraphs } from "./graphs.js";
import { prepareLook, showLook } from "./look.js";
import { startMap } from "./map.js";
import { prepareOverrule, showOverrule } from "./overrule.js";

const SHAPES = { RECORDING: "●", DEGRADED: "▲", "NOT RECORDING": "■" };
const RANK = { RECORDING: 0, DEGRADED: 1, "NOT RECORDING": 2 };
const LINE_WORDS = { planned: "planned", flying: "flying", good: "good", remarks: "good, with remarks", again: "FLY AGAIN" };
const LINE_CLASS = { good: "good", remarks: "warn", again: "bad", flying: "good" };
const SEVERITY = { info: 0, warning: 1, error: 2, critical: 2 };
const $ = (id) => document.getElementById(id);
let stateBefore = null;
let acknowledged = 0;
let session = null;

function cell(row, content, name = "") {
  const made = document.createElement("td");
  made.textContent = content;
  if (name) made.className = name;
  row.append(made);
}

function sigma(ns) {
  if (ns === null || ns === undefined) return "";
  return ns < 1e6 ? ` ±${number(ns / 1e3, 1)} µs` : ` ±${number(ns / 1e6)} ms`;
}

function showHeader(found) {
  const header = found.header;
  $("header").dataset.state = header.state;
  text("state", header.state);
  text("state-shape", SHAPES[header.state] ?? "?");
  text("sentence", header.sentence);
  text("time", header.time ? `${header.time.state}${sigma(header.time.sigma_ns)}` : "no clock");
  const left = header.hours_left === null ? "" : `${number(header.hours_left, 1)} h, `;
  text("disk", `${left}${number(header.free_bytes / 1e9, 1)} GB free`);
  text("since", header.begun_ms === null ? "–" : `${clock(header.begun_ms)} UTC`);
  if (stateBefore !== null && RANK[header.state] > RANK[stateBefore]) sound();
  stateBefore = header.state;
  document.title = `${SHAPES[header.state] ?? "?"} ${header.state} – Swath`;
}

function sound() {
  if ($("sound").getAttribute("aria-pressed") !== "true") return;
  const audio = new AudioContext();
  for (const [at, hz] of [[0, 880], [0.25, 660], [0.5, 440]]) {
    const tone = audio.createOscillator();
    tone.frequency.value = hz;
    tone.connect(audio.destination);
    tone.start(audio.currentTime + at);
    tone.stop(audio.currentTime + at + 0.2);
  }
}

function showLines(found) {
  const lines = found.lines.lines ?? [];
  text("lines-note", lines.length ? "" : found.live_is_current ? "No line yet" : "swath live does not run");
  const rows = lines.map((line) => {
    const row = document.createElement("tr");
    if (line.name === found.lines.current) row.className = "now";
    cell(row, line.name);
    cell(row, LINE_WORDS[line.state] ?? line.state, LINE_CLASS[line.state] ?? "");
    cell(row, line.flown_fraction === undefined || line.flown_fraction === null ? "" : `${number(100 * line.flown_fraction)} %`);
    const why = (line.reasons ?? []).map((reason) => reason.text);
    if (line.overruled) why.unshift(`operator: ${line.overruled.verdict}${line.overruled.note ? `, ${line.overruled.note}` : ""}`);
    cell(row, why.join("; "));
    return row;
  });
  $("lines-rows").replaceChildren(...rows);
}

function showSensors(found) {
  const rows = Object.entries(found.sources).map(([source, one]) => {
    const row = document.createElement("tr");
    const lost = Object.values(one.lost);
    const bad = ["silent", "stuck", "absent", "stale"].includes(one.state);
    cell(row, source);
    cell(row, one.state, bad ? "bad" : one.state === "receiving" ? "good" : "");
    cell(row, one.rate_hz === null ? "" : number(one.rate_hz, 1));
    cell(row, one.age_s === null ? "never" : `${number(one.age_s, 1)} s`);
    cell(row, number(lost.reduce((sum, count) => sum + count, 0)), lost.some((count) => count > 0) ? "bad" : "");
    cell(row, one.time_state ? `${one.time_state}${sigma(one.time_sigma_ns)}` : "", one.time_state && one.time_state !== "LOCKED" ? "warn" : "");
    return row;
  });
  $("sensor-rows").replaceChildren(...rows);
  const notes = [...found.notes];
  for (const [source, one] of Object.entries(found.sources)) {
    if (!one.decoded) continue;
    const rates = Object.entries(one.decoded.records_hz).map(([name, hz]) => `${number(hz, 1)} ${name}/s`);
    if (one.decoded.bad) rates.push(`${one.decoded.bad} messages damaged`);
    notes.push(`${source}: ${rates.join(", ") || "nothing decoded"}`);
  }
  for (const [source, one] of Object.entries(found.live.gnss ?? {})) {
    const parts = [one.fix, one.satellites === null ? null : `${one.satellites} satellites`, one.sigma_m ? `±${number(Math.max(...one.sigma_m), 3)} m` : null];
    notes.push(`${source}: ${parts.filter((part) => part).join(", ")}`);
  }
  if (found.live.navigation) notes.push(`navigation: ${found.live.navigation}`);
  $("sensor-notes").replaceChildren(...notes.map((note) => {
    const item = document.createElement("li");
    item.textContent = note;
    return item;
  }));
}

function showEvents(found) {
  if (found.header.session_id !== session) {
    session = found.header.session_id;
    acknowledged = Number(localStorage.getItem(`acknowledged ${session}`) ?? 0);
  }
  const least = SEVERITY[$("severity").value];
  const wanted = $("find").value.toLowerCase();
  const shown = found.events.filter((event) =>
    (SEVERITY[event.severity] ?? 0) >= least && `${event.source} ${event.code} ${event.text}`.toLowerCase().includes(wanted));
  $("event-rows").replaceChildren(...shown.reverse().slice(0, 200).map((event) => {
    const item = document.createElement("li");
    const rank = SEVERITY[event.severity] ?? 0;
    item.className = `${rank === 2 ? "bad" : rank === 1 ? "warn" : ""} ${rank > 0 && event.number > acknowledged ? "new" : ""}`;
    item.textContent = `${clock(event.time_ms)} ${event.severity} ${event.source} ${event.code}: ${event.text}`;
    return item;
  }));
  const open = found.events.filter((event) => (SEVERITY[event.severity] ?? 0) > 0 && event.number > acknowledged).length;
  text("tab-events", open ? `Events (${open})` : "Events");
}

async function mark(words) {
  if (!words.trim()) return;
  const told = await ask("/mark", { text: words });
  text("answer", told.error ? `Not marked: ${told.error}` : `Marked at ${clock(Math.round(told.time_ns / 1e6))} UTC: ${told.text}`);
  if (!told.error) $("mark-text").value = "";
}

async function prepareMarks() {
  const about = await (await fetch("/about")).json();
  about.marks.forEach((words, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `F${index + 1} ${words}`;
    button.addEventListener("click", () => mark(words));
    $("mark-keys").append(button);
  });
  addEventListener("keydown", (event) => {
    const found = /^F([1-8])$/.exec(event.key);
    if (!found || !about.marks[found[1] - 1]) return;
    event.preventDefault();
    mark(about.marks[found[1] - 1]);
  });
}

function choose(tab) {
  for (const one of document.querySelectorAll('[role="tab"]')) {
    const chosen = one === tab;
    one.setAttribute("aria-selected", String(chosen));
    $(one.getAttribute("aria-controls")).hidden = !chosen;
  }
  if (tab.id === "tab-data") listen((found) => showLook($("data"), found), { once: true });
}

pressed("night", String(matchMedia("(prefers-color-scheme: dark)").matches), (on) => document.documentElement.toggleAttribute("data-night", on));
pressed("sound", "false", () => {});
for (const tab of document.querySelectorAll('[role="tab"]')) tab.addEventListener("click", () => choose(tab));
$("marking").addEventListener("submit", (event) => {
  event.preventDefault();
  mark($("mark-text").value);
});
$("split").addEventListener("click", async () => {
  const told = await ask("/split", {});
  text("answer", told.error ? `No new part: ${told.error}` : "A new part begins");
});
$("acknowledge").addEventListener("click", () => {
  listen((found) => {
    acknowledged = Math.max(acknowledged, ...found.events.map((event) => event.number));
    localStorage.setItem(`acknowledged ${session}`, String(acknowledged));
  }, { once: true });
});
prepareMarks();
prepareOverrule();
prepareLook();
startMap();
listen((found, role) => {
  for (const control of document.querySelectorAll("#marking button, #marking input")) control.disabled = role !== "operator";
  showHeader(found);
  showLines(found);
  showOverrule(found.lines.lines ?? [], role);
  showSensors(found);
  showGraphs($("graphs"), found);
  showLook($("data"), found);
  showEvents(found);
});
begin(() => {
  $("header").dataset.state = "UNKNOWN";
  text("state", "CONSOLE SILENT");
  text("state-shape", "?");
  text("sentence", "The console does not answer; what the recorder does is not known here");
});
