// The page before landing: may we go home? It shows what live has judged, and asks for it to be written down.
import { ask, begin, clock, listen, number, pressed, text } from "./feed.js";

const VERDICTS = { home: ["●", "GO HOME"], care: ["▲", "GO HOME, WITH CARE"], again: ["■", "FLY AGAIN"], wait: ["▲", "WAIT"] };
const ANSWERS = {
  good: ["●", "good", "good"],
  remark: ["▲", "look at it", "warn"],
  again: ["■", "fly again", "bad"],
  unknown: ["?", "not known", "warn"],
  open: ["○", "still to do", "warn"],
};
const PARAMETERS = {
  omega_deg: "roll (ω)",
  phi_deg: "pitch (φ)",
  kappa_deg: "heading (κ)",
  range_offset_m: "range offset",
  range_scale_ppm: "range scale",
  scan_angle_scale_ppm: "scan-angle scale",
  scan_plane_tilt_deg: "scan-plane tilt",
  time_offset_us: "time offset",
};
const LINES = {
  planned: ["not flown", "bad"],
  flying: ["being flown", "good"],
  good: ["good", "good"],
  remarks: ["good, with remarks", "warn"],
  again: ["FLY AGAIN", "bad"],
};
const $ = (id) => document.getElementById(id);
let shown = "";
let live = false;

function row(...cells) {
  const made = document.createElement("tr");
  for (const one of cells) {
    const cell = document.createElement("td");
    if (one instanceof Node) cell.append(one);
    else [cell.textContent, cell.className] = Array.isArray(one) ? one : [one, ""];
    made.append(cell);
  }
  return made;
}

function list(first, lines) {
  const made = document.createElement("div");
  made.textContent = first;
  for (const line of lines) {
    const one = document.createElement("div");
    one.className = "detail";
    one.textContent = line;
    made.append(one);
  }
  return made;
}

const size = (m2) => (m2 < 1e4 ? `${number(m2)} m²` : m2 < 1e6 ? `${number(m2 / 1e4, 1)} ha` : `${number(m2 / 1e6, 2)} km²`);

const digits = (sigma) => (sigma === null ? "none" : sigma >= 100 ? number(sigma) : String(Number(sigma.toPrecision(2))));

function predictions(predicted) {
  return (predicted?.rows ?? []).map((one) =>
    `${one.scanner} ${PARAMETERS[one.name] ?? one.name}: ±${digits(one.sigma)} ${one.unit} by the lines flown, ±${one.wanted} is useful: ${one.determined ? "determined" : "not shown to be determined"}`);
}

function showChecks(checks, predicted) {
  $("check-rows").replaceChildren(...checks.map((check) => {
    const [shape, words, name] = ANSWERS[check.state] ?? ["?", check.state, "warn"];
    const details = ["gaps", "lines"].includes(check.code) ? [] : [...check.details];
    if (check.code === "calibration") details.push(...predictions(predicted));
    return row(check.title, [`${shape} ${words}`, name], list(check.text, details));
  }));
}

function showGaps(area) {
  const gaps = area?.gaps ?? [];
  const waters = area?.waters ?? [];
  const more = area?.more_gaps ?? 0;
  text("gaps-note", gaps.length ? more ? `The largest; ${number(more)} smaller ones are not listed` : "" : area ? "None" : "No point yet");
  $("gaps").hidden = !gaps.length && !waters.length;
  $("gap-rows").replaceChildren(...[...gaps, ...waters].map((gap) => {
    const link = document.createElement("a");
    link.href = `/#at=${gap.east_m},${gap.north_m},${Math.ceil(gap.length_m)}`;
    link.textContent = gap.lat_deg === null ? "on the map" : `${gap.lat_deg.toFixed(5)}°, ${gap.lon_deg.toFixed(5)}°`;
    const why = gap.water ? ["no echo: water?", "warn"] : gap.under.length ? [`flown over on ${gap.under.join(", ")}: water?`, "warn"] : ["not covered", "bad"];
    return row(`${gap.water ? "water " : ""}${gap.number}`, size(gap.area_m2), `${number(gap.width_m)} m`, gap.line, link, why);
  }));
}

function showLines(lines) {
  $("line-rows").replaceChildren(...lines.map((line) => {
    const why = [...line.why];
    if (line.overruled) why.unshift(`operator: ${line.overruled.verdict}${line.overruled.note ? `, ${line.overruled.note}` : ""}`);
    const flown = line.flown_fraction === null ? "" : `${number(100 * line.flown_fraction)} %`;
    return row(line.name, LINES[line.state] ?? line.state, flown, why.join("; "));
  }));
}

function show(found) {
  const verdict = found.verdict;
  const doubts = (verdict?.checks ?? []).some((check) => ["remark", "unknown"].includes(check.state));
  const state = verdict?.state === "home" && doubts ? "care" : verdict?.state;
  const [shape, words] = VERDICTS[state] ?? ["?", "NO VERDICT"];
  $("header").dataset.state = state ?? "UNKNOWN";
  text("state-shape", shape);
  text("state", words);
  text("sentence", verdict ? verdict.sentence : "swath live has written no verdict");
  document.title = `${shape} ${words} – Swath before landing`;
  showChecks(verdict?.checks ?? [], verdict?.predicted);
  showGaps(verdict?.area);
  showLines(verdict?.lines ?? []);
  $("downloads").replaceChildren(...found.downloads.map((file) => {
    const link = document.createElement("a");
    link.className = "button";
    link.href = `/${file.name}`;
    link.download = file.name;
    link.textContent = `${file.name} (${number(file.bytes / 1e6, 1)} MB)`;
    return link;
  }));
  const at = verdict ? `As of ${clock(Math.round(verdict.log_time_ns / 1e6))} UTC` : "";
  text("made", verdict ? live || verdict.has_ended ? `${at}${verdict.has_ended ? ", the end of the log" : ""}` : `${at}: swath live does not run, what came since is not judged` : "");
}

async function refresh(sign) {
  shown = sign;
  try {
    show(await (await fetch("/verdict")).json());
  } catch {
    shown = "";
  }
}

pressed("night", String(matchMedia("(prefers-color-scheme: dark)").matches), (on) => document.documentElement.toggleAttribute("data-night", on));
$("write").addEventListener("click", async () => {
  const told = await ask("/landing", {});
  text("answer", told.error ? `Not written: ${told.error}` : `In the log at ${clock(Math.round(told.time_ns / 1e6))} UTC: ${told.text}`);
});
listen((found, role) => {
  $("write").disabled = role !== "operator";
  const sign = `${found.landing?.sign ?? "none"} ${found.live_is_current}`;
  live = found.live_is_current;
  if (sign !== shown) refresh(sign);
});
begin(() => {
  $("header").dataset.state = "UNKNOWN";
  text("state-shape", "?");
  text("state", "CONSOLE SILENT");
  text("sentence", "The console does not answer; this is the last that it said");
  shown = "";
});
