// The slice as a lit surface to turn. A pixel column of the picture sees the slice along one line: its cells are walked
// through from the nearest on, and each fills what nothing nearer has. That costs as much as there are pixels, however
// fine the slice is, and needs no viewer.
"use strict";

const stage = document.getElementById("surface");
const azimuth = (SLICE.azimuth * Math.PI) / 180; // of the viewer: where most of the valley is seen from
const FIRST = { turn: Math.atan2(-Math.cos(azimuth), -Math.sin(azimuth)), tilt: 0.6, zoom: 1 };
const camera = { ...FIRST };
const FLOOR = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]];
const FINEST = 4e6; // pixels of the picture, at most, where it is drawn twice as fine as the screen is
let turning = false;

// How many pixels a side of the slice takes, on a canvas of such a size.
const sideLength = (width, height) => Math.min(0.62 * height, 0.5 * width) * camera.zoom;

// A corner of the unit box as [x, y on the canvas, depth towards the viewer].
function project([right, back, high]) {
  const [cos, sin] = [Math.cos(camera.turn), Math.sin(camera.turn)];
  const [a, b, c] = [right - 0.5, back - 0.5, high - HEIGHT / 2];
  const [across_, away] = [a * cos - b * sin, a * sin + b * cos];
  const size = sideLength(stage.clientWidth, stage.clientHeight);
  const lifted = c * Math.cos(camera.tilt) + away * Math.sin(camera.tilt);
  const near = c * Math.sin(camera.tilt) - away * Math.cos(camera.tilt);
  return [stage.clientWidth / 2 + across_ * size, 0.46 * stage.clientHeight - lifted * size, near];
}
const flat = (point) => project(point).slice(0, 2);

// The window reaches half a cell beyond the outermost nodes, as the map's does.
const spread = (part, count) => (part * (count - 1) + 0.5) / count;
const along = (value, axis) => spread((value - ends(axis)[0]) / sideOf(axis), axis.values.length);

// How high the cell of a node is: the ground where nothing is.
function rise(column, row) {
  const within = column >= 0 && column < columns && row >= 0 && row < rows;
  return (within && rises[row * columns + column]) || 0;
}

// Pictures that are drawn into, of the finenesses that are needed, kept as long as the canvas has its size.
const pictures = new Map();
function pictureOf(wide, tall) {
  const key = `${wide} ${tall}`;
  if (!pictures.has(key)) {
    if (pictures.size > 1) pictures.clear();
    const canvas_ = offscreen(wide, tall);
    const brush = canvas_.getContext("2d");
    const image = brush.createImageData(wide, tall);
    pictures.set(key, { canvas: canvas_, brush, image, held: new Uint32Array(image.data.buffer) });
  }
  return pictures.get(key);
}

// A node is a flat cell, with walls down to what is lower beside it, in its own colour: nothing is drawn between nodes.
function paintSurface(picture, wide, tall) {
  const { held } = picture;
  held.fill(0);
  const size = sideLength(wide, tall);
  for (let column = 0; column < wide; column++) look(held, column, wide, tall, (column + 0.5 - wide / 2) / size, size);
  picture.brush.putImageData(picture.image, 0, 0);
}

