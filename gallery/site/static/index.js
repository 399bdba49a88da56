// The filter of the index: every word of it has to occur in a card.
"use strict";

const field = document.getElementById("filter");
const count = document.getElementById("count");
const cards = [...document.querySelectorAll(".card")];
let counting;

function sift() {
  const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const card of cards) {
    const text = card.dataset.words.toLowerCase();
    card.hidden = !words.every((word) => text.includes(word));
  }
  for (const section of document.querySelectorAll("section[data-env]")) {
    section.hidden = !section.querySelector(".card:not([hidden])");
  }
  clearTimeout(counting);
  const left = cards.filter((card) => !card.hidden).length;
  counting = setTimeout(() => (count.textContent = words.length ? `${left} of ${cards.length} slices` : ""), 300);
}

field.closest("form").hidden = false;
field.closest("form").addEventListener("submit", (event) => event.preventDefault());
field.addEventListener("input", sift);
sift(); // a browser keeps what was typed when it comes back
