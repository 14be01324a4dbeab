// A row a robot: the app's own value first, what it does, its body and its way to the others.

import { column, largest, scaled } from "../numbers.js";
import { part } from "../part.js";
import { held, withGaps } from "../series.js";

const SPARK_MS = 400;
const LOW_S = 45 * 60;
const WIDE = 200, HIGH = 20; // of a sparkline, before it is drawn out

const PHASES = new Map([["fault", "bad"], ["waiting", "warn"]]), BATTERIES = new Map([["low", "warn"], ["empty", "bad"], ["unknown", "bad"]]);

const SVG = "http://www.w3.org/2000/svg";

// Of each: its name, its group of columns, whether it is a number.
const COLUMNS = [
  ["value", "app", true], ["place error", "app", true], ["step", "app", true], ["waits for", "app"], ["app", "network"], ["body", "app body"],
  ["battery", "app body"], ["links", "app network"], ["clock", "network"], ["services", "network"], ["last fault", "body"],
];

// What a robot says may lack anything, and hold what is no number. Clocks are apart by a few milliseconds (one machine) or
// by the time between two boots.
const rounded = (value, digits) => (Number(value.toFixed(digits)) + 0).toFixed(digits); // without "-0.0"
const fixed = (value, digits, unit) => (typeof value === "number" ? `${rounded(value, digits)}${unit}` : "-");
const list = (value) => (Array.isArray(value) ? value : []);
const seconds = (value) => (Math.abs(value) < 1 ? `${rounded(value * 1000, 1)} ms` : `${value.toFixed(3)} s`);

export class Robots {
  constructor(panel, { store, series, focus, values, select }) {
    Object.assign(this, { panel, store, series, focus, values, select });
    this.table = panel.querySelector("table");
    this.body = panel.querySelector("tbody");
    this.heads = new Map();
    this.rows = new Map();
    this.sparked = -Infinity;
    const line = this.table.tHead.rows[0];
    for (const [name, group, number] of COLUMNS) {
      const head = document.createElement("th");
      head.textContent = name;
      head.scope = "col";
      head.className = `${group}${number ? " num" : ""}`;
      line.append(head);
      this.heads.set(name, head);
    }
    for (const button of panel.querySelectorAll("[data-group]")) {
      button.addEventListener("click", () => {
        this.table.dataset.group = button.dataset.group;
        for (const each of panel.querySelectorAll("button[data-group]")) each.ariaPressed = String(each === button);
      });
    }
  }

  draw(now, selected) {
    const names = this.store.names, value = this.values.first, error = this.focus.error();
    const own = value && this.series.want(value), wrong = error && this.series.want(error);
    this.panel.classList.toggle("many", names.length > 30);
    for (const [name, row] of this.rows) {
      if (names.includes(name)) continue;
      row.remove();
      this.rows.delete(name);
    }
    const at = this.store.swarm?.recording || this.store.looking ? this.store.t : Infinity;
    const columns = [[own, value], [wrong, error]].map(([entry, of]) => {
      const newest = names.map((name) => (entry ? held(this.series.points(entry, name), at)?.[1] : undefined));
      const { unit, factor } = scaled(of?.unit ?? "", largest(newest.map((each) => Math.abs(each ?? 0))));
      const told = newest.map((each) => (each === undefined ? each : each * factor)), text = column(told);
      return { unit, cells: told.map((each) => (each === undefined ? "-" : text(each))) };
    });
    this.head("value", value ? `${value.label}${columns[0].unit ? `, ${columns[0].unit}` : ""}` : "value");
    this.head("place error", `place ${error && !error.truth ? "deviation" : "error"}, ${columns[1].unit || "m"}`);
    this.head("step", this.focus.kind === "lockstep" ? "iteration" : this.focus.kind === "periodic" ? "step" : "changes");
    this.table.dataset.kind = this.focus.kind;
    names.forEach((name, index) => part(() => {
      const row = this.rows.get(name) ?? this.row(name);
      const chosen = String(name === selected), title = row.called;
      if (row.ariaSelected !== chosen) row.ariaSelected = chosen;
      const text = this.store.get(name, "view/reach")?.by === "mesh" ? `${name} (mesh)` : name;
      if (title.data !== text) title.data = text;
      const cells = [[columns[0].cells[index], "b"], [columns[1].cells[index]], ...this.cells(name)];
      const worst = ["bad", "warn"].find((kind) => cells.some(([, each = ""]) => each.split(" ")[0] === kind)) ?? "";
      if (row.dataset.kind !== worst) row.dataset.kind = worst;
      cells.forEach(([text, kind = ""], index) => {
        const cell = row.cells[index + 2], called = `${COLUMNS[index][1]}${COLUMNS[index][2] ? " num" : ""}${kind ? ` ${kind}` : ""}`;
        if (cell.textContent !== text) cell.textContent = text;
        if (cell.className !== called) cell.className = called;
        const head = this.heads.get(COLUMNS[index][0]).textContent;
        if (cell.dataset.label !== head) cell.dataset.label = head; // for cards
      });
    }));
    if (own && now > this.sparked + SPARK_MS && names.length <= 30) {
      this.sparked = now;
      for (const [name, row] of this.rows) this.spark(row, this.series.points(own, name), this.store.colour(name), at, value);
    }
  }

