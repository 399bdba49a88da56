// The explorer: what moves the plane, finer pictures of it as they come, episodes and descents from its nodes.
"use strict";

{ // names of its own
  const token = new URLSearchParams(location.search).get("token");
  const place_ = { dims: [...SPACE.dims], at: [...SPACE.at] }; // which parameters vary, and the point in the unit cube
  const progress = document.getElementById("progress");
  let mapped = null; // the place whose map is shown
  const placeSaid = ({ dims, at }) => JSON.stringify([dims, at]);
  const isMapped = () => mapped === placeSaid(place_);
  let look = 0; // counts the places somebody looked at, so that answers about earlier ones are dropped

  async function ask(question, asked = {}) {
    const answer = await fetch("/" + question, {
      method: "POST",
      headers: { Authorization: "Bearer " + token, "Content-Type": "application/json" },
      body: JSON.stringify(asked),
    });
    const found = await answer.json();
    if (!answer.ok) throw new Error(found.error);
    return found;
  }

  // Sliders: one for each parameter, in shares of its range.
  const valueThere = ({ low, high, logarithmic }, share) =>
    logarithmic ? low * (high / low) ** share : low + share * (high - low);
  const sliders = SPACE.parameters.map((parameter, place) => {
    const [row, label, slider, value] = ["li", "label", "input", "output"].map((name) => document.createElement(name));
    Object.assign(slider, { type: "range", min: 0, max: 1, step: "any", id: `slider-${place}` });
    label.textContent = parameter.name;
    label.htmlFor = slider.id;
    slider.addEventListener("input", () => move(place_.at.with(place, Number(slider.value))));
    row.append(label, slider, value);
    document.getElementById("sliders").append(row);
    return { slider, value };
  });
  function showPoint() {
    sliders.forEach(({ slider, value }, place) => {
      const [parameter, share] = [SPACE.parameters[place], place_.at[place]];
      slider.value = share;
      slider.disabled = place_.dims.includes(place);
      const said = slider.disabled ? "varies" : number(valueThere(parameter, share)) + (parameter.unit ? " " + parameter.unit : "");
      value.textContent = said;
      slider.setAttribute("aria-valuetext", said);
    });
    choosers.forEach((one, rank) => (one.value = place_.dims[rank]));
  }

  // The two that vary: choosing one that the other has swaps them.
  const choosers = ["across", "up"].map((id) => document.getElementById(id));
  choosers.forEach((one, rank) => {
    one.addEventListener("change", () => {
      const chosen = [...place_.dims];
      if (chosen[1 - rank] === Number(one.value)) chosen[1 - rank] = chosen[rank];
      chosen[rank] = Number(one.value);
      move(place_.at, chosen);
    });
  });

  // Where a node is in the unit cube: a plane covers the whole range of both parameters.
  function shares(index) {
    const [column, row] = at(index);
    const found = [...place_.at];
    found[place_.dims[0]] = column / (columns - 1);
    found[place_.dims[1]] = row / (rows - 1);
    return found;
  }

  // At most one question about where to look is under way; the last place is asked for next.
  let asking = false;
  function move(to, chosen = place_.dims) {
    Object.assign(place_, { at: to, dims: chosen });
    look += 1;
    showPoint();
    if (!asking) turn();
  }
  async function turn() {
    asking = true;
    for (let asked = 0; asked !== look; ) {
      asked = look;
      await ask("look", place_).catch(failed);
    }
    asking = false;
  }
  const early = new Error("The plane that you chose is not on the map yet.");
  const failed = (error) => (progress.textContent = error.message);
  document.getElementById("here").addEventListener("click", () => (isMapped() ? move(shares(node)) : failed(early)));
  document.getElementById("centre").addEventListener("click", () => move(place_.at.map(() => 0.5)));
  document.getElementById("random").addEventListener("click", () => move(place_.at.map(() => Math.random())));

  // Finer pictures, and how far they are.
  async function watch() {
    for (let known = -1, before = null; ; ) {
      let seen;
      try {
        seen = await ask("seen", { number: known });
      } catch {
        progress.textContent = "The explorer has stopped. Start it again with its command.";
        return;
      }
      if (seen.slice && seen.number !== known) {
        const { dims, at } = seen.look;
        const there = placeSaid({ dims, at: at.map((share, place) => (dims.includes(place) ? null : share)) });
        const runs = there === before ? SLICE.runs : [];
        before = there;
        load({ ...seen.slice, runs, episodes: [] });
        mapped = placeSaid(seen.look);
      }
      known = seen.number;
      if (seen.error) progress.textContent = seen.error;
      else if (seen.complete) progress.textContent = `${columns} × ${rows} samples`;
      else progress.textContent = `${seen.done} of ${seen.total} samples`;
    }
  }

  // A click: the episode at the node, and a descent from there.
  const descents = document.getElementById("descents");
  const wanted = (id) => document.getElementById(id)?.checked;
  async function visit() {
    if (!isMapped()) return failed(early);
    const [asked, index, from] = [look, node, shares(node)];
    const same = () => asked === look;
    const note = (text) => same() && (document.getElementById("spoken").textContent = text);
    if (wanted("descends")) {
      try {
        const found = await ask("descend", { at: from, everywhere: wanted("everywhere") });
        if (same()) drawDescent(found);
      } catch (error) {
        note(error.message);
      }
    }
    if (!wanted("films") || !same()) return;
    try {
      const film = await ask("film", { at: from });
      if (!same() || !film.mp4) return note(film.said);
      const [column, row] = at(index);
      SLICE.episodes = [{ ...film, row, column, why: "episode at this node" }];
      if (node !== index) return redraw();
      showEpisode();
      redraw();
    } catch (error) {
      note(error.message);
    }
  }
  function drawDescent({ run, end, best }) {
    SLICE.runs.push(run);
    shown.add(run.label);
    const row = document.createElement("li");
    row.textContent = `${run.label[0].toUpperCase()}${run.label.slice(1)}: ${run.episodes} points, lowest loss ${lossSaid(best, "NONFINITE")} `;
    if (end) {
      const there = document.createElement("button");
      Object.assign(there, { type: "button", textContent: "Move the point there" });
      there.addEventListener("click", () => move(end));
      row.append(there);
    }
    descents.append(row);
    document.dispatchEvent(new Event("shown"));
  }
  canvas.addEventListener("click", () => !gesture.dragged && visit());
  canvas.addEventListener("keydown", (event) => event.key === "Enter" && visit());

  document.getElementById("keep").addEventListener("click", async (event) => {
    const [said, command] = [document.getElementById("kept"), document.getElementById("kept-command")];
    event.target.disabled = true;
    said.textContent = "Sampling the plane and drawing its picture.";
    try {
      const kept = await ask("keep");
      said.textContent = `${kept.folder}: ${kept.files.join(", ")}`;
      command.textContent = kept.command;
      command.hidden = false;
    } catch (error) {
      said.textContent = error.message;
    }
    event.target.disabled = false;
  });

  showPoint();
  watch();
}
