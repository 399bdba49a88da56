// The slice as a lit surface to turn: painted back to front on a plain canvas, so that it needs no viewer.
"use strict";

const stage = document.getElementById("surface");
const azimuth = (SLICE.azimuth * Math.PI) / 180; // of the viewer: where most of the valley is seen from
const view = { turn: Math.atan2(-Math.cos(azimuth), -Math.sin(azimuth)), tilt: 0.6, zoom: 1 };
const HEIGHT = 0.55; // of the surface, where its sides are 1
const WALLS = [0.78, 0.6]; // how light the walls across and along the first axis are; what is flat has its own colour
const FLOOR = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]];

// A corner of the unit box as [x, y on the canvas, depth towards the viewer].
function project([right, back, high]) {
  const [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
  const [a, b, c] = [right - 0.5, back - 0.5, high - HEIGHT / 2];
  const [across_, away] = [a * cos - b * sin, a * sin + b * cos];
  const scale = Math.min(0.62 * stage.clientHeight, 0.5 * stage.clientWidth) * view.zoom;
  const lifted = c * Math.cos(view.tilt) + away * Math.sin(view.tilt);
  const near = c * Math.sin(view.tilt) - away * Math.cos(view.tilt);
  return [stage.clientWidth / 2 + across_ * scale, 0.46 * stage.clientHeight - lifted * scale, near];
}
const flat = (point) => project(point).slice(0, 2);

// The window reaches half a cell beyond the outermost nodes, as the map's does.
const spread = (share, count) => (share * (count - 1) + 0.5) / count;
const along = (value, axis) => spread((value - ends(axis)[0]) / (ends(axis)[1] - ends(axis)[0]), axis.values.length);

// How high the cell of a node is: the ground where nothing is.
function rise(column, row) {
  const inside = column >= 0 && column < columns && row >= 0 && row < rows;
  const loss = inside ? SLICE.loss[row * columns + column] : null;
  return loss === null ? 0 : HEIGHT * clamp(level(loss), 0, 1);
}

function dimmed(colour, light) {
  const part = (start) => Math.round(light * parseInt(colour.slice(start, start + 2), 16));
  return `rgb(${[1, 3, 5].map(part).join(" ")})`;
}

// A node is a flat cell, with walls down to what is lower beside it, in its own colour: nothing is drawn between nodes.
// `side` is where the viewer is, -1 or 1 along both axes: of the four walls the other two are hidden.
function faces(column, row, side) {
  const high = rise(column, row);
  const colour = shade(high / HEIGHT);
  const [left, front] = [column / columns, row / rows];
  const [right, back] = [(column + 1) / columns, (row + 1) / rows];
  const found = [];
  const [x, y] = [side[0] > 0 ? right : left, side[1] > 0 ? back : front];
  for (const [low, light, [from, to]] of [
    [rise(column + side[0], row), WALLS[0], [[x, front], [x, back]]],
    [rise(column, row + side[1]), WALLS[1], [[left, y], [right, y]]],
  ]) {
    if (low >= high) continue;
    const corners = [[...from, low], [...to, low], [...to, high], [...from, high]];
    found.push({ corners, colour: dimmed(colour, light) });
  }
  found.push({ corners: [[left, front], [right, front], [right, back], [left, back]].map((at) => [...at, high]), colour });
  return found;
}

// Cells from the farthest to the nearest: none is covered by one that is drawn before it.
function* inOrder(side) {
  const turned = (count, towards) => [...Array(count).keys()].sort((one, other) => towards * (one - other));
  for (const row of turned(rows, side[1])) {
    for (const column of turned(columns, side[0])) {
      if (SLICE.loss[row * columns + column] !== null) yield* faces(column, row, side);
    }
  }
}

function outline(brush, points, colour) {
  brush.beginPath();
  points.forEach(([right, down]) => brush.lineTo(right, down));
  brush.closePath();
  brush.strokeStyle = colour;
  brush.stroke();
}

// Where a search's point lies on the surface: over its place on the slice, however far off it is.
function draped(run, row) {
  const [right, back] = [along(run.u[row], across), along(run.v[row], up)].map((part) => clamp(part, 0, 1 - 1e-9));
  const [column, line] = [Math.floor(right * columns), Math.floor(back * rows)];
  if (SLICE.loss[line * columns + column] === null) return null;
  return flat([right, back, rise(column, line) + 0.015]);
}

// Name and ends of an axis beside its edge that is nearer to the viewer. A name that has no room there comes below the
// floor, and below one of those that are `under` it already if it would run into that.
function beside(brush, axis, put, under) {
  const edge = (side, share, off) => put(share, side ? 1 + off : -off);
  const side = project(edge(1, 0.5, 0))[2] > project(edge(0, 0.5, 0))[2] ? 1 : 0;
  brush.font = "12px system-ui, sans-serif";
  brush.textAlign = "center";
  for (const value of [axis.ticks[0], axis.ticks[axis.ticks.length - 1]]) {
    const [right, down] = flat(edge(side, along(value, axis), 0.07));
    brush.fillText(number(value), right, down + 4);
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
  const lowest = Math.max(...FLOOR.map((corner) => flat(corner)[1]));
  brush.textAlign = "center";
  brush.fillText(axis.label, middle, lowest + 36 + 17 * line);
}

// The height's scale at the corner that is farthest to the left.
function heights(brush) {
  const [right, back] = FLOOR.reduce((most, one) => (project(one)[0] < project(most)[0] ? one : most));
  const high = (share) => flat([right, back, HEIGHT * share]);
  brush.strokeStyle = ink("quiet");
  brush.beginPath();
  brush.moveTo(...high(0));
  brush.lineTo(...high(1));
  brush.stroke();
  brush.textAlign = "right";
  brush.font = "12px system-ui, sans-serif";
  let last = Infinity;
  for (const value of SLICE.scale.ticks) {
    const [left, down] = high(level(value));
    if (last - down < 15) continue;
    last = down;
    brush.beginPath();
    brush.moveTo(left - 4, down);
    brush.lineTo(left, down);
    brush.stroke();
    brush.fillText(number(value), left - 7, down + 4);
  }
  const [left, down] = high(1);
  brush.font = "13px system-ui, sans-serif";
  brush.fillText(lossLabel, left + 8, down - 12);
}

const repaint = fit(stage, (brush, width, height) => {
  brush.fillStyle = ink("ground");
  brush.fillRect(0, 0, width, height);
  brush.lineWidth = 1;
  outline(brush, FLOOR.map(project), ink("line"));
  const side = [-Math.sign(Math.sin(view.turn)) || 1, -Math.sign(Math.cos(view.turn)) || 1];
  for (const { corners, colour } of inOrder(side)) {
    outline(brush, corners.map(project), colour); // closes the seams between cells
    brush.fillStyle = colour;
    brush.fill();
  }
  SLICE.runs.filter((run) => shown.has(run.label)).forEach((run) => drawRun(brush, run, draped));
  brush.fillStyle = ink("ink");
  brush.lineWidth = 1;
  brush.font = "13px system-ui, sans-serif";
  const under = [];
  beside(brush, across, (share, off) => [share, off, 0], under);
  beside(brush, up, (share, off) => [off, share, 0], under);
  heights(brush);
});

function turn(right, upwards) {
  view.turn += right;
  view.tilt = clamp(view.tilt + upwards, 0.05, 1.5);
  repaint();
}

const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
stage.addEventListener("keydown", (event) => {
  if (event.key in TURNS) turn(...TURNS[event.key]);
  else if (event.key === "+" || event.key === "-") {
    view.zoom = clamp(view.zoom * (event.key === "+" ? 1.15 : 1 / 1.15), 0.5, 4);
    repaint();
  } else return;
  event.preventDefault();
});
stage.addEventListener("pointerdown", (event) => stage.setPointerCapture(event.pointerId));
stage.addEventListener("pointermove", (event) => {
  if (event.buttons) turn(event.movementX / 150, event.movementY / 150);
});
