// The recordings of a folder: one is shown (A), another one may stand beside it (B), and what they differ in.

import { median, short, write } from "../numbers.js";

export class Runs {
  constructor(panel, difference, { store, series, values, ask }) {
    Object.assign(this, { panel, difference, store, series, values, ask });
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
    const a = this.store.swarm.parameters ?? {}, b = beside.parameters ?? {}, both = (x, y) => (typeof x === "number" && typeof y === "number" ? y - x : "");
    const differ = [...new Set([...Object.keys(a), ...Object.keys(b)])].filter((name) => JSON.stringify(a[name]) !== JSON.stringify(b[name]));
    const rows = differ.map((name) => [name, a[name], b[name], both(a[name], b[name])]);
    const long = ({ first, last }) => last - first;
    rows.push(["length, s", long(this.store.swarm.recording), long(beside), both(long(this.store.swarm.recording), long(beside))]);
    const value = this.values.shown, entry = value && this.series.want(value);
    if (entry) {
      const ends = (of) => this.series.robots(entry, of).map((name) => this.series.points(entry, name, of).at(-1)[1]);
      const [mine, its] = [ends("rows"), ends("beside")];
      for (const [what, f] of [["largest", (ys) => Math.max(...ys)], ["median", median], ["spread", (ys) => Math.max(...ys) - Math.min(...ys)]]) {
        if (mine.length && its.length) rows.push([`${value.label}, ${what} at the end${value.unit ? `, ${value.unit}` : ""}`, f(mine), f(its), both(f(mine), f(its))]);
      }
    }
    return rows;
  }
}
