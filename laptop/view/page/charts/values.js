// Panels with charts of series: the app's own values, and how wrong robots are about their place.

import { column, largest, median, scaled, short, SIGMAS, write } from "../numbers.js";
import { dig, held, isDistance, plain, withGaps } from "../series.js";
import { sizeOf, theme } from "../theme.js";
import { Plot } from "./plot.js";

const REDRAW_MS = 400;
const STEPS = 120; // of a median's line
const CLAIM = ["dwm/pose", ["deviation_x"]]; // how far off robots say they may be
const START_S = 3; // of a run
const SIX = 6; // lines of a run beside that are drawn each; of more their median

// One chart with its title, its figures and its switches.
export class Chart {
  constructor(panel, store, series) {
    [this.panel, this.store, this.series] = [panel, store, series];
    const at = (selector) => panel.querySelector(selector);
    [this.title, this.unit, this.hero, this.note, this.body, this.empty, this.table] = ["h2", ".unit", ".hero b", ".hero .note", ".plot", ".empty", ".behind"].map(at);
    this.plot = new Plot(this.body);
    this.log = false;
    this.over = "t";
    this.also = null; // a series of what stands beside the robots' lines
    this.seen = true;
    new IntersectionObserver(([entry]) => (this.seen = entry.isIntersecting || this.body.hidden)).observe(this.body);
    for (const button of panel.querySelectorAll("[data-log]")) button.addEventListener("click", () => this.set("log", button.dataset.log === "log"));
    for (const button of panel.querySelectorAll("[data-over]")) button.addEventListener("click", () => this.set("over", button.dataset.over));
    at("[data-table]")?.addEventListener("click", (event) => {
      this.table.hidden = !this.table.hidden;
      event.currentTarget.ariaPressed = String(!this.table.hidden);
      this.drawn = "";
    });
  }

  set(name, value) {
    this[name] = value;
    this.drawn = "";
  }

  // `value`: a series with its label; null where there is none, `why` says so.
  // `claims`: lines that stand beside the robots'.
  draw(value, selected, why, hero, claims = () => []) {
    for (const button of this.panel.querySelectorAll("[data-log]")) press(button, (button.dataset.log === "log") === this.log);
    for (const button of this.panel.querySelectorAll("[data-over]")) press(button, button.dataset.over === this.over);
    const entry = value && this.series.want(value), robots = entry ? this.series.robots(entry) : [];
    this.empty.hidden = robots.length > 0;
    this.body.hidden = !robots.length || !this.table.hidden;
    write(this.title, value?.label ?? this.title.dataset.label);
    if (!robots.length) {
      write(this.empty, !value ? why : this.series.settled(entry) ? `No values yet of ${value.name}: no robot has told this field` : "asking for it ...");
      write(this.hero, "");
      write(this.note, "");
      return;
    }
    const counts = !value.held && !value.steps && robots.every((name) => typeof this.series.points(entry, name).at(-1)[2] === "number");
    for (const button of this.panel.querySelectorAll("[data-over]")) button.hidden = !counts;
    const recording = this.store.swarm?.recording, at = recording || this.store.looking ? this.store.t : null;
    const off = this.log && !isDistance(value); // what is no distance is drawn as one
    const newest = new Map(robots.map((name) => [name, (at === null ? this.series.points(entry, name).at(-1) : held(this.series.points(entry, name), at))?.[1]]).filter(([, each]) => each !== undefined));
    const said = newest.size ? hero(newest) : { value: null, text: () => "nothing told yet" }, scale = scaled(value.unit ?? "", largest([...newest.values()].map(Math.abs)));
    write(this.hero, said.value === null ? "-" : short(said.value * scale.factor));
    write(this.note, ` ${scale.unit} ${said.text(scale)}`);
    write(this.unit, [`${scale.unit}${value.truth ? " against truth" : ""}`, off && "distance from the mean", value.truth || (counts && this.over === "k" ? "over iterations" : "over time")].filter((each) => each && each !== true).join(", "));
    if (!this.table.hidden) this.rows(entry, robots, newest, scale);
    const over = counts ? this.over : "t", shape = `${entry.version} ${this.also?.version} ${value.held || recording ? this.store.zoom : ""} ${at} ${this.log} ${over} ${selected} ${sizeOf(this.body)}`;
    if (!this.seen || (shape === this.drawn && this.version === document.documentElement.dataset.theme)) return;
    [this.drawn, this.version] = [shape, document.documentElement.dataset.theme];
    const shift = over === "k" && at !== null ? held(this.series.points(entry, robots[0]), at)?.[2] ?? null : at;
    const lines = [...this.lines(entry, robots, counts && this.over === "k" ? 2 : 0, value, off), ...claims()];
    const from = over === "t" ? this.store.zoom : recording && this.zoomed ? this.counted(entry, robots, this.store.zoom) : null;
    this.plot.draw({ lines, scale, log: this.log, over, at: shift, selected, from, stepped: value.held || value.stepped, top: this.top?.(entry, robots) ?? null });
  }