  head(name, text) {
    const head = this.heads.get(name);
    if (head.textContent !== text) head.textContent = text;
  }

  // The robot's name stays, the other cells are filled as it lives.
  row(name) {
    const row = this.body.insertRow(), cell = document.createElement("th"), swatch = document.createElement("span");
    cell.scope = "row";
    row.append(cell);
    row.tabIndex = 0;
    row.dataset.robot = name;
    row.addEventListener("click", () => this.select(name));
    row.addEventListener("keydown", (event) => event.key === "Enter" && this.select(name));
    swatch.className = "swatch";
    swatch.style.background = `var(--r${(this.store.order.get(name) ?? 0) % 6})`;
    const text = document.createTextNode(name);
    cell.append(swatch, text);
    row.called = text;
    const spark = row.insertCell();
    spark.className = "app spark";
    const line = document.createElementNS(SVG, "svg");
    for (const [key, value] of [["viewBox", `0 0 ${WIDE} ${HIGH}`], ["preserveAspectRatio", "none"], ["aria-hidden", "true"]]) line.setAttribute(key, value);
    row.path = document.createElementNS(SVG, "path");
    line.append(row.path);
    spark.append(line);
    for (const [, group, number] of COLUMNS) row.insertCell().className = `${group}${number ? " num" : ""}`;
    this.rows.set(name, row);
    return row;
  }

  // Its own value over the last time, without numbers. A path of the page: each canvas would cost something in every frame
  // in which the map moves.
  spark(row, points, colour, at, { held: holds, stepped }) {
    const shown = (holds ? points : withGaps(points)).filter(([t]) => t <= at);
    if (!shown.length || (shown.length < 2 && !holds)) return;
    const ys = shown.map(([, y]) => y).filter((y) => y !== null), low = Math.min(...ys), high = Math.max(...ys);
    const [first, last] = [points[0][0], holds ? Math.max(points.at(-1)[0], this.store.zoom[1]) : points.at(-1)[0]];
    const step = Math.max(1, Math.floor(shown.length / 80));
    const x = (t) => (((t - first) / (last - first || 1)) * WIDE).toFixed(1);
    let line = "", pen = "M"; // M: move there, L: draw a line there
    shown.forEach(([t, y], index) => {
      if (y === null) pen = "M";
      else if (pen === "M" || index % step === 0) {
        const up = (HIGH - 1 - ((y - low) / (high - low || 1)) * (HIGH - 2)).toFixed(1);
        line += pen === "L" && (holds || stepped) ? `H${x(t)}V${up}` : `${pen}${x(t)} ${up}`;
        pen = "L";
      }
    });
    if (holds) line += `H${x(Math.min(at, last))}`;
    if (line === row.line && colour === row.colour) return;
    [row.line, row.colour] = [line, colour];
    row.path.setAttribute("d", line);
    row.path.setAttribute("stroke", colour);
  }

