// Walking over the map: a node at a time under the pointer or the keys, what is said of it, and its episode.
"use strict";

const readout = document.getElementById("readout");
const player = document.getElementById("player");
const still = matchMedia("(prefers-reduced-motion: reduce)");
const REACH = 14; // pixels from which a click finds a ring
const SAID = { MISSING: "not sampled yet", NONFINITE: "not finite", ESCAPED: "outside the domain", ERROR: "error", INTERPOLATED: "interpolated" };
const lossSaid = (loss, status) => (loss === null || loss !== loss ? SAID[status] : number(loss) + (SLICE.unit ? " " + SLICE.unit : ""));

function episodeAt(index) {
  const [column, row] = at(index);
  return SLICE.episodes.find((one) => one.row === row && one.column === column);
}

function tell() {
  const [column, row] = at(node);
  const lines = [across, up].filter(Boolean).map((axis, rank) => {
    return axis.label + ": " + valueSaid(axis, axis.values[rank ? row : column]);
  });
  lines.push("Loss: " + lossSaid(losses[node], statusOf(node)));
  if (slopes && slopes[0][node] === slopes[0][node]) {
    lines.push("Gradient along the slice: " + slopes.map((part) => number(part[node])).join(", "));
    lines.push("Gradient norm over all parameters: " + number(gradients[node]));
  }
  if (floors && floors[node] === floors[node]) lines.push("Numerical floor: " + lossSaid(floors[node], ""));
  if (node === lowest && losses[node] === losses[node]) lines.push("Lowest loss of the slice");
  const episode = episodeAt(node);
  if (episode) lines.push("Episode here: " + episode.why);
  readout.textContent = lines.join("\n");
}

function go(to) {
  if (to === node) return;
  node = to;
  redraw();
  tell();
  document.dispatchEvent(new Event("walked"));
}

function nearest([right, upwards]) {
  const cell = (place, count) => clamp(up ? Math.floor(place * count) : Math.round(place * (count - 1)), 0, count - 1);
  const row = up ? cell(view.up + upwards / view.zoom, rows) : 0;
  return row * columns + cell(view.right + right / view.zoom, columns);
}

// Where a node is, in shares of the slice.
const shareOf = (index) => [share(across.values[at(index)[0]], across), up ? share(up.values[at(index)[1]], up) : 0];
const inWindow = (index) => shareOf(index).map((part, rank) => (part - (rank ? view.up : view.right)) * view.zoom);

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

function nextEpisode(step) {
  const places = SLICE.episodes.map((one) => one.row * columns + one.column);
  const next = places.indexOf(node) < 0 ? (step > 0 ? 0 : -1) : places.indexOf(node) + step;
  go(places[(next + places.length) % places.length]);
}

function step([right, upwards], far) {
  const [column, row] = at(node);
  const size = far ? 5 : 1;
  go(clamp(row + upwards * size, 0, rows - 1) * columns + clamp(column + right * size, 0, columns - 1));
}

const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] };
const zoomHere = (factor) => zoomAt(factor, inWindow(node).map((part) => clamp(part, 0, 1)));
const KEYS = {
  Enter: showEpisode,
  " ": showEpisode,
  "+": () => zoomHere(1.5),
  "=": () => zoomHere(1.5),
  "-": () => zoomHere(1 / 1.5),
  0: () => setView(1, 0, 0),
  p: () => up && pinProfile(),
  Escape: () => up && dropProfile(),
};
const WALKS = { Home: () => go(lowest) };
if (SLICE.episodes.length) Object.assign(WALKS, { PageDown: () => nextEpisode(1), PageUp: () => nextEpisode(-1) });
canvas.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return; // the browser's own
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (key in MOVES) step(MOVES[key], event.shiftKey);
  else if (key in WALKS) WALKS[key]();
  else if (key in KEYS) KEYS[key]();
  else return;
  event.preventDefault();
  if (!(key in MOVES || key in WALKS)) return;
  reveal(shareOf(node));
  say(readout.textContent.replaceAll("\n", ". "));
});

const gesture = steer(canvas, placeOf, () => up && profiling(), (from, to) => setProfile(nearest(from), nearest(to)));
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons) go(nearest(placeOf(event)));
});
canvas.addEventListener("click", (event) => {
  if (gesture.dragged) return;
  const found = ringed(pointed(canvas, event));
  go(found ? found[1] : nearest(placeOf(event)));
  showEpisode();
});

const BUTTONS = { closer: () => zoomHere(1.5), farther: () => zoomHere(1 / 1.5), whole: () => setView(1, 0, 0) };
for (const [id, press] of Object.entries(BUTTONS)) document.getElementById(id).addEventListener("click", press);
document.addEventListener("viewed", () => canvas.classList.toggle("zoomed", view.zoom > 1));

const chooser = document.getElementById("scale");
function offerScales() {
  const names = { linear: "linear", logarithmic: "logarithmic", rank: "by rank" };
  const offered = [...Object.keys(SLICE.scales), ...(up ? [RANK] : [])];
  chooser.replaceChildren(...offered.map((name) => new Option(names[name], name, name === SLICE.scale, name === SLICE.scale)));
  chooser.value = scaleName; // a browser keeps what was chosen when it comes back
}
offerScales();
chooser.addEventListener("change", () => setScale(chooser.value));

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
for (const fields of document.querySelectorAll("fieldset[disabled]")) fields.removeAttribute("disabled");
document.dispatchEvent(new Event("shown"));
tell();
document.addEventListener("loaded", () => {
  offerScales();
  tell();
});
