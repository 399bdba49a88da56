// The axes of the map and its colour bar.
"use strict";

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

// Round values of an axis within the window, which reaches half a cell beyond the nodes.
function ticksOf(axis, begin) {
  if (view.zoom === 1) return axis.ticks;
  const [low, high] = [begin, begin + 1 / view.zoom].map((place) => valueAt(place, axis));
  return roundPlaces(axis, Math.min(low, high), Math.max(low, high));
}

function drawAxes() {
  const bottom = PAD.top + box.height;
  pen.fillStyle = ink("ink");
  pen.strokeStyle = ink("quiet");
  pen.lineWidth = 1;
  pen.strokeRect(PAD.left, PAD.top, box.width, box.height);
  pen.font = "12px system-ui, sans-serif";
  for (const value of apart(ticksOf(across, view.right), x, (one) => pen.measureText(valueSaid(across, one)).width + 10)) {
    tick(x(value), bottom, x(value), bottom + 4);
    write(valueSaid(across, value), x(value), bottom + 17, "center");
  }
  for (const value of apart(up ? ticksOf(up, view.up) : scale.ticks, y, () => 15)) {
    tick(PAD.left - 4, y(value), PAD.left, y(value));
    write(up ? valueSaid(up, value) : number(value), PAD.left - 7, y(value) + 4, "right");
  }
  pen.font = "13px system-ui, sans-serif";
  write(across.label, PAD.left + box.width / 2, bottom + 37, "center");
  upright(up ? up.label : lossLabel, 15);
  if (up) drawBar(PAD.left + box.width + BAR.gap, bottom);
}

// The colour bar; iso-lines that are shown cross it. By rank it is even in the number of nodes, not in their loss.
function drawBar(left, bottom) {
  const high = (share) => bottom - share * box.height;
  for (let step = 0; step < box.height; step++) {
    pen.fillStyle = shade(1 - step / box.height);
    pen.fillRect(left, PAD.top + step, BAR.width, 1.5);
  }
  pen.strokeRect(left, PAD.top, BAR.width, box.height);
  const beyond = { min: [0], max: [1], both: [0, 1], neither: [] }[scale.extend];
  for (const end of beyond) drawEnd(left, end, high(end)); // losses go on beyond this end
  pen.fillStyle = ink("ink");
  pen.strokeStyle = ink("quiet");
  pen.font = "12px system-ui, sans-serif";
  const marks = scale.ticks.map((value, place) => [value, scaleName === RANK ? place / (scale.ticks.length - 1) : level(value)]);
  for (const [value, share] of apart(marks, ([, share]) => high(share), () => 15)) {
    tick(left + BAR.width, high(share), left + BAR.width + 4, high(share));
    write(number(value), left + BAR.width + 7, high(share) + 4, "left");
  }
  if (shown.has("isolines")) {
    pen.beginPath();
    for (const share of ISOLINES) {
      pen.moveTo(left, high(share));
      pen.lineTo(left + BAR.width, high(share));
    }
    doubled(pen, "#ffffff", 1, "#00000066");
  }
  pen.font = "13px system-ui, sans-serif";
  upright(scaleName === RANK ? lossLabel + ", by rank" : lossLabel, left + PAD.right - BAR.gap - 5);
}

function drawEnd(left, end, top) {
  pen.fillStyle = shade(end);
  pen.beginPath();
  pen.moveTo(left, top);
  pen.lineTo(left + BAR.width / 2, top + (end ? -9 : 9));
  pen.lineTo(left + BAR.width, top);
  pen.closePath();
  pen.fill();
  pen.stroke();
}
