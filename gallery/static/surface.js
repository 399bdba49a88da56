// The slice as a lit surface to turn: painted back to front on a plain canvas, so that it needs no viewer.
"use strict";

const stage = document.getElementById("surface");
const brush = stage.getContext("2d");
const view = { turn: -0.7, tilt: 0.6, zoom: 1 };
const HEIGHT = 0.55; // of the surface, where its sides are 1
const LIGHT = [0.36, 0.48, 0.8];

// A corner of the unit box as [x, y on the canvas, depth towards the viewer].
function project([right, back, high]) {
  const [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
  const [a, b, c] = [right - 0.5, back - 0.5, high - HEIGHT / 2];
  const [across_, away] = [a * cos - b * sin, a * sin + b * cos];
  const scale = 0.7 * stage.height * view.zoom;
  const lifted = c * Math.cos(view.tilt) + away * Math.sin(view.tilt);
  const near = c * Math.sin(view.tilt) - away * Math.cos(view.tilt);
  return [stage.width / 2 + across_ * scale, stage.height / 2 - lifted * scale, near];
}

const corner = (column, row) => {
  const level = SLICE.shade[row * columns + column];
  return level < 0 ? null : [column / (columns - 1), row / (rows - 1), (HEIGHT * level) / 255];
};

function lit(colour, [p, q, , s]) {
  const [u, v] = [q, s].map((end) => end.map((part, axis) => part - p[axis]));
  const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  const facing = normal.reduce((sum, part, axis) => sum + part * LIGHT[axis], 0) / Math.hypot(...normal);
  const light = 0.55 + 0.5 * Math.max(0, facing);
  const part = (start) => Math.min(255, Math.round(light * parseInt(colour.slice(start, start + 2), 16)));
  return `rgb(${[0, 2, 4].map(part).join(" ")})`;
}

// Every cell whose four nodes have a loss; the others stay open.
const cells = [];
for (let row = 0; row + 1 < rows; row++) {
  for (let column = 0; column + 1 < columns; column++) {
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([right, back]) => corner(column + right, row + back));
    if (corners.includes(null)) continue;
    const level = corners.reduce((sum, one) => sum + one[2], 0) / 4 / HEIGHT;
    cells.push({ corners, colour: lit(SLICE.palette[Math.round(255 * level)], corners) });
  }
}

function outline(points, colour) {
  brush.beginPath();
  points.forEach(([right, down]) => brush.lineTo(right, down));
  brush.closePath();
  brush.strokeStyle = colour;
  brush.stroke();
}

function paintRuns() {
  const within = (value, axis) => (value - ends(axis)[0]) / (ends(axis)[1] - ends(axis)[0]);
  for (const run of SLICE.runs.filter((one) => shown.has(one.method))) {
    brush.fillStyle = run.colour;
    run.u.forEach((value, index) => {
      const [right, back] = [within(value, across), within(run.v[index], up)];
      const under = right >= 0 && right <= 1 && back >= 0 && back <= 1;
      const found = under && corner(Math.round(right * (columns - 1)), Math.round(back * (rows - 1)));
      if (!found) return;
      brush.beginPath();
      brush.arc(...project([right, back, found[2] + 0.015]).slice(0, 2), 4, 0, 2 * Math.PI);
      brush.fill();
      brush.strokeStyle = "#ffffff";
      brush.stroke();
    });
  }
}

// Beside the edge that is nearer to the viewer.
function write(label, places) {
  const [one, other] = places.map(project);
  brush.fillText(label, ...(one[2] > other[2] ? one : other).slice(0, 2));
}

function paint() {
  brush.fillStyle = "#ffffff";
  brush.fillRect(0, 0, stage.width, stage.height);
  brush.lineWidth = 1;
  outline([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]].map(project), "#c9c9c9");
  const placed = cells.map(({ corners, colour }) => ({ points: corners.map(project), colour }));
  const depth = ({ points }) => points.reduce((sum, point) => sum + point[2], 0);
  placed.sort((one, other) => depth(one) - depth(other));
  for (const { points, colour } of placed) {
    outline(points, colour); // closes the seams between cells
    brush.fillStyle = colour;
    brush.fill();
  }
  paintRuns();
  brush.fillStyle = "#1a1a1a";
  brush.font = "14px system-ui, sans-serif";
  brush.textAlign = "center";
  write(across.label, [[0.5, -0.12, 0], [0.5, 1.12, 0]]);
  write(up.label, [[-0.12, 0.5, 0], [1.12, 0.5, 0]]);
}

function turn(right, upwards) {
  view.turn += right;
  view.tilt = Math.max(0.05, Math.min(1.5, view.tilt + upwards));
  paint();
}

const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
stage.addEventListener("keydown", (event) => {
  if (event.key in TURNS) turn(...TURNS[event.key]);
  else if (event.key === "+" || event.key === "-") {
    view.zoom = Math.max(0.5, Math.min(4, view.zoom * (event.key === "+" ? 1.15 : 1 / 1.15)));
    paint();
  } else return;
  event.preventDefault();
});
stage.addEventListener("pointerdown", (event) => stage.setPointerCapture(event.pointerId));
stage.addEventListener("pointermove", (event) => {
  if (event.buttons) turn(event.movementX / 150, event.movementY / 150);
});
document.addEventListener("shown", paint);
paint();
