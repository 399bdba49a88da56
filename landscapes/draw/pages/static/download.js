// What a page holds is also to be had as files: the samples as CSV, and what was measured as JSON.
"use strict";

const quotedCell = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

function samplesTable() {
  const axes = [across, up].filter(Boolean);
  const names = [...axes.map((axis) => axis.label), lossLabel, "status"];
  if (slopes) names.push(...axes.map((axis) => "slope along " + axis.label), "length of the gradient in all dimensions");
  if (floors) names.push("numerical floor");
  const lines = [names.map(quotedCell).join(",")];
  const cell = (value) => (Number.isFinite(value) ? String(value) : "");
  for (let index = 0; index < losses.length; index++) {
    const [column, row] = at(index);
    const row_ = axes.map((axis, rank) => cell(valueOf(axis, axis.values[rank ? row : column])));
    row_.push(cell(losses[index]), statusOf(index).toLowerCase());
    if (slopes) row_.push(...slopes.map((part) => cell(part[index])), cell(gradients[index]));
    if (floors) row_.push(cell(floors[index]));
    lines.push(row_.join(","));
  }
  return lines.join("\n") + "\n";
}

const FILES = {
  "samples.csv": () => new Blob([samplesTable()], { type: "text/csv" }),
  "report.json": () => new Blob([document.getElementById("record").textContent], { type: "application/json" }),
};
for (const button of document.querySelectorAll("[data-file]")) {
  const name = button.dataset.file;
  button.addEventListener("click", () => save(named(name), FILES[name]()));
}
