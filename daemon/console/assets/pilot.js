// The steering bar: large figures of the line that is flown, for a second display.
import { begin, listen, number, steer, text } from "./feed.js";

let current = false;
let told = {};
const $ = (id) => document.getElementById(id);
const sign = (value, digits = 0) => (value > 0 ? "+" : "") + number(value, digits);
const over = (name, is) => document.querySelector(`[data-of="${name}"]`).classList.toggle("over", is);

function away(m, s) {
  if (m === null || m === undefined) return "–";
  const distance = Math.abs(m) < 10000 ? `${number(m)} m` : `${number(m / 1000, 1)} km`;
  return s === null || s === undefined ? distance : `${distance} ${number(s)} s`;
}

function show() {
  const now = told.steering;
  text("pilot-note", current ? "" : "No position: swath live does not run");
  text("next", told.next ? `next: ${told.next}` : "");
  if (!now || !current) {
    text("line", current ? "No line" : "NO POSITION");
    for (const id of ["cross", "height", "track", "begin", "end", "speed", "bank"]) text(id, "–");
    return;
  }
  text("line", `Line ${now.line}`);
  const limit = now.cross_track_limit_m ?? 50;
  $("bar-needle").setAttribute("transform", `translate(${Math.max(-96, Math.min(96, (50 * now.cross_track_m) / limit))} 0)`);
  text("cross", now.cross_track_m === null ? "–" : `${now.cross_track_m > 0 ? "R" : "L"} ${number(Math.abs(now.cross_track_m))} m`);
  text("height", now.height_m === null ? "–" : `${sign(now.height_m)} m`);
  text("track", `${sign(now.track_error_deg, 1)}°`);
  text("begin", away(now.to_begin_m, now.to_begin_s));
  text("end", away(now.to_end_m, now.to_end_s));
  text("speed", now.wanted_speed_mps ? `${number(now.speed_mps, 1)} / ${number(now.wanted_speed_mps, 1)} m/s` : `${number(now.speed_mps, 1)} m/s`);
  text("bank", now.bank_limit_deg ? `${number(Math.abs(now.bank_deg))}° / ${number(now.bank_limit_deg)}°` : `${number(Math.abs(now.bank_deg))}°`);
  over("cross", Math.abs(now.cross_track_m) > limit);
  over("bank", now.bank_limit_deg !== null && Math.abs(now.bank_deg) > now.bank_limit_deg);
  over("height", now.height_limit_m != null && Math.abs(now.height_m) > now.height_limit_m);
}

listen((found) => {
  current = found.live_is_current;
  show();
});
steer((steering) => {
  told = steering;
  show();
});
begin(() => {
  text("line", "NO POSITION");
  text("pilot-note", "The console does not answer");
});
