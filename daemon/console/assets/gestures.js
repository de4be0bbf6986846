// Turns fingers, mouse, wheel and keys on a canvas into dragging, zooming, and, by two fingers or Shift, moving.
const STEP = 24; // pixels that an arrow key drags
const CLOSER = 1.25;

export function gestures(canvas, { drag, zoom, reset, move = drag }) {
  const fingers = new Map();
  const spread = () => {
    const [one, other] = [...fingers.values()];
    return Math.hypot(one.x - other.x, one.y - other.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before || fingers.size > 2) return;
    const apart = fingers.size === 2 ? spread() : 0;
    const now = { x: event.clientX, y: event.clientY };
    fingers.set(event.pointerId, now);
    (apart > 0 || event.shiftKey ? move : drag)((now.x - before.x) / fingers.size, (now.y - before.y) / fingers.size);
    if (apart > 0 && spread() > 0) zoom(spread() / apart);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(event.deltaY < 0 ? CLOSER : 1 / CLOSER);
  }, { passive: false });
  canvas.addEventListener("dblclick", reset);
  const keys = {
    ArrowLeft: (go) => go(-STEP, 0),
    ArrowRight: (go) => go(STEP, 0),
    ArrowUp: (go) => go(0, -STEP),
    ArrowDown: (go) => go(0, STEP),
    "+": () => zoom(CLOSER),
    "=": () => zoom(CLOSER),
    "-": () => zoom(1 / CLOSER),
    0: reset,
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    keys[event.key](event.shiftKey ? move : drag);
  });
}