  // Text and kind of each cell behind the values.
  cells(name) {
    const get = (topic) => this.store.get(name, topic);
    const body = get("balancer/state"), battery = get("balancer/battery"), clock = get("mesh/clock");
    const links = list(get("mesh/links")?.links), up = links.filter((each) => each?.state === "up").length;
    const [app, progress] = this.app(name), left = body?.battery_left;
    const volts = body ? body.battery : battery?.voltage, waits = list(progress?.waiting_for);
    return [
      [app ? String(this.k(name, app, progress)) : "-"],
      [waits.join(" ") || "-", waits.length ? "warn" : ""],
      [app ? `${app} ${progress?.phase ?? ""}` : "-", PHASES.get(progress?.phase) ?? ""],
      this.store.gone(name) ? ["gone", "bad"] : body ? [`${body.mode} ${fixed((body.tilt * 180) / Math.PI, 1, "°")}`, body.mode === "fault" ? "bad" : ""] : ["-"],
      [typeof volts === "number" ? `${fixed(volts, 2, " V")}${typeof left === "number" ? ` ${Math.round(left / 60)} min` : ""}` : "-", BATTERIES.get(body?.battery_level) ?? (typeof left === "number" && left < LOW_S ? "warn" : "")],
      [`${up}/${links.length}${links.length > 4 ? "" : ` ${links.map((each) => `${each?.state === "up" ? "" : "×"}${each?.peer}`).join(" ")}`}`, up < links.length ? "bad" : ""],
      [typeof clock?.error === "number" ? `${typeof clock.offset === "number" ? `${seconds(clock.offset)} ` : ""}±${(clock.error * 1000).toFixed(1)} ms by ${clock.root}` : "-"],
      this.services(name),
      this.fault(name, progress),
    ];
  }

  services(name) {
    const services = this.store.services[name] ?? {}, names = Object.keys(services).sort(), reach = this.store.get(name, "view/reach");
    if (reach && !reach.by) return [`out of reach: ${reach.why}`, "bad text"];
    const away = names.filter((each) => !services[each]);
    if (this.store.gone(name)) return ["gone", "bad"];
    if (away.length) return [`gone: ${away.join(" ")}`, "bad"];
    const degraded = names.filter((each) => this.store.get(name, `${each}/status`)?.state === "degraded");
    if (degraded.length) return [`degraded: ${degraded.join(" ")}`, "warn"];
    return names.length ? [`${names.length} ok`, "good"] : ["-"];
  }

  // What is wrong, else what was wrong last.
  fault(name, progress) {
    if (progress?.phase === "fault") return [String(progress.reason), "bad text"];
    const fault = this.store.get(name, "balancer/fault");
    if (fault?.name) return [String(fault.reason), "bad text"];
    const last = this.store.faults.get(name);
    return [last ? `${last.text} (at ${last.t.toFixed(1)} s)` : "none", "text muted"];
  }

  // The one that the page is about, else the one that runs; a recording has no progress, only states.
  app(name) {
    const apps = (this.store.apps.get(name) ?? []).map((topic) => topic.slice(4)), wanted = this.focus.app?.slice(4);
    const app = apps.find((each) => each === wanted) ?? apps.find((each) => this.store.services[name]?.[`app/${each}`]) ?? apps[0];
    return app === undefined ? [null, null] : [app, this.store.get(name, `app/${app}/progress`)];
  }

  k(name, app, progress) {
    return Math.max(progress?.k ?? 0, this.store.get(name, `app/${app}/state`)?.k ?? 0);
  }
}