// Walk along the line that a pixel column sees, `aside` of the middle [sides of the slice].
function look(held, pixel, wide, tall, aside, size) {
  const [cos, sin] = [Math.cos(camera.turn), Math.sin(camera.turn)];
  const [lift, sink] = [Math.cos(camera.tilt) * size, Math.sin(camera.tilt) * size];
  const [startX, startY] = [(0.5 + aside * cos) * columns, (0.5 - aside * sin) * rows];
  const [stepX, stepY] = [sin * columns || 1e-12, cos * rows || 1e-12]; // nodes for each side that it goes away
  const [enterX, enterY] = [((stepX > 0 ? 0 : columns) - startX) / stepX, ((stepY > 0 ? 0 : rows) - startY) / stepY];
  const leave = Math.min(((stepX > 0 ? columns : 0) - startX) / stepX, ((stepY > 0 ? rows : 0) - startY) / stepY);
  let away = Math.max(enterX, enterY);
  if (!(away < leave)) return;
  let wall = enterX > enterY ? walls[0] : walls[1];
  let column = clamp(Math.floor(startX + (away + 1e-9) * stepX), 0, columns - 1);
  let row = clamp(Math.floor(startY + (away + 1e-9) * stepY), 0, rows - 1);
  const [nextX, nextY] = [Math.sign(stepX), Math.sign(stepY)];
  const [acrossX, acrossY] = [Math.abs(1 / stepX), Math.abs(1 / stepY)];
  let untilX = (column + (stepX > 0 ? 1 : 0) - startX) / stepX;
  let untilY = (row + (stepY > 0 ? 1 : 0) - startY) / stepY;
  const ground = 0.46 * tall + (HEIGHT / 2) * lift + 0.5; // where height 0 is seen, not away from the middle
  let low = tall; // pixels from here on down are filled
  while (column >= 0 && column < columns && row >= 0 && row < rows) {
    const until = Math.min(untilX, untilY);
    const index = row * columns + column;
    const high = rises[index];
    if (high === high) {
      low = Math.min(low, Math.max(0, Math.floor(ground - away * sink)));
      const edge = Math.max(0, Math.floor(ground - high * lift - away * sink));
      const end = Math.max(0, Math.floor(ground - high * lift - until * sink));
      for (; low > edge; low--) held[(low - 1) * wide + pixel] = wall[index];
      for (; low > end; low--) held[(low - 1) * wide + pixel] = colours[index];
    }
    away = until;
    if (untilX < untilY) {
      column += nextX;
      untilX += acrossX;
      wall = walls[0];
    } else {
      row += nextY;
      untilY += acrossY;
      wall = walls[1];
    }
  }
}

// Where a search's point lies on the surface: over its place on the slice, however far off it is.
function draped(run, row) {
  const [right, back] = [along(run.u[row], across), along(run.v[row], up)].map((part) => clamp(part, 0, 1 - 1e-9));
  const [column, line] = [Math.floor(right * columns), Math.floor(back * rows)];
  if (Number.isNaN(rises[line * columns + column])) return null;
  return flat([right, back, rise(column, line) + 0.015]);
}

function outline(brush, points, colour) {
  brush.beginPath();
  points.forEach(([right, down]) => brush.lineTo(right, down));
  brush.closePath();
  brush.strokeStyle = colour;
  brush.stroke();
}

// Name and ends of an axis beside its edge that is nearer to the viewer. A name that has no room there comes below the
// floor, and below one of those that are `under` it already if it would run into that.
function beside(brush, axis, put, under) {
  const edge = (side, part, off) => put(part, side ? 1 + off : -off);
  const side = project(edge(1, 0.5, 0))[2] > project(edge(0, 0.5, 0))[2] ? 1 : 0;
  brush.font = "12px system-ui, sans-serif";
  brush.textAlign = "center";
  for (const value of [axis.ticks[0], axis.ticks[axis.ticks.length - 1]]) {
    const [right, down] = flat(edge(side, along(value, axis), 0.07));
    brush.fillText(valueSaid(axis, value), right, down + 4);
  }
  brush.font = "13px system-ui, sans-serif";
  const [[right, down], wide, long] = [flat(edge(side, 0.5, 0.09)), stage.clientWidth, brush.measureText(axis.label).width];
  const onLeft = right < wide / 2;
  if (onLeft ? right - long > 4 : right + long < wide - 4) {
    brush.textAlign = onLeft ? "right" : "left";
    brush.fillText(axis.label, right, down + 8);
    return;
  }
  const middle = clamp(right, long / 2 + 4, wide - long / 2 - 4);
  const line = under.filter((other) => Math.abs(middle - other.middle) < (long + other.long) / 2 + 12).length;
  under.push({ middle, long });
  const lowest_ = Math.max(...FLOOR.map((corner) => flat(corner)[1]));
  brush.textAlign = "center";
  brush.fillText(axis.label, middle, lowest_ + 36 + 17 * line);
}

