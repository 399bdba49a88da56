// The map of a slice: SLICE (nodes.js) on a canvas, a node at a time under the pointer or the arrow keys.
"use strict";

const canvas = document.getElementById("map");
const pen = canvas.getContext("2d");
const readout = document.getElementById("readout");
const switches = document.getElementById("switches");
const [across, up] = SLICE.axes;
const columns = across.values.length;
const rows = up ? up.values.length : 1;
const finite = SLICE.loss.map((loss, node) => [loss, node]).filter(([loss]) => loss !== null);
const lowest = finite.reduce((best, one) => (one[0] < best[0] ? one : best), finite[0] || [null, 0])[1];
const shown = new Set();
let node = lowest;

const PAD = { left: 68, right: 12, top: 12, bottom: 48 };
const inner = { width: canvas.width - PAD.left - PAD.right, height: canvas.height - PAD.top - PAD.bottom };
const ends = (axis) => [axis.values[0], axis.values[axis.values.length - 1]];
const number = (value) => (value === null ? "none" : Number(value.toPrecision(4)).toString().replace("-", "\u2212"));

// Losses of a line span its height; on a plane the window reaches half a cell beyond the outermost nodes.
const height = up ? null : [Math.min(...finite.map(([loss]) => loss)), Math.max(...finite.map(([loss]) => loss))];

function place(value, axis, length) {
  const [low, high] = ends(axis);
  const share = (value - low) / (high - low);
  const cell = length / axis.values.length;
  return up ? cell / 2 + share * (length - cell) : share * length;
}
const x = (value) => PAD.left + place(value, across, inner.width);
function y(value) {
  if (up) return PAD.top + inner.height - place(value, up, inner.height);
  return PAD.top + inner.height * (1 - (value - height[0]) / (height[1] - height[0] || 1));
}
const at = (index) => [index % columns, Math.floor(index / columns)];
function spot(index) {
  const [column, row] = at(index);
  const loss = SLICE.loss[index];
  return [x(across.values[column]), up ? y(up.values[row]) : loss === null ? PAD.top + inner.height : y(loss)];
}

function hatch() {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 8;
  const ink = tile.getContext("2d");
  ink.strokeStyle = "#5f5f5f";
  ink.beginPath();
  ink.moveTo(0, 8);
  ink.lineTo(8, 0);
  ink.stroke();
  return pen.createPattern(tile, "repeat");
}

function drawCells() {
  const width = inner.width / columns;
  const tall = inner.height / rows;
  const failed = hatch();
  SLICE.shade.forEach((shade, index) => {
    const [column, row] = at(index);
    if (SLICE.status[index] === "MISSING") pen.fillStyle = "#ececec";
    else pen.fillStyle = shade < 0 ? failed : "#" + SLICE.palette[shade];
    pen.fillRect(PAD.left + column * width, PAD.top + inner.height - (row + 1) * tall, width + 0.6, tall + 0.6);
  });
}

function drawLine() {
  pen.strokeStyle = "#31688e";
  pen.lineWidth = 1.5;
  pen.beginPath();
  let on = false;
  SLICE.loss.forEach((loss, index) => {
    if (loss !== null) on ? pen.lineTo(...spot(index)) : pen.moveTo(...spot(index));
    on = loss !== null;
  });
  pen.stroke();
}

function arrow(from, direction, length) {
  const tip = [from[0] + (direction[0] * length) / 2, from[1] + (direction[1] * length) / 2];
  const tail = [from[0] - (direction[0] * length) / 2, from[1] - (direction[1] * length) / 2];
  const back = length / 3;
  pen.moveTo(...tail);
  pen.lineTo(...tip);
  for (const side of [-1, 1]) {
    const turned = [direction[0] - side * 0.6 * direction[1], direction[1] + side * 0.6 * direction[0]];
    pen.moveTo(...tip);
    pen.lineTo(tip[0] - turned[0] * back, tip[1] - turned[1] * back);
  }
}

// Steepest descent in fractions of the picture's sides, as in the picture below the map.
function drawArrows() {
  const step = Math.ceil(Math.max(columns, rows) / 24);
  const sides = [across, up].map((axis) => ends(axis)[1] - ends(axis)[0]);
  pen.beginPath();
  for (let index = 0; index < SLICE.loss.length; index++) {
    const [column, row] = at(index);
    if (column % step || row % step || SLICE.slope[0][index] === null) continue;
    const down = [-SLICE.slope[0][index] * sides[0], SLICE.slope[1][index] * sides[1]];
    const size = Math.hypot(...down);
    if (size > 0) arrow(spot(index), [down[0] / size, down[1] / size], (0.8 * step * inner.width) / columns);
  }
  for (const [width, colour] of [[3.6, "#1a1a1a"], [1.5, "#ffffff"]]) {
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.stroke();
  }
}

function drawRuns() {
  for (const run of SLICE.runs.filter((one) => shown.has(one.method))) {
    pen.fillStyle = run.colour;
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 1.2;
    run.u.forEach((value, index) => {
      pen.beginPath();
      pen.arc(x(value), up ? y(run.v[index]) : y(run.loss[index]), 4.5, 0, 2 * Math.PI);
      pen.fill();
      pen.stroke();
    });
  }
}

