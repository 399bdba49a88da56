// What a visitor takes along: the view as a picture, a line as a table, and a link to what is seen here.
"use strict";

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000); // a browser may read it later
}
const named = (what) => `${document.body.dataset.id}-${what}`;

for (const button of document.querySelectorAll("[data-png]")) {
  const source = document.getElementById(button.dataset.png);
  button.addEventListener("click", () => source.toBlob((blob) => save(named(button.dataset.png + ".png"), blob)));
}
document.getElementById("profile-table")?.addEventListener("click", () => {
  save(named("line.csv"), new Blob([profileTable()], { type: "text/csv" }));
});

// A link carries what is not as it was at first: the node, the layers, the scale, the window, the line and the camera.
const digits = (value) => Number(value.toPrecision(5));
const pair = (index) => at(index).reverse().join(","); // row, column
const nodeOf = ([row, column]) => clamp(row, 0, rows - 1) * columns + clamp(column, 0, columns - 1);
const switches = [...document.querySelectorAll("#switches input")];
const layersNow = () => switches.filter((input) => input.checked).map((input) => input.name).join("|");
const layersFirst = layersNow();

function linkHere() {
  const said = new URLSearchParams({ node: pair(node) });
  if (layersNow() !== layersFirst) said.set("layers", layersNow());
  if (scaleName !== SLICE.scale) said.set("scale", scaleName);
  if (view.zoom > 1) said.set("window", [view.zoom, view.right, view.up].map(digits).join(","));
  if (up && profile) said.set("line", profile.map(pair).join(","));
  if (up && ["turn", "tilt", "zoom"].some((name) => camera[name] !== FIRST[name])) {
    said.set("camera", [camera.turn, camera.tilt, camera.zoom].map(digits).join(","));
  }
  return "#" + said;
}

function follow() {
  const said = new URLSearchParams(location.hash.slice(1));
  const numbers = (name, count) => {
    const found = (said.get(name) ?? "").split(",").map(Number);
    return said.get(name) && found.length === count && found.every(Number.isFinite) ? found : null;
  };
  const whole = (name, count) => numbers(name, count)?.map(Math.round);
  if (said.has("layers")) {
    const layers = said.get("layers").split("|");
    for (const input of switches) {
      input.checked = layers.includes(input.name);
      input.dispatchEvent(new Event("change"));
    }
  }
  if ([...chooser.options].some((one) => one.value === said.get("scale"))) {
    chooser.value = said.get("scale");
    setScale(chooser.value);
  }
  const place = whole("node", 2);
  if (place) go(nodeOf(place));
  if (numbers("window", 3)) setView(...numbers("window", 3));
  else if (place) reveal(shareOf(node));
  const line = whole("line", 4);
  if (up && line) setProfile(nodeOf(line.slice(0, 2)), nodeOf(line.slice(2)));
  if (up && numbers("camera", 3)) setCamera(...numbers("camera", 3));
}

document.getElementById("link")?.addEventListener("click", async () => {
  const field = document.getElementById("permalink");
  history.replaceState(null, "", linkHere());
  field.value = location.href;
  field.hidden = false;
  field.select();
  const copied = await copy(field.value);
  say(copied ? "Link copied." : "Link selected.", 0);
});
addEventListener("hashchange", () => {
  if (!location.hash.includes("=")) return;
  follow();
  canvas.scrollIntoView({ block: "nearest" });
  canvas.focus({ preventScroll: true });
});
if (location.hash.includes("=")) follow();
