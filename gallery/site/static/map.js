// The map of a slice on a canvas, a node at a time under the pointer or the arrow keys.
"use strict";

const canvas = document.getElementById("map");
const readout = document.getElementById("readout");
const spoken = document.getElementById("spoken");
const player = document.getElementById("player");
const still = matchMedia("(prefers-reduced-motion: reduce)");
const PAD = { left: 62, right: up ? 84 : 14, top: 12, bottom: 46 };
const BAR = { gap: 14, width: 13 };
const REACH = 14; // pixels from which a click finds a ring
const HATCHES = { NONFINITE: [[0, 8, 8, 0]], ESCAPED: [[0, 0, 8, 8]], ERROR: [[0, 8, 8, 0], [0, 0, 8, 8]] };
const box = { width: 1, height: 1 }; // of what lies between the axes
let node = lowest;
let pen;

// The window of a plane reaches half a cell beyond its outermost nodes.
function place(value, axis, length) {
  const [low, high] = ends(axis);
  const share = (value - low) / (high - low);
  const cell = length / axis.values.length;
  return up ? cell / 2 + share * (length - cell) : share * length;
}
const x = (value) => PAD.left + place(value, across, box.width);
function y(value) {
  if (up) return PAD.top + box.height - place(value, up, box.height);
  return PAD.top + box.height * (1 - level(value));
}
const at = (index) => [index % columns, Math.floor(index / columns)];
function spot(index) {
  const [column, row] = at(index);
  const loss = SLICE.loss[index];
  return [x(across.values[column]), up ? y(up.values[row]) : loss === null ? PAD.top + box.height : y(loss)];
}

function hatch(lines) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 8;
  const brush = tile.getContext("2d");
  brush.fillStyle = "#ffffff";
  brush.fillRect(0, 0, 8, 8);
  brush.strokeStyle = "#5f5f5f";
  brush.beginPath();
  for (const [fromX, fromY, toX, toY] of lines) {
    brush.moveTo(fromX, fromY);
    brush.lineTo(toX, toY);
  }
  brush.stroke();
  return pen.createPattern(tile, "repeat");
}

function drawCells() {
  const [width, tall] = [box.width / columns, box.height / rows];
  const failed = Object.fromEntries(Object.entries(HATCHES).map(([kind, lines]) => [kind, hatch(lines)]));
  SLICE.loss.forEach((loss, index) => {
    const [column, row] = at(index);
    if (SLICE.status[index] === "MISSING") pen.fillStyle = "#ececec";
    else pen.fillStyle = loss === null ? failed[SLICE.status[index]] || failed.ERROR : shade(level(loss));
    pen.fillRect(PAD.left + column * width, PAD.top + box.height - (row + 1) * tall, width + 0.6, tall + 0.6);
  });
}

function drawLine() {
  pen.strokeStyle = ink("curve");
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
  const step = Math.ceil(Math.max(columns, rows) / clamp(Math.floor(box.width / 20), 8, 24));
  const sides = [across, up].map((axis) => ends(axis)[1] - ends(axis)[0]);
  pen.beginPath();
  for (let index = 0; index < SLICE.loss.length; index++) {
    const [column, row] = at(index);
    if (column % step || row % step || SLICE.slope[0][index] === null) continue;
    const down = [-SLICE.slope[0][index] * sides[0], SLICE.slope[1][index] * sides[1]];
    const size = Math.hypot(...down);
    if (size > 0) arrow(spot(index), [down[0] / size, down[1] / size], (0.8 * step * box.width) / columns);
  }
  doubled(pen, "#ffffff", 1.4, "#1a1a1a");
}

function ring(index, radius, colour, around) {
  pen.beginPath();
  pen.arc(...spot(index), radius, 0, 2 * Math.PI);
  doubled(pen, colour, 2, around);
}

function write(text, left, top, align) {
  pen.textAlign = align;
  pen.fillText(text, left, top);
}

function upright(text, left) {
  pen.save();
  pen.translate(left, PAD.top + box.height / 2);
  pen.rotate(-Math.PI / 2);
  write(text, 0, 0, "center");
  pen.restore();
}

function tick(fromX, fromY, toX, toY) {
  pen.beginPath();
  pen.moveTo(fromX, fromY);
  pen.lineTo(toX, toY);
  pen.stroke();
}

