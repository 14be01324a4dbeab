// Charts of any number of any key: one line for each robot that has it. Drawn by uPlot (vendor/). What counts iterations
// (states of apps) may be drawn over them, anything over time.

import { dig } from "./panels.js";

const WINDOW = 120; // s
const REDRAW_MS = 200;

export class Charts {
  constructor(section, store, ask) {
    this.section = section;
    this.store = store;
    this.ask = ask;
    this.charts = new Map();
    this.drawn = 0;
    this.sight = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.outside[isIntersecting ? "delete" : "add"](target);
    });
    this.outside = new Set(); // elements that the window does not show
  }

  open(topic, path) {
    const name = `${topic} ${path.join(".")}`;
    if (this.charts.has(name)) return;
    const element = document.createElement("div"), close = document.createElement("button");
    element.className = "chart";
    close.type = "button";
    close.textContent = "×";
    close.title = `close ${name}`;
    close.addEventListener("click", () => {
      this.charts.get(name).plot?.destroy();
      this.charts.delete(name);
      this.sight.unobserve(element);
      this.outside.delete(element);
      element.remove();
    });
    const over = document.createElement("button");
    over.type = "button";
    over.hidden = true;
    over.addEventListener("click", () => {
      chart.over = chart.over === "k" ? "t" : "k";
      chart.lines = [];
      this.drawn = -Infinity;
    });
    element.append(over, close);
    this.section.append(element);
    this.sight.observe(element);
    const chart = { topic, path, name, element, button: over, over: topic.startsWith("app/") ? "k" : "t", points: new Map(), plot: null, lines: [], stale: true };
    this.charts.set(name, chart);
    for (const robot of this.store.names) this.ask({ history: { robot, topic } });
  }

  // What a key held before the chart was opened.
  history({ robot, topic, rows }) {
    for (const chart of this.charts.values()) {
      if (chart.topic !== topic) continue;
      const before = rows.map(([t, value]) => [t, dig(value, chart.path), value?.k]).filter(([, y]) => typeof y === "number");
      const now = chart.points.get(robot) ?? [];
      chart.stale = true;
      chart.points.set(robot, [...before.filter(([t]) => !now.length || t < now[0][0]), ...now]);
    }
  }

  take(step) {
    for (const chart of this.charts.values()) {
      for (const [robot, topics] of Object.entries(step.robots ?? {})) {
        const y = dig(topics[chart.topic], chart.path);
        if (typeof y !== "number") continue;
        if (!chart.points.has(robot)) chart.points.set(robot, []);
        const points = chart.points.get(robot);
        points.push([step.t, y, topics[chart.topic].k]);
        chart.stale = true;
        while (points.length && points[0][0] < step.t - WINDOW) points.shift();
      }
    }
  }

  draw(now) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    for (const chart of this.charts.values()) {
      if (chart.plot && this.outside.has(chart.element)) continue;
      if (chart.stale || !chart.lines.length || chart.plot?.width !== this.width()) this.redraw(chart);
    }
  }

  // At once, whatever has been drawn when.
  flush() {
    this.drawn = -Infinity;
    this.outside.clear();
    this.draw(0);
  }

  redraw(chart) {
    const robots = this.store.names.filter((name) => chart.points.get(name)?.length);
    if (!robots.length) return;
    const counts = robots.every((name) => typeof chart.points.get(name)[0][2] === "number"), over = counts ? chart.over : "t", width = this.width();
    const data = uPlot.join(robots.map((name) => columns(chart.points.get(name), over === "k" ? 2 : 0)));
    chart.stale = false;
    chart.button.hidden = !counts;
    chart.button.textContent = over === "k" ? "over time" : "over iterations";
    if (!chart.plot || chart.lines.join() !== robots.join()) {
      chart.plot?.destroy();
      chart.lines = robots;
      const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
      const digits = (_, values) => values.map((each) => String(+each.toPrecision(5)));
      const axis = { values: digits, stroke: ink, grid: { stroke: "#8884" }, ticks: { stroke: "#8888" } };
      chart.plot = new uPlot({
        title: chart.name, width, height: 220,
        scales: { x: { time: false } },
        axes: [{ ...axis, label: over === "k" ? "k" : "t, s" }, { ...axis }],
        series: [{ label: over }, ...robots.map((name) => ({ label: name, stroke: this.store.colour(name), width: 1.6, spanGaps: true }))],
      }, data, chart.element);
    } else {
      if (chart.plot.width !== width) chart.plot.setSize({ width, height: 220 });
      chart.plot.setData(data);
    }
  }

  width() {
    return Math.max(240, this.section.clientWidth - 24);
  }

  restyle() {
    for (const chart of this.charts.values()) chart.lines = [];
  }

  // After a lost connection: what was missed is asked for.
  refill() {
    for (const chart of this.charts.values()) {
      chart.points.clear();
      for (const robot of this.store.names) this.ask({ history: { robot, topic: chart.topic } });
    }
  }
}

// x and y of a line; x goes up (an iteration that is told twice counts once, a run that begins anew hides the one before).
function columns(points, x) {
  const kept = [];
  for (const point of points) {
    while (kept.length && kept.at(-1)[x] >= point[x]) kept.pop();
    kept.push(point);
  }
  return [kept.map((each) => each[x]), kept.map((each) => each[1])];
}
