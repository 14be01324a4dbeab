// The recordings of a folder: one is shown (A), another one may stand beside it (B), and what they differ in.

import { largest, median, scaled, short, write } from "../numbers.js";
import { held, isDistance } from "../series.js";

const STEPS = 500; // of a run, of which each is looked at
const SMALL = 0.05;

export class Runs {
  constructor(panel, difference, { store, series, focus, values, ask }) {
    Object.assign(this, { panel, difference, store, series, focus, values, ask });
    this.list = panel.querySelector(".scroll");
    this.main = document.querySelector("main");
    this.button = document.querySelector("#runs-open");
    this.button.addEventListener("click", () => this.toggle());
    this.drawn = -Infinity;
  }

  toggle(open = this.panel.hidden) {
    if (!this.store.swarm?.recording) return;
    this.panel.hidden = !open;
    this.main.classList.toggle("runs", open);
    this.begins = open; // then the run that is shown is in sight
    if (open) this.ask({ runs: {} });
    else this.ask({ beside: null });
  }

  listed(runs) {
    this.runs = runs;
    write(this.panel.querySelector(".unit"), String(runs.length));
    this.list.replaceChildren(...runs.map((run) => {
      const row = document.createElement("div"), name = document.createElement("b"), about = document.createElement("small");
      const is = run.name === this.store.swarm.recording.name, beside = run.name === this.series.beside?.name;
      const button = (text, label, on, act, kind = "") => Object.assign(document.createElement("button"), { type: "button", textContent: text, ariaLabel: label, ariaPressed: String(on), onclick: act, className: kind });
      row.className = `run${is || beside ? " on" : ""}`;
      [name.textContent, name.title] = [run.name, run.name];
      about.textContent = [run.app, `${(run.size / 1e6).toFixed(1)} MB`, new Date(run.at * 1000).toLocaleString()].filter(Boolean).join(" · ");
      row.append(name, button("A", `show ${run.name}`, is, () => this.ask({ open: run.name })), button("B", `put ${run.name} beside`, beside, () => this.ask({ beside: beside ? null : run.name }), "beside"), about);
      return row;
    }));
    if (this.begins) this.list.scrollTop = (this.list.querySelector(".on")?.offsetTop ?? 0) - this.list.offsetTop;
    this.begins = false;
  }

  // What the server has put beside; null: nothing.
  put(run) {
    this.series.beside = run;
    this.store.besidePlaces = null;
    this.main.classList.toggle("beside", Boolean(run));
    this.difference.hidden = !run;
    this.series.refill();
    this.drawn = -Infinity;
    if (this.runs) this.listed(this.runs);
  }

  draw(now) {
    const recording = this.store.swarm?.recording, shown = recording?.name;
    this.button.hidden = !recording;
    if (this.shown !== shown) {
      this.shown = shown;
      if (this.series.beside) this.put(null);
      if (this.runs && recording) this.listed(this.runs);
    }
    if (!this.series.beside || now < this.drawn + 1000) return;
    this.drawn = now;
    const rows = this.rows(this.series.beside), text = JSON.stringify(rows);
    if (text === this.text) return;
    this.text = text;
    write(this.difference.querySelector(".unit"), `${shown} against ${this.series.beside.name}`);
    this.difference.querySelector("tbody").replaceChildren(...rows.map((cells) => {
      const row = document.createElement("tr");
      cells.forEach((cell, index) => {
        const made = row.insertCell();
        made.textContent = typeof cell === "number" ? short(cell) : String(cell ?? "-");
        if (index) made.className = "num";
      });
      return row;
    }));
  }

  // Parameters that differ, how long, and the value that is charted at the end of each.
  rows(beside) {
    const a = this.store.swarm.parameters ?? {}, b = beside.parameters ?? {}, compared = (x, y) => [x, y, typeof x === "number" && typeof y === "number" ? y - x : ""];
    const differ = [...new Set([...Object.keys(a), ...Object.keys(b)])].filter((name) => JSON.stringify(a[name]) !== JSON.stringify(b[name]));
    const rows = differ.map((name) => [name, ...compared(a[name], b[name])]);
    const long = ({ first, last }) => last - first;
    const tenths = (value) => +value.toFixed(1);
    rows.push(["length, s", ...compared(tenths(long(this.store.swarm.recording)), tenths(long(beside)))]);
    const shown = this.values.shown;
    for (const value of [shown, this.focus.error()]) {
      const entry = value && this.series.want(value), [mine, its] = ["rows", "beside"].map((of) => (entry ? this.series.robots(entry, of).map((name) => this.series.points(entry, name, of)) : []));
      if (!mine.length || !its.length) continue;
      if (value === shown) rows.push([`${value.label}, stays below 5 % of its most after, s`, ...compared(settled(mine, value), settled(its, value))]);
      const [a, b] = [mine, its].map((all) => all.map((points) => points.at(-1)[1])), { unit, factor } = scaled(value.unit, largest([...a, ...b].map(Math.abs)));
      for (const [what, f] of [["largest", (ys) => Math.max(...ys)], ["median", median], ["spread", (ys) => Math.max(...ys) - Math.min(...ys)]]) {
        rows.push([`${value.label}, ${what} at the end${unit ? `, ${unit}` : ""}`, ...compared(f(a) * factor, f(b) * factor)]);
      }
    }
    return rows;
  }
}

// When the worst of all robots, or how far they are apart, stays below a small share of its most, s; null: never.
function settled(all, value) {
  const first = Math.min(...all.map((points) => points[0][0])), last = Math.max(...all.map((points) => points.at(-1)[0])), rows = [];
  for (let step = 0; step <= STEPS; step += 1) {
    const t = first + ((last - first) * step) / STEPS, ys = all.map((points) => held(points, t)?.[1]).filter((each) => each !== undefined);
    if (ys.length) rows.push([t, Math.max(...ys) - (isDistance(value) ? 0 : Math.min(...ys))]);
  }
  const bound = SMALL * largest(rows.map(([, y]) => y)), index = rows.findLastIndex(([, y]) => y > bound) + 1;
  return index < rows.length ? +rows[index][0].toFixed(1) : null;
}
