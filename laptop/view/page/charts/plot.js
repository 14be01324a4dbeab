// A chart of lines, one for each robot: drawn by uPlot (vendor/), with names and values at the lines' ends. Of many robots
// there are bands: half of them, nearly all, extremes.

import { column, largest, short } from "../numbers.js";
import { FONT, sizeOf, theme } from "../theme.js";

const MANY = 30; // robots from which on there are bands
const STEPS = 160; // of the bands
const LABEL = 13; // px from one name to the next
const BANDS = 108; // px for names and values of bands
const RIGHT = [84, 180]; // px for names and values, at least and at most
const SHARE = 0.3; // of the chart at most for names and values
const VALUE = 52; // px for a value, and from a line's end to its name
// uPlot goes along an axis by adding steps. It never arrives where a step is too small to change the number, or too small
// for the way.
const LEAST = 1e-12; // the least width of an axis, as a share of its largest number
const MOST = 1e30; // the largest number on an axis
const EXPAND = 2; // of uPlot: a gap goes on at the times of other lines
const sync = uPlot.sync("swarm");

export class Plot {
  constructor(element) {
    this.element = element;
    this.plot = null;
    this.shape = "";
  }

  // `lines`: [{name, colour, points: [[x, y], ...], dash, strong}]; a y of null is a gap. `scale`: {unit, factor} of what is written. `at`: what is shown now, on the x axis. `log`: a logarithmic y axis. `top`: the largest y of a linear axis; what is above it leaves the chart.
  draw({ lines, scale, log = false, over = "t", at = null, selected = null, from = null, stepped = false, top = null }) {
    const [width, height] = sizeOf(this.element);
    if (!lines.length || width < 60 || height < 60) return;
    [this.at, this.selected, this.factor, this.log] = [at, selected, scale.factor, log];
    this.top = top === null ? Infinity : top * scale.factor;
    const own = lines.filter((each) => !each.dash);
    const drawn = own.length > MANY ? [...bands(own), ...own.filter((each) => each.name === selected), ...lines.filter((each) => each.dash)] : lines;
    this.lines = drawn;
    const data = uPlot.join(drawn.map(({ points }) => columns(points, scale.factor, log)), drawn.map(() => [0, EXPAND]));
    const shape = JSON.stringify([drawn.map((line) => [line.name, line.dash, few(line)]), log, over, theme.version, selected, scale.unit, stepped, SHARE * width < RIGHT[1] && width]);
    this.range = from;
    if (this.plot && shape === this.shape) {
      if (this.plot.width !== width || this.plot.height !== height) this.plot.setSize({ width, height });
      this.plot.setData(data);
      return;
    }
    this.plot?.destroy();
    this.shape = shape;
    const muted = theme.colour("--muted"), hair = theme.colour("--grid"), font = `11px ${FONT}`;
    const axis = { stroke: muted, font, grid: { stroke: hair, width: 1 }, ticks: { show: false }, gap: 4 };
    const pen = document.createElement("canvas").getContext("2d");
    pen.font = `600 11px ${FONT}`;
    const names = Math.ceil(largest(own.map(({ name }) => pen.measureText(name).width)));
    this.right = own.length > MANY ? BANDS : Math.max(RIGHT[0], Math.min(RIGHT[1], SHARE * width, names + VALUE));
    const xs = (_, low, high) => this.range ?? counted(low, high);
    this.plot = new uPlot({
      width, height,
      padding: [8, this.right, 0, 0],
      legend: { show: false },
      cursor: { sync: { key: sync.key, scales: ["x", null], filters: { pub: () => true, sub: () => over === "t" } }, y: false, points: { size: 5 }, drag: { x: false } },
      scales: { x: { time: false, range: xs }, y: log ? { distr: 3, range: (_, low, high) => decades(low, high) } : { range: (_, low, high) => room(low, high === null ? high : Math.min(high, Math.max(low, this.top))) } },
      axes: [
        { ...axis, size: 22, values: (_, ticks) => ticks.map((each, index) => `${+each.toPrecision(6)}${over === "t" && index === ticks.length - 1 ? " s" : ""}`) },
        { ...axis, size: 44, space: 34, values: (_, ticks) => ticks.map((each) => (each === null ? "" : log ? short(each) : String(+each.toPrecision(4)))) },
      ],
      series: [{}, ...drawn.map((line) => ({ label: line.name, stroke: stroke(line, selected), width: line.name === selected || line.strong ? 2.4 : 1.5, dash: line.dash ? [5, 4] : undefined, paths: stepped ? uPlot.paths.stepped({ align: 1 }) : undefined, points: { show: few(line) } }))],
      hooks: { draw: [(plot) => this.ends(plot)] },
    }, data, this.element);
  }

