// The losses along a line over the map: those of the nodes nearest to it, drawn as they are, with a gap where one failed.
"use strict";

const chart = document.getElementById("profile");
const EDGE = { left: 62, right: 14, top: 34, bottom: 46 };
let profile = null; // nodes from and to
let pinned = null; // where a line begins that the keys are drawing

const drawer = document.getElementById("draw-profile");
const profiling = () => drawer.getAttribute("aria-pressed") === "true";

// The nodes along a line: as many as it has steps along the axis on which it has more.
function nodesAlong([from, to]) {
  const [[fromColumn, fromRow], [toColumn, toRow]] = [at(from), at(to)];
  const count = Math.max(Math.abs(toColumn - fromColumn), Math.abs(toRow - fromRow));
  return Array.from({ length: count + 1 }, (_, k) => {
    const part = count ? k / count : 0;
    return Math.round(fromRow + part * (toRow - fromRow)) * columns + Math.round(fromColumn + part * (toColumn - fromColumn));
  });
}

function setProfile(from, to) {
  profile = from === to ? null : [from, to];
  document.getElementById("profile-panel").hidden = !profile;
  redraw();
  rechart();
  if (profile) sayProfile();
  document.dispatchEvent(new Event("walked"));
}

function dropProfile() {
  pinned = null;
  setProfile(node, node);
}

// The first P holds one end at the node, the second the other.
function pinProfile() {
  if (pinned === null) {
    pinned = node;
    say("The line starts here. Go to its other end and press P again.", 0);
  } else {
    const from = pinned;
    pinned = null;
    setProfile(from, node);
  }
  redraw();
}

function sayProfile() {
  const along = nodesAlong(profile).map((index) => losses[index]);
  const known = along.filter((loss) => loss === loss);
  const failed = along.length - known.length;
  const range = known.length ? `${number(Math.min(...known))} to ${number(Math.max(...known))}${SLICE.unit ? " " + SLICE.unit : ""}` : "none";
  const place = (index) => `${valueSaid(across, across.values[at(index)[0]])}, ${valueSaid(up, up.values[at(index)[1]])}`;
  const text = `Line from ${place(profile[0])} to ${place(profile[1])}: ${along.length} nodes, losses ${range}${failed ? `, ${failed} without a loss` : ""}.`;
  document.getElementById("profile-said").textContent = text;
  chart.setAttribute("aria-label", "Loss along the line drawn over the map. " + text);
  say(text);
}

// On the map: the line that is there, and the one that the keys are drawing.
function drawProfileLine() {
  for (const [from, to] of [profile, pinned === null ? null : [pinned, node]].filter(Boolean)) {
    pen.save();
    pen.beginPath();
    pen.rect(PAD.left, PAD.top, box.width, box.height);
    pen.clip();
    pen.beginPath();
    pen.moveTo(...spot(from));
    pen.lineTo(...spot(to));
    doubled(pen, "#ffffff", 2, "#1a1a1a");
    pen.beginPath();
    pen.arc(...spot(from), 3.5, 0, 2 * Math.PI);
    doubled(pen, "#ffffff", 2, "#1a1a1a");
    pen.restore();
  }
}

// Ticks of an axis that a line goes along, by shares of the line; the other axis, if it goes along that too, is above.
function drawLineAxes(brush, width, height) {
  const [from, to] = profile.map(at);
  const long = width - EDGE.left - EDGE.right;
  const moves = [across, up].map((axis, rank) => [axis, axis.values[from[rank]], axis.values[to[rank]]]).filter(([, begin, end]) => begin !== end);
  brush.textAlign = "center";
  moves.forEach(([axis, begin, end], place) => {
    const [side, down] = place ? [EDGE.top, -1] : [height - EDGE.bottom, 1];
    let last = -Infinity;
    for (const value of roundPlaces(axis, Math.min(begin, end), Math.max(begin, end)).sort((one, other) => (one - other) * Math.sign(end - begin))) {
      const right = EDGE.left + ((value - begin) / (end - begin)) * long;
      const wide = brush.measureText(valueSaid(axis, value)).width / 2 + 5;
      if (right - wide < last) continue;
      last = right + wide;
      brush.beginPath();
      brush.moveTo(right, side);
      brush.lineTo(right, side + 4 * down);
      brush.stroke();
      brush.fillText(valueSaid(axis, value), right, side + (down > 0 ? 17 : -7));
    }
    brush.fillText(axis.label, EDGE.left + long / 2, side + (down > 0 ? 36 : -21));
  });
}