  // Whether charts show a part of the recording; all of it may be shorter than the run beside.
  get zoomed() {
    const { first, last } = this.store.swarm.recording, [from, to] = this.store.zoom;
    return from > first || to < last;
  }

  // The iterations that robots did between two times.
  counted(entry, robots, [from, to]) {
    const ks = robots.map((name) => this.series.points(entry, name)).flatMap((points) => [held(points, from) ?? points[0], held(points, to) ?? points[0]]).map(([, , k]) => k);
    return [Math.min(...ks), Math.max(...ks, Math.min(...ks) + 1)];
  }

  // On a logarithmic axis what ends on zero: distances as they are, all else as the distance from the mean of all.
  lines(entry, robots, x, value, off) {
    const drawn = (points) => (value.held || x !== 0 ? points : withGaps(points));
    const from = (mean) => (points) => drawn(points).map((point) => [point[x], off && point[1] !== null ? Math.abs(point[1] - mean(point[0])) : point[1]]);
    const of = from(off && means(this.series, entry, robots));
    const now = this.store.zoom?.[1] ?? this.store.t; // until something is told a held value is what it was
    const until = (points) => (value.held && x === 0 && points.at(-1)[0] < now ? [...points, [now, points.at(-1)[1]]] : points);
    const lines = robots.map((name) => ({ name, colour: this.store.colour(name), points: of(until(this.series.points(entry, name))) }));
    const beside = this.series.beside ? this.series.robots(entry, "beside") : [];
    const its = from(off && means(this.series, entry, beside, "beside")), others = beside.map((name) => [name, its(this.series.points(entry, name, "beside"))]);
    if (others.length > SIX) lines.push({ name: "B median", colour: theme.colour("--text"), dash: true, points: middle(others.map(([, points]) => points)) });
    else for (const [name, points] of others) lines.push({ name: `B ${name}`, colour: this.store.colour(name), dash: true, points });
    return lines;
  }

  rows(entry, robots, newest, { factor }) {
    const numbers = robots.map((name) => {
      const ys = this.series.points(entry, name).map(([, y]) => y * factor);
      return [newest.get(name) * factor, Math.min(...ys), Math.max(...ys)];
    });
    const columns = [0, 1, 2].map((index) => column(numbers.map((cells) => cells[index])));
    const text = numbers.map((cells, row) => [robots[row], ...cells.map((each, index) => columns[index](each))]);
    const shape = JSON.stringify(text);
    if (shape === this.told) return;
    this.told = shape;
    this.table.querySelector("tbody").replaceChildren(...text.map((cells) => {
      const row = document.createElement("tr");
      for (const cell of cells) row.insertCell().textContent = cell;
      return row;
    }));
  }
}

// The median of many lines.
function middle(all) {
  const first = Math.min(...all.map((points) => points[0][0])), last = Math.max(...all.map((points) => points.at(-1)[0])), found = [];
  for (let step = 0; step <= STEPS; step += 1) {
    const x = first + ((last - first) * step) / STEPS, known = all.map((points) => held(points, x)?.[1]).filter(Number.isFinite);
    found.push([x, median(known)]);
  }
  return found;
}

// What the mean of all robots is at a time.
function means(series, entry, robots, run) {
  const all = robots.map((name) => series.points(entry, name, run));
  return (t) => {
    const known = all.map((points) => held(points, t)?.[1]).filter((each) => each !== undefined);
    return known.reduce((sum, each) => sum + each, 0) / (known.length || 1);
  };
}

const press = (button, on) => button.ariaPressed !== String(on) && (button.ariaPressed = String(on));

const worst = (newest) => [...newest].reduce((most, each) => (Math.abs(each[1]) > Math.abs(most[1]) ? each : most));

// The app's own values, and what else somebody has asked for.
export class Values {
  constructor(panel, store, series, focus) {
    this.chart = new Chart(panel, store, series);
    [this.store, this.focus, this.series] = [store, focus, series];
    this.choice = panel.querySelector("select");
    this.asked = []; // series that a click on a number or the address has asked for
    this.chosen = null; // name of a series
    this.extra = []; // more charts
    this.drawn = -Infinity;
    this.choice.addEventListener("change", () => this.choose(this.choice.value));
  }

  choose(name) {
    this.chosen = name;
    this.chart.drawn = "";
    this.drawn = -Infinity;
  }

  open(topic, path) {
    const value = { ...plain(topic, path), label: `${topic.split("/").slice(-2).join("/")} ${path.join(".")}`, unit: "" };
    if (!this.asked.some((each) => each.name === value.name)) this.asked.push(value);
    this.choose(value.name);
  }

