// The map of a slice on a canvas. What goes with the data is painted into bitmaps when it changes; a frame stretches
// them over the window and draws what has a size of its own on the screen.
"use strict";

const canvas = document.getElementById("map");
const PAD = { left: 62, right: up ? 94 : 14, top: 12, bottom: 46 };
const BAR = { gap: 14, width: 13 };
const STRIPES = { NONFINITE: [[0, 8, 8, 0]], ESCAPED: [[0, 0, 8, 8]], ERROR: [[0, 8, 8, 0], [0, 0, 8, 8]] };
const box = { width: 1, height: 1 }; // of what lies between the axes
const SETTLED = 120; // milliseconds without a change of the view after which iso-lines are drawn sharp again
let node = lowest;
let pen;

// The window of a plane reaches half a cell beyond its outermost nodes. Here a place is in shares of that.
function share(value, axis) {
  const [low, high] = ends(axis);
  const along = (value - low) / (high - low);
  return up ? (0.5 + along * (axis.values.length - 1)) / axis.values.length : along;
}
function valueAt(place, axis) {
  const [low, high] = ends(axis);
  const count = axis.values.length;
  return low + (high - low) * (up ? (place * count - 0.5) / (count - 1) : place);
}
const rightOf = (place) => PAD.left + (place - view.right) * view.zoom * box.width;
const heightOf = (place) => PAD.top + box.height * (1 - (up ? (place - view.up) * view.zoom : place));
const x = (value) => rightOf(share(value, across));
const y = (value) => heightOf(up ? share(value, up) : level(value));
function spot(index) {
  const [column, row] = at(index);
  const loss = losses[index];
  if (up) return [rightOf((column + 0.5) / columns), heightOf((row + 0.5) / rows)];
  return [rightOf(columns > 1 ? column / (columns - 1) : 0), loss === loss ? y(loss) : PAD.top + box.height];
}
function inside([right, down]) {
  const [a, b] = [right - PAD.left, down - PAD.top];
  return a > -0.5 && a < box.width + 0.5 && b > -0.5 && b < box.height + 0.5;
}
// A pointer's place in shares of the window.
function placeOf(event) {
  const [right, down] = pointed(canvas, event);
  return [(right - PAD.left) / box.width, 1 - (down - PAD.top) / box.height];
}

// A pattern of stripes or dots in pixels of the screen, however deep the zoom is.
function pattern(paint, ground) {
  const tile = offscreen(8, 8);
  const brush = tile.getContext("2d");
  if (ground) {
    brush.fillStyle = ground;
    brush.fillRect(0, 0, 8, 8);
  }
  paint(brush);
  return brush.createPattern(tile, "repeat");
}
function striped(lines) {
  return pattern((brush) => {
    brush.strokeStyle = "#5f5f5f";
    brush.beginPath();
    for (const [fromX, fromY, toX, toY] of lines) {
      brush.moveTo(fromX, fromY);
      brush.lineTo(toX, toY);
    }
    brush.stroke();
  }, "#ffffff");
}
function dotted(brush) {
  for (const [size, colour] of [[2, "#1a1a1a"], [1.1, "#ffffff"]]) {
    brush.fillStyle = colour;
    brush.beginPath();
    brush.arc(4, 4, size, 0, 2 * Math.PI);
    brush.fill();
  }
}

function crossed_(brush) {
  for (const [thick, colour] of [[2.6, "#1a1a1a"], [1.2, "#ffffff"]]) {
    brush.lineWidth = thick;
    brush.strokeStyle = colour;
    brush.beginPath();
    brush.moveTo(1, 4);
    brush.lineTo(7, 4);
    brush.moveTo(4, 1);
    brush.lineTo(4, 7);
    brush.stroke();
  }
}

// A bitmap of the nodes, of a pixel each, from numbers of 32 bits; row 0 is its lowest.
function bitmap(wide, tall, colourOf) {
  const canvas_ = offscreen(wide, tall);
  const brush = canvas_.getContext("2d");
  const image = brush.createImageData(wide, tall);
  const held = new Uint32Array(image.data.buffer);
  for (let row = 0; row < tall; row++) {
    for (let column = 0; column < wide; column++) held[(tall - 1 - row) * wide + column] = colourOf(row * wide + column);
  }
  brush.putImageData(image, 0, 0);
  return canvas_;
}