// Ticks whose labels do not run into the one before.
function apart(ticks, where, room) {
  let last = null;
  return ticks.filter((value) => {
    if (last !== null && Math.abs(where(value) - last) < room(value)) return false;
    last = where(value);
    return true;
  });
}

function drawAxes() {
  const [bottom, right] = [PAD.top + box.height, PAD.left + box.width];
  pen.fillStyle = ink("ink");
  pen.strokeStyle = ink("quiet");
  pen.lineWidth = 1;
  pen.strokeRect(PAD.left, PAD.top, box.width, box.height);
  pen.font = "12px system-ui, sans-serif";
  for (const value of apart(across.ticks, x, (one) => pen.measureText(number(one)).width + 10)) {
    tick(x(value), bottom, x(value), bottom + 4);
    write(number(value), x(value), bottom + 17, "center");
  }
  for (const value of apart(up ? up.ticks : SLICE.scale.ticks, y, () => 15)) {
    tick(PAD.left - 4, y(value), PAD.left, y(value));
    write(number(value), PAD.left - 7, y(value) + 4, "right");
  }
  pen.font = "13px system-ui, sans-serif";
  write(across.label, PAD.left + box.width / 2, bottom + 37, "center");
  upright(up ? up.label : lossLabel, 15);
  if (up) drawBar(right + BAR.gap, bottom);
}

