// Charts of any number of any key: one line for each robot that has it. Drawn by uPlot (vendor/).

const WINDOW = 120; // s
const REDRAW_MS = 200;

const dig = (value, path) => path.reduce((each, name) => each?.[name], value);

export class Charts {
  constructor(section, store, ask) {
    this.section = section;
    this.store = store;
    this.ask = ask;
    this.charts = new Map();
    this.drawn = 0;
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
      element.remove();
    });
    element.append(close);
    this.section.append(element);
    const chart = { topic, path, name, element, points: new Map(), plot: null, lines: [] };
    this.charts.set(name, chart);
    for (const robot of this.store.names) this.ask({ history: { robot, topic } });
  }

  // What a key held before the chart was opened.
  history({ robot, topic, rows }) {
    for (const chart of this.charts.values()) {
      if (chart.topic !== topic) continue;
      const before = rows.map(([t, value]) => [t, dig(value, chart.path)]).filter(([, y]) => typeof y === "number");
      const now = chart.points.get(robot) ?? [];
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
        points.push([step.t, y]);
        while (points.length && points[0][0] < step.t - WINDOW) points.shift();
      }
    }
  }

  draw(now) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    for (const chart of this.charts.values()) this.redraw(chart);
  }

  redraw(chart) {
    const robots = this.store.names.filter((name) => chart.points.get(name)?.length);
    if (!robots.length) return;
    const data = uPlot.join(robots.map((name) => [chart.points.get(name).map((each) => each[0]), chart.points.get(name).map((each) => each[1])]));
    const width = Math.max(240, this.section.clientWidth - 24);
    if (!chart.plot || chart.lines.join() !== robots.join()) {
      chart.plot?.destroy();
      chart.lines = robots;
      const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
      const axis = { stroke: ink, grid: { stroke: "#8884" }, ticks: { stroke: "#8888" } };
      chart.plot = new uPlot({
        title: chart.name, width, height: 220,
        scales: { x: { time: false } },
        axes: [{ ...axis, label: "t, s" }, { ...axis }],
        series: [{ label: "t" }, ...robots.map((name) => ({ label: name, stroke: this.store.colour(name), width: 1.6, spanGaps: true }))],
      }, data, chart.element);
    } else {
      if (chart.plot.width !== width) chart.plot.setSize({ width, height: 220 });
      chart.plot.setData(data);
    }
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