const layers = { of: null, map: null, failures: [], finer: null, floor: null, lines: [] };
const FLOOR_FROM = 0.01; // of the range of the losses: replicas that differ by more are marked
function aboveFloor() {
  const known = losses.filter((loss) => loss === loss);
  const range = known.reduce((most, loss) => Math.max(most, loss), -Infinity) - losses[lowest];
  return (index) => floors[index] > FLOOR_FROM * range;
}
const mask = (wide, tall, where) => bitmap(wide, tall, (index) => (where(index) ? 0xff000000 : 0));
function paintLayers() {
  if (!up) return;
  layers.map = bitmap(columns, rows, (index) => colours[index]);
  layers.lines = [];
  sharp.stale = true;
  if (layers.of !== losses) Object.assign(layers, { of: losses, failures: [], finer: null, floor: null });
  if (layers.failures.length || layers.finer || layers.floor) return; // they do not depend on the scale
  for (const [kind, lines] of Object.entries(STRIPES)) {
    const code = Number(Object.keys(SLICE.statuses).find((one) => SLICE.statuses[one] === kind));
    if (!drawnStatuses.includes(code)) continue;
    layers.failures.push({ fill: striped(lines), mask: mask(columns, rows, (index) => drawnStatuses[index] === code) });
  }
  if (floors) layers.floor = { fill: pattern(crossed_), mask: mask(columns, rows, aboveFloor()) };
  if (finer) layers.finer = { fill: pattern(dotted), mask: mask(columns - 1, rows - 1, (index) => finer[index]) };
}

// Stretch a picture of part of the slice, in shares of it from its lower left corner, over the window.
function stretch(brush, picture, left, low, wide, tall, offX = PAD.left, offY = PAD.top) {
  const [right, down] = [(left - view.right) * view.zoom * box.width, box.height * (1 - (low + tall - view.up) * view.zoom)];
  brush.drawImage(picture, offX + right, offY + down, wide * view.zoom * box.width, tall * view.zoom * box.height);
}

// What is patterned: on a canvas of its own, where a mask cuts the pattern out.
const scratch = offscreen(1, 1);
const scratchPen = scratch.getContext("2d");
function drawPatterned({ fill, mask: where }, left, low, wide, tall, dots) {
  sized(scratch, dots);
  scratchPen.setTransform(dots, 0, 0, dots, 0, 0);
  scratchPen.imageSmoothingEnabled = false;
  scratchPen.globalCompositeOperation = "copy";
  scratchPen.fillStyle = fill;
  scratchPen.fillRect(0, 0, box.width, box.height);
  scratchPen.globalCompositeOperation = "destination-in";
  stretch(scratchPen, where, left, low, wide, tall, 0, 0);
  pen.drawImage(scratch, PAD.left, PAD.top, box.width, box.height);
}
function sized(canvas_, dots) {
  const [wide, tall] = [Math.ceil(box.width * dots), Math.ceil(box.height * dots)];
  if (canvas_.width !== wide || canvas_.height !== tall) [canvas_.width, canvas_.height] = [wide, tall];
}

function drawCells(dots) {
  pen.imageSmoothingEnabled = false;
  for (const failure of layers.failures) drawPatterned(failure, 0, 0, 1, 1, dots);
  stretch(pen, layers.map, 0, 0, 1, 1);
  if (layers.finer && shown.has("finer")) {
    drawPatterned(layers.finer, 0.5 / columns, 0.5 / rows, 1 - 1 / columns, 1 - 1 / rows, dots);
  }
  if (layers.floor && shown.has("floor")) drawPatterned(layers.floor, 0, 0, 1, 1, dots);
  if (shown.has("isolines")) drawIsolines(dots);
}

// Iso-lines are drawn for a view on a canvas of their own, which goes along with the map until it rests.
const sharp = { canvas: offscreen(1, 1), stale: true, right: 0, up: 0, zoom: 1 };
function drawIsolines(dots) {
  if (sharp.stale) drawSharp(dots);
  pen.imageSmoothingEnabled = true;
  stretch(pen, sharp.canvas, sharp.right, sharp.up, 1 / sharp.zoom, 1 / sharp.zoom);
}
function drawSharp(dots) {
  if (!layers.lines.length) layers.lines = ISOLINES.map(isoline);
  Object.assign(sharp, { stale: false, right: view.right, up: view.up, zoom: view.zoom });
  sized(sharp.canvas, dots);
  const brush = sharp.canvas.getContext("2d");
  brush.setTransform(1, 0, 0, 1, 0, 0);
  brush.clearRect(0, 0, sharp.canvas.width, sharp.canvas.height);
  brush.setTransform(dots, 0, 0, dots, -PAD.left * dots, -PAD.top * dots);
  brush.beginPath();
  for (const line of layers.lines) {
    for (let part = 0; part < line.length; part += 4) {
      brush.moveTo(rightOf((line[part] + 0.5) / columns), heightOf((line[part + 1] + 0.5) / rows));
      brush.lineTo(rightOf((line[part + 2] + 0.5) / columns), heightOf((line[part + 3] + 0.5) / rows));
    }
  }
  doubled(brush, "#ffffff", 1, "#00000066");
}

