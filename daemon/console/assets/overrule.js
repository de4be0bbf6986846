// The operator's word on a line, below the table of lines.
import { ask, clock, text } from "./feed.js";

const $ = (id) => document.getElementById(id);

export function prepareOverrule() {
  $("overrule").addEventListener("submit", async (event) => {
    event.preventDefault();
    const told = await ask("/overrule", { line: $("overrule-line").value, verdict: $("overrule-word").value, note: $("overrule-note").value });
    text("overruled", told.error ? `Not overruled: ${told.error}` : `In the log at ${clock(Math.round(told.time_ns / 1e6))} UTC: ${told.text}`);
    if (!told.error) $("overrule-note").value = "";
  });
}

export function showOverrule(lines, role) {
  const names = lines.map((line) => line.name);
  const select = $("overrule-line");
  $("overrule").hidden = !names.length;
  for (const control of document.querySelectorAll("#overrule button, #overrule input, #overrule select")) control.disabled = role !== "operator";
  const key = JSON.stringify(names);
  if (select.dataset.key === key) return;
  select.dataset.key = key;
  const before = select.value;
  select.replaceChildren(...names.map((name) => {
    const option = document.createElement("option");
    option.textContent = option.value = name;
    return option;
  }));
  if (names.includes(before)) select.value = before;
}
