// Which part of the slice the map shows: moved by wheel, pinch, drag and keys, always within the slice.
"use strict";

const DEEPEST = 4; // nodes along the shorter axis that are seen at the least
const view = { zoom: 1, right: 0, up: 0 }; // `right` and `up` are where the window begins, in shares of the slice
const most = Math.max(1, Math.min(columns, up ? rows : columns) / DEEPEST);

// Keep the window within the slice, and tell whoever draws it.
function setView(zoom, right, upwards) {
  view.zoom = clamp(zoom, 1, most);
  view.right = clamp(right, 0, 1 - 1 / view.zoom);
  view.up = up ? clamp(upwards, 0, 1 - 1 / view.zoom) : 0;
  document.dispatchEvent(new Event("viewed"));
}

// Zoom so that what is at a place, in shares of the window, stays there.
function zoomAt(factor, [right, upwards]) {
  const zoom = clamp(view.zoom * factor, 1, most);
  const kept = 1 / view.zoom - 1 / zoom;
  setView(zoom, view.right + right * kept, view.up + upwards * kept);
}
const pan = (right, upwards) => setView(view.zoom, view.right + right / view.zoom, view.up + upwards / view.zoom);

// Bring a place, in shares of the slice, into the window.
function reveal([right, upwards]) {
  const within = (begin, place) => clamp(begin, place - 1 / view.zoom, place);
  const [left, low] = [within(view.right, right), within(view.up, upwards)];
  if (Math.abs(left - view.right) > 1e-9 || Math.abs(low - view.up) > 1e-9) setView(view.zoom, left, low);
}

// Listen to the wheel and to pointers over a canvas. `place` gives a pointer's place in shares of the window;
// `draws` says whether a drag draws a line, which hears of it as `line(from, to)`.
function steer(canvas, place, draws, line) {
  const held = new Map(); // the pointers that are down
  let begun = null;
  const gesture = { dragged: false };
  canvas.addEventListener("wheel", (event) => {
    const meant = event.ctrlKey || event.metaKey || document.activeElement === canvas;
    if (!meant || (event.deltaY > 0 && view.zoom === 1) || event.deltaY === 0) return;
    event.preventDefault();
    const lines = [1, 16, 400][event.deltaMode];
    zoomAt(Math.exp(-clamp(event.deltaY * lines, -200, 200) / 300), place(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    gesture.dragged = held.size > 0;
    held.set(event.pointerId, place(event));
    begun = { place: place(event), x: event.clientX, y: event.clientY };
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!event.buttons) held.delete(event.pointerId); // it was let go where nothing heard of it
    if (!before || !event.buttons) return;
    const now = place(event);
    if (Math.hypot(event.clientX - begun.x, event.clientY - begun.y) < 5 && !gesture.dragged) return;
    if (!gesture.dragged) canvas.setPointerCapture(event.pointerId);
    gesture.dragged = true;
    const other = [...held].find(([id]) => id !== event.pointerId);
    held.set(event.pointerId, now);
    if (other) pinch(before, now, other[1]);
    else if (draws()) line(begun.place, now);
    else pan(before[0] - now[0], before[1] - now[1]);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  return gesture;
}

function pinch(before, now, other) {
  const apart = ([x, y]) => Math.hypot(x - other[0], y - other[1]);
  const middle = ([x, y]) => [(x + other[0]) / 2, (y + other[1]) / 2];
  const [from, to] = [middle(before), middle(now)];
  if (apart(before) > 0.01) zoomAt(apart(now) / apart(before), from);
  pan(from[0] - to[0], from[1] - to[1]);
}