function drawLine() {
  pen.strokeStyle = ink("curve");
  pen.lineWidth = 1.5;
  pen.beginPath();
  let on = false;
  for (let index = 0; index < losses.length; index++) {
    const there = losses[index] === losses[index];
    if (there) on ? pen.lineTo(...spot(index)) : pen.moveTo(...spot(index));
    on = there;
  }
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

// How many nodes lie from one that has a gradient to the next: a fine slice has them at some nodes alone.
function spacing() {
  let least = Infinity;
  for (let index = 0, last = -Infinity; index < gradients.length && least > 1; index++) {
    if (index % columns === 0) last = -Infinity;
    if (gradients[index] !== gradients[index]) continue;
    least = Math.min(least, index - last);
    last = index;
  }
  return Number.isFinite(least) ? least : 1;
}
let given = slopes && up ? spacing() : 1;

// How many nodes lie from arrow to arrow: as few as leave room for them, doubled so that zooming adds arrows.
function thinned() {
  const fit_ = clamp(Math.floor(box.width / 20), 8, 24);
  let step = given;
  while (Math.max(columns, rows) / view.zoom / step > fit_) step *= 2;
  return step;
}

// Steepest descent in fractions of the picture's sides, as in the picture below the map.
function drawArrows() {
  const step = thinned();
  const sides = [sideOf(across), sideOf(up)];
  const window_ = (begin, count) => [Math.ceil((Math.max(0, begin * count - 1)) / step) * step, Math.min(count, (begin + 1 / view.zoom) * count + 1)];
  const [[left, right], [low, high]] = [window_(view.right, columns), window_(view.up, rows)];
  pen.beginPath();
  for (let row = low; row < high; row += step) {
    for (let column = left; column < right; column += step) {
      const index = row * columns + column;
      const down = [-slopes[0][index] * sides[0], slopes[1][index] * sides[1]];
      const size = Math.hypot(...down);
      if (size > 0) arrow(spot(index), [down[0] / size, down[1] / size], (0.8 * step * view.zoom * box.width) / columns);
    }
  }
  doubled(pen, "#ffffff", 1.4, "#1a1a1a");
}

function ring(index, radius, colour, around) {
  if (!inside(spot(index))) return;
  pen.beginPath();
  pen.arc(...spot(index), radius, 0, 2 * Math.PI);
  doubled(pen, colour, 2, around);
}

function where(run, row) {
  if (up) return [x(run.u[row]), y(run.v[row])];
  return [x(run.u[row]), run.loss[row] === null ? PAD.top + box.height : y(run.loss[row])];
}

function drawWindow(dots) {
  pen.save();
  pen.beginPath();
  pen.rect(PAD.left, PAD.top, box.width, box.height);
  pen.clip();
  if (up) drawCells(dots);
  else drawLine();
  if (up && shown.has("arrows")) drawArrows();
  if (view.zoom > 1) drawRuns();
  pen.restore();
  if (view.zoom === 1) drawRuns(); // marks at the edge are whole
}
const drawRuns = () => SLICE.runs.filter((run) => shown.has(run.label)).forEach((run) => drawRun(pen, run, where));

const redraw = fit(canvas, (brush, width, height, dots) => {
  pen = brush;
  const room = [width - PAD.left - PAD.right, height - PAD.top - PAD.bottom];
  if (room[0] !== box.width || room[1] !== box.height) [box.width, box.height, sharp.stale] = [...room, true];
  pen.fillStyle = ink("ground");
  pen.fillRect(0, 0, width, height);
  drawWindow(dots);
  drawAxes();
  if (up) drawProfileLine();
  for (const episode of SLICE.episodes) ring(episode.row * columns + episode.column, 6, "#ffffff", "#1a1a1a");
  ring(node, 9, "#b5367a", "#ffffff");
});

let settling;
document.addEventListener("viewed", () => {
  redraw();
  clearTimeout(settling);
  settling = setTimeout(() => {
    sharp.stale = true;
    redraw();
    document.dispatchEvent(new Event("settled"));
  }, SETTLED);
});
document.addEventListener("scaled", paintLayers);
paintLayers();
document.addEventListener("loaded", () => {
  given = slopes && up ? spacing() : 1;
  redraw();
});