function ring(index, radius, colour, width) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  pen.arc(...spot(index), radius, 0, 2 * Math.PI);
  pen.stroke();
}

function drawAxes() {
  pen.fillStyle = "#1a1a1a";
  pen.font = "14px system-ui, sans-serif";
  pen.textAlign = "center";
  for (const end of ends(across)) pen.fillText(number(end), x(end), PAD.top + inner.height + 18);
  pen.fillText(across.label, PAD.left + inner.width / 2, canvas.height - 8);
  pen.save();
  pen.translate(16, PAD.top + inner.height / 2);
  pen.rotate(-Math.PI / 2);
  pen.fillText(up ? up.label : "loss" + (SLICE.unit ? " [" + SLICE.unit + "]" : ""), 0, 0);
  pen.restore();
  pen.textAlign = "right";
  for (const end of up ? ends(up) : height) pen.fillText(number(end), PAD.left - 6, y(end) + 5);
}

function draw() {
  pen.fillStyle = "#ffffff";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  if (up) drawCells();
  else if (finite.length) drawLine();
  pen.save();
  pen.beginPath();
  pen.rect(PAD.left - 8, PAD.top - 8, inner.width + 16, inner.height + 16);
  pen.clip();
  if (shown.has("arrows")) drawArrows();
  drawRuns();
  pen.restore();
  for (const episode of SLICE.episodes) ring(episode.row * columns + episode.column, 6, "#ffffff", 2);
  ring(node, 8, "#ffffff", 5);
  ring(node, 8, "#b5367a", 2.5);
  drawAxes();
}

function tell() {
  const [column, row] = at(node);
  const lines = [across, up].filter(Boolean).map((axis, rank) => {
    return axis.label + ": " + number(axis.values[rank ? row : column]);
  });
  const said = { MISSING: "not sampled yet", NONFINITE: "not finite", ESCAPED: "left the domain", ERROR: "error" };
  const unit = SLICE.unit ? " " + SLICE.unit : "";
  lines.push("Loss: " + (SLICE.loss[node] === null ? said[SLICE.status[node]] : number(SLICE.loss[node]) + unit));
  if (SLICE.slope && SLICE.slope[0][node] !== null) {
    lines.push("Gradient along the slice: " + SLICE.slope.map((part) => number(part[node])).join(", "));
    lines.push("Gradient\u2019s length in all dimensions: " + number(SLICE.gradient[node]));
  }
  if (node === lowest && finite.length) lines.push("The lowest loss of the slice");
  readout.textContent = lines.join("\n");
}

function go(to) {
  node = to;
  draw();
  tell();
}

function nearest(event) {
  const box = canvas.getBoundingClientRect();
  const across_ = ((event.clientX - box.left) / box.width) * canvas.width - PAD.left;
  const down = ((event.clientY - box.top) / box.height) * canvas.height - PAD.top;
  const within = (share, count) => Math.max(0, Math.min(count - 1, Math.floor(share * count)));
  const row = up ? within(1 - down / inner.height, rows) : 0;
  return row * columns + within(across_ / inner.width, columns);
}

function showEpisode() {
  const [column, row] = at(node);
  const card = document.getElementById(`episode-${row}-${column}`);
  if (!card) return;
  card.scrollIntoView({ block: "center" });
  const film = card.querySelector("video");
  (film || card).focus();
  if (film) film.play();
}

const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] };
canvas.addEventListener("keydown", (event) => {
  const [column, row] = at(node);
  if (event.key === "Enter") showEpisode();
  else if (event.key === "Home") go(lowest);
  else if (event.key in MOVES) {
    const [right, upwards] = MOVES[event.key].map((step) => step * (event.shiftKey ? 5 : 1));
    const within = (place_, count) => Math.max(0, Math.min(count - 1, place_));
    go(within(row + upwards, rows) * columns + within(column + right, columns));
  } else return;
  event.preventDefault();
});
canvas.addEventListener("pointermove", (event) => go(nearest(event)));
canvas.addEventListener("click", (event) => {
  go(nearest(event));
  showEpisode();
});

function addSwitch(name, label, colour) {
  const box = document.createElement("input");
  box.type = "checkbox";
  box.name = name;
  box.checked = colour !== null;
  if (box.checked) shown.add(name);
  box.addEventListener("change", () => {
    if (box.checked) shown.add(name);
    else shown.delete(name);
    draw();
    document.dispatchEvent(new Event("shown"));
  });
  const line = document.createElement("label");
  line.append(box, " ");
  if (colour) {
    const key = document.createElement("span");
    key.className = "key";
    key.style.background = colour;
    line.append(key);
  }
  line.append(label);
  switches.append(line);
}

if (up && SLICE.slope) addSwitch("arrows", "directions of steepest descent", null);
for (const run of SLICE.runs) {
  if (!shown.has(run.method)) addSwitch(run.method, run.method, run.colour);
}
if (!switches.querySelector("input")) switches.remove();

for (const button of document.querySelectorAll("[data-copy]")) {
  button.addEventListener("click", async () => {
    const source = document.getElementById(button.dataset.copy);
    try {
      await navigator.clipboard.writeText(source.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(source);
      button.textContent = "Selected";
    }
  });
}
go(lowest);