// The height's scale at the corner that is farthest to the left.
function heights(brush) {
  const [right, back] = FLOOR.reduce((most_, one) => (project(one)[0] < project(most_)[0] ? one : most_));
  const high = (part) => flat([right, back, HEIGHT * part]);
  brush.strokeStyle = ink("quiet");
  brush.beginPath();
  brush.moveTo(...high(0));
  brush.lineTo(...high(1));
  brush.stroke();
  brush.textAlign = "right";
  brush.font = "12px system-ui, sans-serif";
  let last = Infinity;
  scale.ticks.forEach((value, place) => {
    const [left, down] = high(scaleName === RANK ? place / (scale.ticks.length - 1) : level(value));
    if (last - down < 15) return;
    last = down;
    brush.beginPath();
    brush.moveTo(left - 4, down);
    brush.lineTo(left, down);
    brush.stroke();
    brush.fillText(number(value), left - 7, down + 4);
  });
  const [left, down] = high(1);
  brush.font = "13px system-ui, sans-serif";
  brush.fillText(scaleName === RANK ? lossLabel + ", by rank" : lossLabel, left + 8, down - 12);
}

const repaint = fit(stage, (brush, width, height, dots) => {
  brush.fillStyle = ink("ground");
  brush.fillRect(0, 0, width, height);
  brush.lineWidth = 1;
  outline(brush, FLOOR.map(project), ink("line"));
  const fine = !turning && width * height * dots * dots * 4 <= FINEST ? 2 : 1; // at rest edges are smooth
  const [wide, tall] = [Math.round(width * dots * fine), Math.round(height * dots * fine)];
  const picture = pictureOf(wide, tall);
  paintSurface(picture, wide, tall);
  brush.drawImage(picture.canvas, 0, 0, width, height);
  SLICE.runs.filter((run) => shown.has(run.label)).forEach((run) => drawRun(brush, run, draped));
  brush.fillStyle = ink("ink");
  brush.lineWidth = 1;
  const under = [];
  beside(brush, across, (part, off) => [part, off, 0], under);
  beside(brush, up, (part, off) => [off, part, 0], under);
  heights(brush);
});

function setCamera(turn, tilt, zoom) {
  Object.assign(camera, { turn, tilt: clamp(tilt, 0.05, 1.5), zoom: clamp(zoom, 0.5, 4) });
  repaint();
  document.dispatchEvent(new Event("walked"));
}
const turn = (right, upwards) => setCamera(camera.turn + right, camera.tilt + upwards, camera.zoom);
const nearer = (factor) => setCamera(camera.turn, camera.tilt, camera.zoom * factor);

const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
stage.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return; // the browser's own
  if (event.key in TURNS) turn(...TURNS[event.key]);
  else if (event.key === "+" || event.key === "=") nearer(1.15);
  else if (event.key === "-") nearer(1 / 1.15);
  else if (event.key === "0") setCamera(FIRST.turn, FIRST.tilt, FIRST.zoom);
  else return;
  event.preventDefault();
});
stage.addEventListener("pointerdown", (event) => {
  stage.setPointerCapture(event.pointerId);
  turning = true;
});
stage.addEventListener("pointermove", (event) => {
  if (event.buttons) turn(event.movementX / 150, event.movementY / 150);
});
for (const end of ["pointerup", "pointercancel"]) {
  stage.addEventListener(end, () => {
    turning = false;
    repaint();
  });
}
stage.addEventListener("wheel", (event) => {
  if (!event.ctrlKey && !event.metaKey && document.activeElement !== stage) return;
  event.preventDefault();
  nearer(Math.exp(-clamp(event.deltaY, -200, 200) / 400));
}, { passive: false });
