// What the pictures of a slice share: SLICE (nodes.js) as typed arrays, numbers in words, canvases that fit the page.
"use strict";

// Arrays are packed as base64 so that a page needs no request, and are decoded here, once.
function unpacked(text, Kind) {
  if (text === undefined || text === null) return null;
  const bytes = atob(text);
  const held = new Uint8Array(bytes.length);
  for (let at = 0; at < bytes.length; at++) held[at] = bytes.charCodeAt(at);
  return new Kind(held.buffer);
}

let across, up, columns, rows, losses, statuses, drawnLosses, drawnStatuses, slopes, gradients, finer, floors, lowest;

function read() {
  [across, up] = SLICE.axes;
  columns = across.values.length;
  rows = up ? up.values.length : 1;
  losses = unpacked(SLICE.loss, Float32Array);
  statuses = unpacked(SLICE.status, Uint8Array);
  drawnLosses = unpacked(SLICE.cells, Float32Array) || losses; // of a refined slice, each node's nearest sample's
  drawnStatuses = unpacked(SLICE.looks, Uint8Array) || statuses;
  slopes = SLICE.slope ? SLICE.slope.map((part) => unpacked(part, Float32Array)) : null;
  gradients = unpacked(SLICE.gradient, Float32Array);
  finer = unpacked(SLICE.finer, Uint8Array); // cells between four nodes
  floors = unpacked(SLICE.floor, Float32Array); // the numerical floor of every node
  lowest = losses.reduce((best, loss, at) => (loss < losses[best] || !(losses[best] === losses[best]) ? at : best), 0);
}
read();

// Show another slice of as many nodes, as the explorer does.
function load(slice) {
  SLICE = slice;
  read();
  document.dispatchEvent(new Event("loaded"));
}

const lossLabel = "loss" + (SLICE.unit ? ` [${SLICE.unit}]` : "");
const shown = new Set(); // what the switches let through

const ends = (axis) => [axis.values[0], axis.values[axis.values.length - 1]];
const sideOf = (axis) => ends(axis)[1] - ends(axis)[0];
const statusOf = (at) => SLICE.statuses[statuses[at]];
const clamp = (value, low, high) => Math.max(low, Math.min(high, value));
const at = (index) => [index % columns, Math.floor(index / columns)];

function number(value) {
  if (value === null || Number.isNaN(value)) return "none";
  const small = value !== 0 && Math.abs(value) < 1e-4;
  const text = small ? value.toExponential(3).replace(/\.?0+e/, "e") : Number(value.toPrecision(4)).toString();
  return text.replaceAll("-", "\u2212");
}

// About so many round values in a range.
function roundValues(low, high, count) {
  const rough = (high - low) / count;
  if (!(rough > 0)) return [low];
  const ten = 10 ** Math.floor(Math.log10(rough));
  const step = ten * ([1, 2, 2.5, 5].find((one) => one * ten >= rough) || 10);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

// Coordinates along a logarithmic axis are decimal logarithms of the values that are read.
const valueOf = (axis, place) => (axis.logarithmic ? 10 ** place : place);
const valueSaid = (axis, place) => number(valueOf(axis, place));

// Where about five round values of an axis are between two coordinates: at decades, where it has two.
function roundPlaces(axis, low, high) {
  if (!axis.logarithmic) return roundValues(low, high, 5);
  const step = Math.max(1, Math.ceil((high - low) / 6));
  const found = [];
  for (let k = step * Math.ceil(low / step - 1e-9); k <= high + 1e-9; k += step) found.push(k);
  return found.length > 1 ? found : roundValues(10 ** low, 10 ** high, 5).map(Math.log10);
}

// Colours of the style sheet, read once for each colour scheme.
const dark = matchMedia("(prefers-color-scheme: dark)");
let inks = {};
dark.addEventListener("change", () => (inks = {}));
function ink(name) {
  inks[name] ||= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return inks[name];
}

// Draw a canvas in pixels of the screen: at most once a frame, whenever its size, the colour scheme, a switch or what
// it shows changes. Returns what asks for that.
function fit(canvas, draw) {
  const pen = canvas.getContext("2d");
  let asked = 0;
  const frame = () => {
    asked = 0;
    if (document.readyState === "loading") return; // scripts are still coming that it may need
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const dots = window.devicePixelRatio || 1;
    const [wide, tall] = [Math.round(width * dots), Math.round(height * dots)];
    if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = [wide, tall];
    pen.setTransform(dots, 0, 0, dots, 0, 0);
    draw(pen, width, height, dots);
  };
  const redraw = () => (asked ||= requestAnimationFrame(frame));
  new ResizeObserver(redraw).observe(canvas);
  dark.addEventListener("change", redraw);
  document.addEventListener("shown", redraw);
  document.addEventListener("scaled", redraw);
  document.addEventListener("DOMContentLoaded", redraw);
  redraw();
  return redraw;
}

// A canvas that is on no page.
function offscreen(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

// Said once the keys rest, so that a screen reader is not flooded; the pointer says nothing.
let saying;
function say(text, wait = 400) {
  clearTimeout(saying);
  saying = setTimeout(() => (document.getElementById("spoken").textContent = text), wait);
}

function pointed(canvas, event) {
  const frame = canvas.getBoundingClientRect();
  return [event.clientX - frame.left - canvas.clientLeft, event.clientY - frame.top - canvas.clientTop];
}
