// The marks of searches, of which the map and the surface have the same.
"use strict";

// A mark of a search: filled with the loss it had, rimmed with its method's colour.
function mark(pen, at, radius, fill, rim, around) {
  for (const [size, colour] of [[radius + 1.6, around], [radius + 0.9, rim], [Math.max(radius - 0.6, 0.8), fill]]) {
    pen.fillStyle = colour;
    pen.beginPath();
    pen.arc(...at, size, 0, 2 * Math.PI);
    pen.fill();
  }
}

function star(pen, [x, y], radius, fill, rim, around) {
  pen.beginPath();
  for (let point = 0; point < 10; point++) {
    const [angle, reach] = [(point * Math.PI) / 5 - Math.PI / 2, point % 2 ? 0.45 * radius : radius];
    pen.lineTo(x + reach * Math.cos(angle), y + reach * Math.sin(angle));
  }
  pen.closePath();
  pen.lineJoin = "round";
  for (const [width, colour] of [[5, around], [2.4, rim]]) {
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.stroke();
  }
  pen.fillStyle = fill;
  pen.fill();
}

function cross(pen, [x, y]) {
  pen.beginPath();
  pen.moveTo(x - 3.5, y - 3.5);
  pen.lineTo(x + 3.5, y + 3.5);
  pen.moveTo(x - 3.5, y + 3.5);
  pen.lineTo(x + 3.5, y - 3.5);
  doubled(pen, "#1a1a1a", 1.4);
}

// A stroke that shows on every colour of the map.
function doubled(pen, colour, width, around = "#ffffff") {
  for (const [thick, paint] of [[width + 2.2, around], [width, colour]]) {
    pen.lineWidth = thick;
    pen.strokeStyle = paint;
    pen.stroke();
  }
}

// A search: the line joins what was the best so far, where that is not far off the slice. `where` gives a row's place, or null where it is not drawn. On a
// plane a mark's fill is its loss; on a line its height is.
function drawRun(pen, run, where) {
  const around = up ? "#ffffff" : ink("ground");
  const fill = (row) => (up ? shade(level(run.loss[row])) : run.colour);
  const hidden = new Set(run.hidden);
  const places = run.u.map((_, row) => (hidden.has(row) ? null : where(run, row)));
  const far = new Set(run.far);
  pen.beginPath();
  let joined = false; // with what was the best before
  for (const row of run.path.filter((row) => places[row])) {
    if (!far.has(row)) pen[joined ? "lineTo" : "moveTo"](...places[row]);
    joined = !far.has(row);
  }
  doubled(pen, run.colour, 1.5, around);
  places.forEach((at, row) => {
    if (!at) return;
    if (run.loss[row] === null) cross(pen, at);
    else mark(pen, at, run.radius[row], fill(row), run.colour, around);
  });
  const best = run.path[run.path.length - 1];
  if (best !== undefined && places[best]) star(pen, places[best], 9, fill(best), run.colour, around);
}
