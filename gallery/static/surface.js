// The slice as a lit surface to turn: painted back to front on a plain canvas, so that it needs no viewer.
"use strict";

const stage = document.getElementById("surface");
const view = { turn: -0.7, tilt: 0.6, zoom: 1 };
const HEIGHT = 0.55; // of the surface, where its sides are 1
const LIGHT = [0.36, 0.48, 0.8];
const FLOOR = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]];

// A corner of the unit box as [x, y on the canvas, depth towards the viewer].
function project([right, back, high]) {
  const [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
  const [a, b, c] = [right - 0.5, back - 0.5, high - HEIGHT / 2];
  const [across_, away] = [a * cos - b * sin, a * sin + b * cos];
  const scale = Math.min(0.68 * stage.clientHeight, 0.5 * stage.clientWidth) * view.zoom;
  const lifted = c * Math.cos(view.tilt) + away * Math.sin(view.tilt);
  const near = c * Math.sin(view.tilt) - away * Math.cos(view.tilt);
  return [stage.clientWidth / 2 + across_ * scale, stage.clientHeight / 2 - lifted * scale, near];
}
const flat = (point) => project(point).slice(0, 2);

const corner = (column, row) => {
  const loss = SLICE.loss[row * columns + column];
  return loss === null ? null : [column / (columns - 1), row / (rows - 1), HEIGHT * clamp(level(loss), 0, 1)];
};

function lit(colour, [p, q, , s]) {
  const [u, v] = [q, s].map((end) => end.map((part, axis) => part - p[axis]));
  const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  const facing = normal.reduce((sum, part, axis) => sum + part * LIGHT[axis], 0) / Math.hypot(...normal);
  const light = 0.55 + 0.5 * Math.max(0, facing);
  const part = (start) => Math.min(255, Math.round(light * parseInt(colour.slice(start, start + 2), 16)));
  return `rgb(${[1, 3, 5].map(part).join(" ")})`;
}

// Every cell whose four nodes have a loss; the others stay open.
const cells = [];
for (let row = 0; row + 1 < rows; row++) {
  for (let column = 0; column + 1 < columns; column++) {
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([right, back]) => corner(column + right, row + back));
    if (corners.includes(null)) continue;
    const mean = corners.reduce((sum, one) => sum + one[2], 0) / 4 / HEIGHT;
    cells.push({ corners, colour: lit(shade(mean), corners) });
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
  const share = (value, axis) => (value - ends(axis)[0]) / (ends(axis)[1] - ends(axis)[0]);
  const [right, back] = [share(run.u[row], across), share(run.v[row], up)].map((part) => clamp(part, 0, 1));
  const under = corner(Math.round(right * (columns - 1)), Math.round(back * (rows - 1)));
  return under && flat([right, back, under[2] + 0.015]);
}

// Beside the edge that is nearer to the viewer; below the other axis' label, where both would be in one place.
function beside(brush, axis, along, other) {
  const edge = (side, share, off) => along(share, side ? 1 + off : -off);
  const side = project(edge(1, 0.5, 0))[2] > project(edge(0, 0.5, 0))[2] ? 1 : 0;
  brush.textAlign = "center";
  const [middle, under] = flat(edge(side, 0.5, 0.2));
  const room = brush.measureText(axis.label).width / 2 + 6;
  const label = { middle: clamp(middle, room, stage.clientWidth - room), under, room };
  if (other && Math.abs(label.middle - other.middle) < room + other.room && Math.abs(under - other.under) < 16) {
    label.under = other.under + 16;
  }
  brush.fillText(axis.label, label.middle, label.under);
  const share = (value) => (value - ends(axis)[0]) / (ends(axis)[1] - ends(axis)[0]);
  brush.font = "12px system-ui, sans-serif";
  for (const value of [axis.ticks[0], axis.ticks[axis.ticks.length - 1]]) {
    const [right, down] = flat(edge(side, share(value), 0.07));
    brush.fillText(number(value), right, down + 4);
  }
  brush.font = "13px system-ui, sans-serif";
  return label;
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
  const placed = cells.map(({ corners, colour }) => ({ points: corners.map(project), colour }));
  const depth = ({ points }) => points.reduce((sum, point) => sum + point[2], 0);
  placed.sort((one, other) => depth(one) - depth(other));
  for (const { points, colour } of placed) {
    outline(brush, points, colour); // closes the seams between cells
    brush.fillStyle = colour;
    brush.fill();
  }
  SLICE.runs.filter((run) => shown.has(run.label)).forEach((run) => drawRun(brush, run, draped));
  brush.fillStyle = ink("ink");
  brush.lineWidth = 1;
  brush.font = "13px system-ui, sans-serif";
  const first = beside(brush, across, (share, off) => [share, off, 0]);
  beside(brush, up, (share, off) => [off, share, 0], first);
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