  // What stands at the ends of lines, and what is shown now.
  ends(plot) {
    const c = plot.ctx, ratio = devicePixelRatio || 1, { left, top, width, height } = plot.bbox;
    const found = this.lines.flatMap(({ name, colour, points, dash, hidden }) => {
      const last = points.findLast(([x, y]) => Number.isFinite(y) && (this.at === null || x <= this.at)) ?? points.at(-1);
      if (!last || hidden || dash) return [];
      const y = plot.valToPos(last[1] * this.factor, "y", true), x = Math.min(left + width, plot.valToPos(last[0], "x", true));
      return Number.isFinite(y) ? [{ name, colour, value: last[1] * this.factor, x, y: Math.max(top, Math.min(top + height, y)) }] : [];
    });
    c.save();
    c.setLineDash([]); // of a line
    if (this.at !== null) {
      const x = plot.valToPos(this.at, "x", true);
      if (x >= left && x <= left + width + 1) {
        c.fillStyle = theme.colour("--text");
        c.fillRect(x - ratio / 2, top, ratio, height);
      }
    }
    c.textBaseline = "middle";
    c.textAlign = "left";
    const text = this.log ? short : column(found.map(({ value }) => value));
    const step = LABEL * ratio, room = Math.max(1, Math.floor(height / step));
    const shown = spread(found.length > room ? found.filter((each) => each.name === this.selected) : found, step, top, top + height);
    for (const { name, colour, value, x, y, at } of shown) {
      const end = left + width;
      c.strokeStyle = c.fillStyle = colour;
      c.lineWidth = ratio;
      c.beginPath();
      if (end - x > 14 * ratio) c.arc(x, y, 2.5 * ratio, 0, 7); // elsewhere than at the line's end
      c.fill();
      c.beginPath();
      c.moveTo(end - x > 14 * ratio ? end + 6 * ratio : x + 2 * ratio, end - x > 14 * ratio ? at : y);
      c.lineTo(end + 10 * ratio, at);
      c.stroke();
      c.fillStyle = theme.colour("--text");
      c.font = `600 ${11 * ratio}px ${FONT}`;
      const called = shortened(c, name, (this.right - VALUE) * ratio);
      c.fillText(called, end + 13 * ratio, at);
      const wide = c.measureText(`${called} `).width;
      c.font = `${11 * ratio}px ${FONT}`;
      c.fillStyle = theme.colour("--muted");
      c.fillText(text(value), end + 13 * ratio + wide, at);
    }
    c.restore();
  }
}

// A name without its beginning where there is no room for all of it: names of one swarm differ at their ends.
function shortened(c, name, room) {
  if (c.measureText(name).width <= room) return name;
  let from = 1;
  while (from < name.length - 1 && c.measureText(`…${name.slice(from)}`).width > room) from += 1;
  return `…${name.slice(from)}`;
}

// Whether a line has so few points that they are marked.
const few = ({ points }) => points.length < 3;

function stroke({ colour, dash, hidden, name }, selected) {
  return selected && selected !== name && !dash && !hidden ? `${colour}80` : colour;
}

// Zero is in sight where it is near.
function room(low, high) {
  if (low === null) return [0, 1];
  [low, high] = [low, high].map(bounded);
  const size = Math.max(Math.abs(low), Math.abs(high)), width = high - low > LEAST * size ? high - low : size || 1;
  const pad = 0.06 * width, zero = low >= 0 && low < 0.5 * high;
  return [zero ? 0 : low - pad, high + pad];
}

// Iterations from the first to the last.
function counted(low, high) {
  [low, high] = [low, high].map(bounded);
  return [low, Math.max(high, low + Math.max(1, LEAST * Math.abs(low)))];
}

function decades(low, high) {
  if (!(low > 0)) return [1e-3, 1];
  const [from, to] = [low, high].map((each) => Math.log10(Math.max(1 / MOST, bounded(each))));
  return [10 ** Math.floor(from), 10 ** Math.ceil(to + 1e-9)];
}

const bounded = (value) => Math.max(-MOST, Math.min(MOST, value));

// x and y of a line; x goes up (an iteration that is told twice counts once, a run that begins anew hides the one before).
function columns(points, factor, log) {
  const kept = [];
  for (const point of points) {
    while (kept.length && kept.at(-1)[0] >= point[0]) kept.pop();
    if (!log || point[1] > 0 || point[1] === null) kept.push(point);
  }
  return [kept.map(([x]) => x), kept.map(([, y]) => (y === null ? null : y * factor))];
}

// Names, none on another one: moved as little as can be.
function spread(labels, step, top, bottom) {
  const sorted = labels.sort((a, b) => a.y - b.y);
  sorted.forEach((each, index) => (each.at = Math.max(each.y, index ? sorted[index - 1].at + step : top + step / 2)));
  let floor = bottom - step / 2;
  for (const each of sorted.toReversed()) {
    each.at = Math.min(each.at, floor);
    floor = each.at - step;
  }
  return sorted;
}

// Of many lines: what half of them do, what 10 to 90 of 100 do, and the outermost.
function bands(lines) {
  let [low, high] = [Infinity, -Infinity];
  for (const { points } of lines) [low, high] = [Math.min(low, points[0]?.[0] ?? low), Math.max(high, points.at(-1)?.[0] ?? high)];
  const names = [["most", 1], ["90 %", 0.9], ["median", 0.5], ["10 %", 0.1], ["least", 0]];
  const found = names.map(([name], index) => ({ name, colour: theme.colour(index === 2 ? "--text" : "--edge"), points: [], strong: index === 2, hidden: index % 4 === 0 }));
  const next = lines.map(() => 0);
  for (let step = 0; step <= STEPS; step += 1) {
    const x = low + ((high - low) * step) / STEPS, values = [];
    lines.forEach(({ points }, index) => {
      while (next[index] < points.length && points[next[index]][0] <= x) next[index] += 1;
      if (next[index] && points[next[index] - 1][1] !== null) values.push(points[next[index] - 1][1]);
    });
    values.sort((a, b) => a - b);
    if (values.length) names.forEach(([, share], index) => found[index].points.push([x, values[Math.round(share * (values.length - 1))]]));
  }
  return found;
}
