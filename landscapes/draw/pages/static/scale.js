// The scale of a slice's losses: linear, logarithmic, or by rank. All that goes with it is made once when it is chosen.
"use strict";

const RANK = "rank";
const MISSING = 0xffececec; // of what is not sampled yet: alpha, blue, green, red
const HEIGHT = 0.55; // of the surface, where its sides are 1
const WALLS = [0.78, 0.6]; // how light its walls across and along the first axis are; what is flat has its own colour
const ISOLINES = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]; // of the scale
const palette = Uint32Array.from(SLICE.palette, (hex) => parseInt("ff" + hex.slice(4) + hex.slice(2, 4) + hex.slice(0, 2), 16));
const levels = new Float32Array(losses.length); // of every node as it is drawn, NaN where there is none
const colours = new Uint32Array(losses.length); // transparent where it failed
const walls = WALLS.map(() => new Uint32Array(losses.length));
const rises = new Float32Array(losses.length); // of the surface
let scaleName = SLICE.scale;
let scale = SLICE.scales[scaleName];
let ordered = null; // the losses from the least to the most, for ranks alone

const shade = (share) => "#" + SLICE.palette[Math.round(255 * clamp(share, 0, 1))];

// How many of the losses are below, where equal ones share a place.
function rankOf(loss) {
  const bound = (before) => {
    let [low, high] = [0, ordered.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (before(ordered[middle])) low = middle + 1;
      else high = middle;
    }
    return low;
  };
  const [below, upTo] = [bound((one) => one < loss), bound((one) => one <= loss)];
  return ordered.length > 1 ? clamp((below + Math.max(upTo - 1, below)) / 2 / (ordered.length - 1), 0, 1) : 0.5;
}

// How far up the scale a loss is: 0 at its lower end, 1 at its upper.
function level(loss) {
  if (scaleName === RANK) return rankOf(loss);
  const { low, high, logarithmic } = scale;
  if (!logarithmic) return (loss - low) / (high - low);
  return loss > 0 ? Math.log(loss / low) / Math.log(high / low) : -1;
}

// The loss that is so far up.
function lossAt(share) {
  if (scaleName === RANK) return ordered[Math.round(share * (ordered.length - 1))];
  const { low, high, logarithmic } = scale;
  return logarithmic ? low * (high / low) ** share : low + share * (high - low);
}

function dimmed(colour, light) {
  const part = (shift) => Math.round(light * ((colour >>> shift) & 255)) << shift;
  return (0xff000000 | part(16) | part(8) | part(0)) >>> 0;
}

function setScale(name) {
  scaleName = name;
  if (name === RANK) {
    ordered ||= losses.filter((loss) => loss === loss).sort();
    const shares = ordered.length ? [0, 0.25, 0.5, 0.75, 1] : [];
    scale = { low: 0, high: 1, extend: "neither", ticks: shares.map((share) => Number(lossAt(share).toPrecision(3))) };
  } else scale = SLICE.scales[name];
  const dim = WALLS.map((light) => palette.map((colour) => dimmed(colour, light)));
  for (let node = 0; node < losses.length; node++) {
    const share = level(drawnLosses[node]);
    const there = share === share;
    const tone = there ? Math.round(255 * clamp(share, 0, 1)) : 0;
    levels[node] = share;
    colours[node] = there ? palette[tone] : drawnStatuses[node] ? 0 : MISSING;
    walls.forEach((wall, side) => (wall[node] = there ? dim[side][tone] : 0));
    rises[node] = there ? HEIGHT * clamp(share, 0, 1) : NaN;
  }
  document.dispatchEvent(new Event("scaled"));
}
setScale(scaleName);
document.addEventListener("loaded", () => {
  ordered = null;
  setScale(scaleName === RANK || scaleName in SLICE.scales ? scaleName : SLICE.scale);
});

// Where equal losses lie, between four nodes that all have one: nothing is drawn across a failure. Each part of a line
// is four numbers, from and to, in nodes. Of a cell's corners, from the lower left on and counter-clockwise, those that
// are above say which of its edges, from the lower one on, are crossed; a saddle is cut as the mean of its corners says.
const CROSSED = [
  [], [3, 0], [0, 1], [3, 1], [1, 2], [3, 0, 1, 2], [0, 2], [3, 2],
  [2, 3], [0, 2], [0, 1, 2, 3], [1, 2], [1, 3], [0, 1], [3, 0], [],
];
function crossed(above, middle) {
  if (above === 5 && middle) return CROSSED[10];
  return above === 10 && middle ? CROSSED[5] : CROSSED[above];
}

function isoline(share) {
  const found = [];
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const node = row * columns + column;
      const [a, b, c, d] = [levels[node], levels[node + 1], levels[node + columns + 1], levels[node + columns]];
      const sum = a + b + c + d;
      if (sum !== sum) continue;
      const above = (a > share) | ((b > share) << 1) | ((c > share) << 2) | ((d > share) << 3);
      for (const edge of crossed(above, sum / 4 > share)) {
        if (edge === 0) found.push(column + (share - a) / (b - a), row);
        else if (edge === 1) found.push(column + 1, row + (share - b) / (c - b));
        else if (edge === 2) found.push(column + (share - d) / (c - d), row + 1);
        else found.push(column, row + (share - a) / (d - a));
      }
    }
  }
  return Float32Array.from(found);
}
