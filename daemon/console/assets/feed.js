// The feed of snapshots, one a second; the browser reconnects by itself, and a page that hears nothing says so.
const QUIET_MS = 4000;
const listeners = [];
let latest = null;
let heard = 0;
let role = "viewer";

const steerers = [];

export const text = (id, value) => {
  const element = document.getElementById(id);
  if (element && element.textContent !== value) element.textContent = value;
};

export function listen(listener, { once = false } = {}) {
  if (!once) listeners.push(listener);
  if (latest) listener(latest, role);
}

export const steer = (listener) => steerers.push(listener);

export function begin(onQuiet) {
  const source = new EventSource("/feed");
  source.addEventListener("role", (event) => {
    role = JSON.parse(event.data);
  });
  source.addEventListener("steering", (event) => {
    for (const listener of steerers) listener(JSON.parse(event.data));
  });
  source.onmessage = (event) => {
    latest = JSON.parse(event.data);
    heard = performance.now();
    for (const listener of listeners) listener(latest, role);
  };
  setInterval(() => {
    if (performance.now() - heard > QUIET_MS) {
      onQuiet();
      fetch("/about").then((found) => {
        if (found.status === 401) location.replace("/login");
      }, () => {});
    }
  }, 1000);
}

export async function ask(path, what) {
  try {
    const found = await fetch(path, {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(what),
    });
    return await found.json();
  } catch {
    return { error: "the console does not answer" };
  }
}

export const clock = (ms) => (ms === null ? "" : new Date(ms).toISOString().slice(11, 19));
export const number = (value, digits = 0) =>
  value === null || value === undefined ? "–" : value.toLocaleString("en-US", { maximumFractionDigits: digits, minimumFractionDigits: digits }).replace(/^-(?=[0.]*$)/, "").replace("-", "−");

export function pressed(id, otherwise, change) {
  const button = document.getElementById(id);
  const set = (on) => {
    button.setAttribute("aria-pressed", String(on));
    change(on);
  };
  set((localStorage.getItem(id) ?? otherwise) === "true");
  button.addEventListener("click", () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    localStorage.setItem(id, String(on));
    set(on);
  });
}
