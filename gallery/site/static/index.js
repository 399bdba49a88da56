// The filter of the front page: every word that is typed has to occur, and what is chosen has to be so. A link keeps it.
"use strict";

const field = document.getElementById("filter");
const count = document.getElementById("count");
const chosen = ["word", "dim", "engine"].map((name) => document.getElementById(name));
const sifted = [...document.querySelectorAll("[data-words]")];
const cards = sifted.filter((one) => one.classList.contains("slice"));
let counting;

function fits(one, words) {
  const text = one.dataset.words.toLowerCase();
  const [word, dim, engine] = chosen.map((choice) => choice.value);
  const said = one.dataset.said.split("|");
  return words.every((part) => text.includes(part)) && (!word || said.includes(word)) &&
    (!dim || one.dataset.dim === dim) && (!engine || one.dataset.engine === engine);
}

function sift() {
  const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const one of sifted) one.hidden = !fits(one, words);
  for (const section of document.querySelectorAll("section[data-env]")) {
    section.hidden = !section.querySelector(".card:not([hidden])");
  }
  document.querySelector(".none").hidden = Boolean(document.querySelector(".wall .card:not([hidden])"));
  clearTimeout(counting);
  const left = cards.filter((card) => !card.hidden).length;
  const asked = words.length || chosen.some((choice) => choice.value);
  if (asked) document.getElementById("every").open = true;
  counting = setTimeout(() => (count.textContent = asked ? `${left} of ${cards.length} slices` : ""), 300);
}

function keep() {
  const said = new URLSearchParams();
  for (const one of [field, ...chosen]) if (one.value) said.set(one.id, one.value);
  history.replaceState(null, "", `${said}` ? `#${said}` : location.pathname.split("/").pop() || "./");
}

function take() {
  const said = new URLSearchParams(location.hash.slice(1));
  field.value = said.get("filter") ?? "";
  for (const choice of chosen) {
    const wanted = said.get(choice.id) ?? "";
    choice.value = [...choice.options].some((one) => one.value === wanted) ? wanted : "";
  }
  sift();
}

field.closest("form").hidden = false;
field.closest("form").addEventListener("submit", (event) => event.preventDefault());
for (const one of [field, ...chosen]) {
  one.addEventListener("input", () => {
    sift();
    keep();
  });
}
document.getElementById("all").addEventListener("click", () => {
  for (const one of [field, ...chosen]) one.value = "";
  sift();
  keep();
});
addEventListener("hashchange", () => location.hash.includes("=") && take());
if (location.hash.includes("=")) take();
else sift(); // a browser keeps what was typed when it comes back