function drawLosses(brush, width, height) {
  const along = nodesAlong(profile);
  const [long, tall] = [width - EDGE.left - EDGE.right, height - EDGE.top - EDGE.bottom];
  const right = (k) => EDGE.left + (k / (along.length - 1)) * long;
  const down = (share) => EDGE.top + tall * (1 - clamp(share, 0, 1));
  const half = long / (along.length - 1) / 2;
  along.forEach((index, k) => {
    if (losses[index] === losses[index]) return;
    const kind = statusOf(index);
    brush.fillStyle = STRIPES[kind] ? (hatches[kind] ||= striped(STRIPES[kind])) : "#ececec";
    brush.fillRect(Math.max(EDGE.left, right(k) - half), EDGE.top, Math.min(2 * half, EDGE.left + long - right(k) + half), tall);
  });
  brush.beginPath();
  along.forEach((index, k) => {
    const [one, before] = [losses[index], k ? losses[along[k - 1]] : NaN];
    if (one !== one) return;
    if (before === before) brush.lineTo(right(k), down(level(one)));
    else brush.moveTo(right(k), down(level(one)));
  });
  brush.strokeStyle = ink("curve");
  brush.lineWidth = 1.5;
  brush.stroke();
  if (along.length > 100) return;
  brush.fillStyle = ink("curve");
  along.forEach((index, k) => {
    if (losses[index] !== losses[index]) return;
    brush.beginPath();
    brush.arc(right(k), down(level(losses[index])), 2.4, 0, 2 * Math.PI);
    brush.fill();
  });
}
const hatches = {};

const rechart = fit(chart, (brush, width, height) => {
  brush.fillStyle = ink("ground");
  brush.fillRect(0, 0, width, height);
  if (!profile) return;
  drawLosses(brush, width, height);
  brush.font = "12px system-ui, sans-serif";
  brush.fillStyle = ink("ink");
  brush.strokeStyle = ink("quiet");
  brush.lineWidth = 1;
  const tall = height - EDGE.top - EDGE.bottom;
  brush.strokeRect(EDGE.left, EDGE.top, width - EDGE.left - EDGE.right, tall);
  drawLineAxes(brush, width, height);
  let last = Infinity;
  scale.ticks.forEach((value, place) => {
    const share = scaleName === RANK ? place / (scale.ticks.length - 1) : level(value);
    const high = EDGE.top + tall * (1 - share);
    if (last - high < 14) return;
    last = high;
    brush.textAlign = "right";
    brush.beginPath();
    brush.moveTo(EDGE.left - 4, high);
    brush.lineTo(EDGE.left, high);
    brush.stroke();
    brush.fillText(number(value), EDGE.left - 7, high + 4);
  });
  brush.save();
  brush.translate(15, EDGE.top + tall / 2);
  brush.rotate(-Math.PI / 2);
  brush.textAlign = "center";
  brush.fillText(lossLabel, 0, 0);
  brush.restore();
});

document.addEventListener("loaded", () => {
  if (profile) sayProfile();
  rechart();
});
drawer.addEventListener("click", () => {
  drawer.setAttribute("aria-pressed", String(!profiling()));
  canvas.classList.toggle("drawing", profiling());
});
document.getElementById("profile-across").addEventListener("click", () => {
  const [, row] = at(node);
  setProfile(row * columns, row * columns + columns - 1);
});
document.getElementById("profile-up").addEventListener("click", () => {
  const [column] = at(node);
  setProfile(column, (rows - 1) * columns + column);
});
document.getElementById("profile-drop").addEventListener("click", dropProfile);

function profileTable() {
  const plain = (text) => (/^[=+\-@\t\r\n]/.test(text) ? "'" : "") + text; // no formula to a spreadsheet
  const quoted = (text) => `"${plain(text).replaceAll('"', '""')}"`;
  const head = [across.label, up.label, lossLabel, "status"].map(quoted).join(",");
  const row = (index) => [valueOf(across, across.values[at(index)[0]]), valueOf(up, up.values[at(index)[1]]), losses[index] === losses[index] ? losses[index] : "", statusOf(index)].join(",");
  return [head, ...nodesAlong(profile).map(row), ""].join("\n");
}