function drawBar(left, bottom) {
  const high = (share) => bottom - share * box.height;
  for (let step = 0; step < box.height; step++) {
    pen.fillStyle = shade(1 - step / box.height);
    pen.fillRect(left, PAD.top + step, BAR.width, 1.5);
  }
  pen.strokeRect(left, PAD.top, BAR.width, box.height);
  const beyond = { min: [0], max: [1], both: [0, 1], neither: [] }[SLICE.scale.extend];
  for (const end of beyond) { // losses go on beyond this end
    pen.fillStyle = shade(end);
    pen.beginPath();
    pen.moveTo(left, high(end));
    pen.lineTo(left + BAR.width / 2, high(end) + (end ? -9 : 9));
    pen.lineTo(left + BAR.width, high(end));
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
  pen.fillStyle = ink("ink");
  pen.font = "12px system-ui, sans-serif";
  for (const value of apart(SLICE.scale.ticks, (one) => high(level(one)), () => 15)) {
    tick(left + BAR.width, high(level(value)), left + BAR.width + 4, high(level(value)));
    write(number(value), left + BAR.width + 7, high(level(value)) + 4, "left");
  }
  pen.font = "13px system-ui, sans-serif";
  upright(lossLabel, left + PAD.right - BAR.gap - 5);
}

function where(run, row) {
  if (up) return [x(run.u[row]), y(run.v[row])];
  return [x(run.u[row]), run.loss[row] === null ? PAD.top + box.height : y(run.loss[row])];
}

const redraw = fit(canvas, (brush, width, height) => {
  pen = brush;
  box.width = width - PAD.left - PAD.right;
  box.height = height - PAD.top - PAD.bottom;
  pen.fillStyle = ink("ground");
  pen.fillRect(0, 0, width, height);
  if (up) drawCells();
  else if (finite.length) drawLine();
  drawAxes();
  if (shown.has("arrows")) drawArrows();
  SLICE.runs.filter((run) => shown.has(run.label)).forEach((run) => drawRun(pen, run, where));
  for (const episode of SLICE.episodes) ring(episode.row * columns + episode.column, 6, "#ffffff", "#1a1a1a");
  ring(node, 9, "#b5367a", "#ffffff");
});

const SAID = { MISSING: "not sampled yet", NONFINITE: "not finite", ESCAPED: "outside the domain", ERROR: "error", INTERPOLATED: "interpolated" };
const lossSaid = (loss, status) => (loss === null ? SAID[status] : number(loss) + (SLICE.unit ? " " + SLICE.unit : ""));

function episodeAt(index) {
  const [column, row] = at(index);
  return SLICE.episodes.find((one) => one.row === row && one.column === column);
}

function tell() {
  const [column, row] = at(node);
  const lines = [across, up].filter(Boolean).map((axis, rank) => {
    return axis.label + ": " + number(axis.values[rank ? row : column]);
  });
  lines.push("Loss: " + lossSaid(SLICE.loss[node], SLICE.status[node]));
  if (SLICE.slope && SLICE.slope[0][node] !== null) {
    lines.push("Gradient along the slice: " + SLICE.slope.map((part) => number(part[node])).join(", "));
    lines.push("Gradient\u2019s length in all dimensions: " + number(SLICE.gradient[node]));
  }
  if (node === lowest && finite.length) lines.push("The lowest loss of the slice");
  const episode = episodeAt(node);
  if (episode) lines.push("Episode here: " + episode.why);
  readout.textContent = lines.join("\n");
}

// Said once the keys rest, so that a screen reader is not flooded; the pointer says nothing.
let saying;
function say(text, wait = 400) {
  clearTimeout(saying);
  saying = setTimeout(() => (spoken.textContent = text), wait);
}

function go(to) {
  if (to === node) return;
  node = to;
  redraw();
  tell();
}

function pointed(event) {
  const frame = canvas.getBoundingClientRect();
  return [event.clientX - frame.left - canvas.clientLeft, event.clientY - frame.top - canvas.clientTop];
}

function nearest([right, down]) {
  const cell = (share, count) => clamp(up ? Math.floor(share * count) : Math.round(share * (count - 1)), 0, count - 1);
  const row = up ? cell(1 - (down - PAD.top) / box.height, rows) : 0;
  return row * columns + cell((right - PAD.left) / box.width, columns);
}

function ringed(point) {
  const found = SLICE.episodes.map((one) => {
    const index = one.row * columns + one.column;
    return [Math.hypot(...spot(index).map((part, axis) => part - point[axis])), index];
  });
  return found.filter(([distance]) => distance < REACH).sort((one, other) => one[0] - other[0])[0];
}

function showEpisode() {
  const episode = episodeAt(node);
  if (!episode) return;
  const [film, picture] = [player.querySelector("video"), player.querySelector("img")];
  const caption = `${episode.why[0].toUpperCase()}${episode.why.slice(1)}: ${lossSaid(episode.loss, episode.status)}`;
  player.hidden = false;
  film.hidden = !episode.mp4;
  picture.hidden = Boolean(episode.mp4);
  player.querySelector("figcaption").textContent = caption;
  if (episode.mp4) {
    film.poster = episode.webp || "";
    film.src = episode.mp4;
    film.loop = !still.matches;
    film.setAttribute("aria-label", "Episode. " + caption);
    if (!still.matches) film.play().catch(() => {}); // a browser may refuse to play until asked by its own button
  } else {
    film.pause();
    picture.src = episode.webp;
    picture.alt = "Episode. " + caption;
  }
  player.scrollIntoView({ block: "nearest" });
  say("Episode shown. " + caption, 0);
}

const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] };
canvas.addEventListener("keydown", (event) => {
  const [column, row] = at(node);
  const ring_ = { PageDown: 1, PageUp: -1 }[event.key];
  if (event.key === "Enter" || event.key === " ") {
    event.preventDefault();
    showEpisode();
    return;
  }
  if (event.key === "Home") go(lowest);
  else if (ring_ && SLICE.episodes.length) {
    const places = SLICE.episodes.map((one) => one.row * columns + one.column);
    const next = places.indexOf(node) < 0 ? (ring_ > 0 ? 0 : -1) : places.indexOf(node) + ring_;
    go(places[(next + places.length) % places.length]);
  } else if (event.key in MOVES) {
    const [right, upwards] = MOVES[event.key].map((step) => step * (event.shiftKey ? 5 : 1));
    go(clamp(row + upwards, 0, rows - 1) * columns + clamp(column + right, 0, columns - 1));
  } else return;
  event.preventDefault();
  say(readout.textContent.replaceAll("\n", ". "));
});
canvas.addEventListener("pointermove", (event) => go(nearest(pointed(event))));
canvas.addEventListener("click", (event) => {
  const found = ringed(pointed(event));
  go(found ? found[1] : nearest(pointed(event)));
  showEpisode();
});

for (const input of document.querySelectorAll("#switches input")) {
  const change = () => {
    if (input.checked) shown.add(input.name);
    else shown.delete(input.name);
  };
  change();
  input.addEventListener("change", () => {
    change();
    document.dispatchEvent(new Event("shown"));
  });
}
document.getElementById("switches")?.removeAttribute("disabled");
document.dispatchEvent(new Event("shown"));
tell();