  // Several charts at once, as a program that takes pictures wants them: the first here, the others in place of other panels.
  beside(charts) {
    const [first, ...others] = charts;
    this.open(...first);
    this.extra = others.map(([topic, path], index) => {
      const panel = this.chart.panel.cloneNode(true), [instead] = [document.querySelector(["#error", "#pace"][index] ?? "#events")];
      panel.removeAttribute("id");
      panel.querySelector("select").remove();
      panel.style.gridArea = instead.dataset.panel;
      instead.style.display = "none";
      instead.after(panel);
      return { chart: new Chart(panel, this.store, this.series), value: { ...plain(topic, path), label: `${topic} ${path.join(".")}`, unit: "" } };
    });
  }

  // All that can be shown, the app's first one first.
  all() {
    const own = this.focus.values();
    return [...own, ...this.asked.filter((each) => !own.some((other) => other.name === each.name)).map(this.asTold, this)];
  }

  // A series that is drawn in steps where it is of a truth value.
  asTold(value) {
    const [{ topic, fields: [path] }] = value.sources;
    return { ...value, stepped: this.store.names.some((name) => typeof dig(this.store.get(name, topic), path) === "boolean") };
  }

  // The one that stands for the app: what converging is about.
  get first() {
    return this.focus.values()[0] ?? null;
  }

  get shown() {
    const all = this.all();
    return all.find((each) => each.name === this.chosen) ?? all[0] ?? null;
  }

  draw(now, selected) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    const all = this.all(), names = JSON.stringify(all.map(({ name }) => name)), shown = this.shown;
    if (names !== this.names) {
      this.names = names;
      this.choice.replaceChildren(...all.map(({ name, label }) => new Option(label, name)));
      this.choice.hidden = all.length < 2;
    }
    if (shown && this.choice.value !== shown.name) this.choice.value = shown.name;
    for (const { chart, value } of this.extra) chart.draw(this.asTold(value), selected, "", (newest) => ({ value: worst(newest)[1], text: () => `largest, ${worst(newest)[0]}` }));
    const why = this.focus.app ? "No values yet: the app tells none. self.robot.record(name, value) in a step, or numbers in result()" : "No app has told anything yet: swarm app start NAME";
    this.chart.draw(shown, selected, why, (newest) => {
      const [name, value] = worst(newest), values = [...newest.values()];
      const spread = Math.max(...values) - Math.min(...values);
      if (isDistance(shown)) return { value, text: ({ factor }) => `worst, ${name} · median ${short(median(values) * factor)}` };
      return { value: spread, text: ({ factor }) => `spread · mean ${short((values.reduce((sum, each) => sum + each, 0) / values.length) * factor)}` };
    });
  }
}

export class PlaceErrors {
  constructor(panel, store, series, focus) {
    this.chart = new Chart(panel, store, series);
    [this.focus, this.series] = [focus, series];
    this.drawn = -Infinity;
    this.chart.top = (entry, robots) => {
      const most = this.settled(entry, robots);
      return most === null ? null : Math.max(most, this.claimed ?? 0);
    };
  }

  // The largest error after the first seconds, in which filters find their places and would make all else small; null of short runs.
  settled(entry, robots) {
    if (this.known?.entry === entry && this.known.version === entry.version) return this.known.most;
    const all = robots.flatMap((name) => ["rows", "beside"].map((of) => this.series.points(entry, name, of))).filter((points) => points.length);
    const later = all.map((points) => largest(points.filter(([t]) => t > points[0][0] + START_S).map(([, y]) => y)));
    const most = all.some((points) => points.at(-1)[0] > points[0][0] + 2 * START_S) ? 1.1 * largest(later) : null;
    this.known = { entry, version: entry.version, most };
    return most;
  }

  draw(now, selected) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    const value = this.focus.error(), claimed = value?.truth && !this.series.beside; // the lines of a run beside are dashed, too
    this.chart.also = claimed ? this.series.want(plain(...CLAIM)) : null;
    const why = this.focus.store.swarm?.kind === "virtual" ? "No estimates: of more than 12 robots virtual time is watched without their filters" : "No estimates of places: no dwm service tells one";
    this.chart.draw(value, selected, why, (newest) => {
      const [name, most] = worst(newest);
      return { value: median([...newest.values()]), text: ({ factor }) => `median · worst ${short(most * factor)}, ${name}${claimed ? " · dashed: own 95 %" : value.truth ? "" : " · as they claim: no truth"}` };
    }, () => (claimed ? this.claims() : []));
  }

  // What robots say themselves that their errors are within, the middle one of them.
  claims() {
    const series = this.series, entry = series.want(plain(...CLAIM)), all = series.robots(entry).map((name) => series.points(entry, name));
    if (!all.length) return [];
    const points = middle(all).map(([t, deviation]) => [t, SIGMAS * deviation]);
    // What they said before they knew their places would make all else small.
    const errors = series.want(this.focus.error()), most = this.settled(errors, series.robots(errors)) ?? largest(series.robots(errors).flatMap((name) => series.points(errors, name).map(([, y]) => y)));
    this.claimed = 1.2 * median(points.map(([, y]) => y));
    const highest = Math.max(most, this.claimed);
    return [{ name: "95 %", colour: theme.colour("--edge"), points: points.filter(([, y]) => y <= highest), dash: true }];
  }
}
