// The lockstep chart: how far each robot is, and who waits for whom. A column for each robot, as high as its iteration.
//
// A robot waits for those that its app names (`progress.waiting_for`, at the latest after 3 s) and, before that or where a
// recording has no progress, for neighbours that are behind it or behind a link that is not up, once it stands still.

import { write } from "../numbers.js";
import { FONT, sharp, theme } from "../theme.js";

const STILL_S = 0.5; // a robot that has done no iteration for so long stands still
const LAG_S = 0.45; // live states come five times a second: the chart is shown as it was when all of them were there
const KEPT = 16; // states of a robot, for the way between them
const LEVELS = 4; // iterations that the picture shows at least
const NAMED = 6;

const several = (names) => (names.length > NAMED ? `${names.slice(0, NAMED).join(", ")} and ${names.length - NAMED} more` : names.join(", "));

export class LockstepChart {
  constructor(section, store, select) {
    this.section = section;
    this.canvas = section.querySelector("canvas");
    this.text = section.querySelector("p");
    this.store = store;
    this.select = select;
    this.app = null; // e.g. "app/consensus", or "app/x/channel"
    this.shown = "";
    this.clear();
    this.canvas.addEventListener("click", (event) => {
      const names = store.names, at = (event.offsetX - this.left) / this.step;
      if (at >= 0 && at < names.length) select(names[Math.floor(at)]);
    });
  }

  clear() {
    this.states = new Map(); // name -> [[swarm time, k], ...]
  }

  show(app) {
    this.app = app;
    this.clear();
    for (const [name, topics] of this.store.robots) this.add(name, topics.get(`${app}/state`));
  }

  take(step) {
    for (const [name, topics] of Object.entries(step.robots ?? {})) this.add(name, topics[`${this.app}/state`]);
  }

  add(name, state) {
    if (typeof state?.k !== "number") return;
    const t = state.t + (this.store.get(name, "mesh/clock")?.offset ?? 0), states = this.states.get(name) ?? [];
    if (states.length && (states.at(-1)[0] >= t || states.at(-1)[1] > state.k)) states.length = 0; // another run
    states.push([t, state.k]);
    if (states.length > KEPT) states.shift();
    this.states.set(name, states);
  }

  // Whether a robot's newest iteration is old, by its own clock.
  still(name) {
    let newest = 0;
    for (const value of this.store.robots.get(name).values()) if (typeof value?.t === "number" && value.t > newest) newest = value.t;
    return newest - this.store.get(name, `${this.app}/state`)?.t > STILL_S;
  }

  // Iterations of all robots at one instant of the swarm's clock; a recording's states are those of its instant already.
  iterations() {
    const newest = Math.max(...[...this.states.values()].map((states) => states.at(-1)[0]));
    const at = this.store.swarm?.recording ? Infinity : newest - LAG_S;
    const found = new Map();
    for (const name of this.store.names) {
      const states = this.states.get(name), after = states?.findIndex(([t]) => t > at) ?? -1;
      if (!states) continue;
      if (after < 0) found.set(name, states.at(-1)[1]);
      else if (after === 0) found.set(name, states[0][1]);
      else {
        const [[t0, k0], [t1, k1]] = [states[after - 1], states[after]];
        found.set(name, Math.floor(k0 + ((k1 - k0) * (at - t0)) / (t1 - t0) + 1e-9));
      }
    }
    return found;
  }

  // Whom each robot waits for: name -> [{peer, named}]. One that is gone waits for nobody.
  waits(iterations) {
    const found = new Map(), store = this.store;
    for (const name of store.names) {
      const progress = store.get(name, `${this.app}/progress`);
      if (progress?.phase === "done" || progress?.phase === "fault" || store.gone(name)) continue;
      const named = Array.isArray(progress?.waiting_for) ? [...new Set(progress.waiting_for)].filter((each) => store.order.has(each)) : [];
      const peers = named.map((peer) => ({ peer, named: true }));
      if (!named.length && iterations.has(name) && this.still(name)) {
        for (const peer of store.neighbours(name)) {
          const behind = iterations.get(peer) < iterations.get(name), cut = (store.link(name, peer)?.state ?? "up") !== "up";
          if (behind || cut) peers.push({ peer, named: false });
        }
      }
      if (peers.length) found.set(name, peers);
    }
    return found;
  }

  // In words: those on whom all wait in the end are named first.
  say(iterations, waits) {
    const ks = [...iterations.values()], least = Math.min(...ks), most = Math.max(...ks);
    const text = least === most ? `all at iteration ${most}` : `iterations ${least} to ${most}`;
    if (!waits.size) return text;
    const awaited = new Set([...waits.values()].flat().map(({ peer }) => peer));
    const idle = [...awaited].filter((name) => !waits.has(name)).sort();
    const first = [...waits].filter(([name, peers]) => peers.some(({ peer }) => idle.includes(peer) || waits.get(peer)?.some((each) => each.peer === name)));
    const said = first.slice(0, NAMED).map(([name, peers]) => `${name} waits for ${several(peers.map(({ peer }) => `${peer}${this.why(name, peer)}`))}`);
    const behind = waits.size - first.slice(0, NAMED).length;
    return `${text}; ${said.join("; ")}${behind ? `; ${behind} ${behind > 1 ? "robots wait" : "robot waits"} behind them` : ""}`;
  }

  why(name, peer) {
    if (this.store.gone(peer)) return " (gone)";
    const state = this.store.link(name, peer)?.state ?? "up";
    return state === "up" ? "" : ` (link ${state})`;
  }

  // `app`: the one that the page is about; of a lockstep.
  follow(app) {
    if (app !== this.app) this.show(app);
  }

  draw(selected) {
    const iterations = this.app ? this.iterations() : new Map();
    if (!iterations.size) return write(this.text, "No iterations yet: no app in lockstep has told its state");
    const waits = this.waits(iterations), text = this.say(iterations, waits);
    write(this.text, text);
    const ratio = sharp(this.canvas);
    const shown = JSON.stringify([[...iterations], [...waits], selected, theme.version, this.canvas.width, this.canvas.height]);
    if (!ratio || shown === this.shown) return;
    this.shown = shown;
    this.paint(iterations, waits, selected, ratio);
  }

  paint(iterations, waits, selected, ratio) {
    const c = this.canvas.getContext("2d"), names = this.store.names;
    const width = this.canvas.width / ratio, height = this.canvas.height / ratio;
    const ks = [...iterations.values()], most = Math.max(...ks), least = Math.min(Math.min(...ks), most - LEVELS + 1);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.font = `12px ${FONT}`;
    this.left = 12 + c.measureText(String(most)).width;
    const label = Math.max(...names.map((name) => c.measureText(name).width));
    this.step = (width - this.left - 4) / names.length;
    const bottom = height - 20, top = 22;
    const y = (k) => bottom - ((k - least + 1) / (most - least + 1)) * (bottom - top);
    const x = (index) => this.left + (index + 0.5) * this.step;

    // Lines for iterations, some of them with their number.
    const lines = Math.ceil((most - least + 1) / Math.max(1, Math.floor((bottom - top) / 18)));
    c.fillStyle = theme.colour("--muted");
    c.strokeStyle = theme.colour("--line");
    c.lineWidth = 1;
    c.textAlign = "right";
    c.beginPath();
    for (let line = 0; line * lines <= most - least; line += 1) {
      const k = most - line * lines;
      c.moveTo(this.left, Math.round(y(k)) + 0.5);
      c.lineTo(width, Math.round(y(k)) + 0.5);
      if (k >= 0) c.fillText(String(k), this.left - 5, y(k) + 4);
    }
    c.stroke();

    const bar = Math.max(2, Math.min(34, this.step * 0.7)), skip = Math.ceil((label + 8) / this.step);
    c.textAlign = "center";
    names.forEach((name, index) => {
      if (iterations.has(name)) {
        const height = y(iterations.get(name)), colour = this.store.colour(name);
        c.fillStyle = colour;
        c.globalAlpha = 0.28;
        c.fillRect(x(index) - bar / 2, height, bar, bottom - height);
        c.globalAlpha = 1;
        c.fillStyle = waits.has(name) ? theme.colour("--bad") : colour;
        c.fillRect(x(index) - bar / 2, height - 2, bar, 4);
      }
      if (name === selected) {
        c.strokeStyle = theme.colour("--text");
        c.lineWidth = 2;
        c.strokeRect(x(index) - bar / 2 - 3, top - 10, bar + 6, bottom - top + 12);
      }
      const near = selected !== null && name !== selected && Math.abs(index - names.indexOf(selected)) < skip;
      if ((index % skip === 0 && !near) || name === selected) {
        c.fillStyle = theme.colour("--text");
        c.fillText(name, x(index), height - 5);
      }
    });

    // An arrow from each robot that waits to the one that it waits for: full where its app names it.
    const many = waits.size > 30;
    for (const [name, peers] of waits) {
      for (const { peer, named } of peers) {
        const from = names.indexOf(name), to = names.indexOf(peer);
        if (from < 0 || to < 0) continue;
        const fade = many && selected && name !== selected ? 0.15 : 1;
        this.arrow(c, x(from), y(iterations.get(name) ?? least), x(to), y(iterations.get(peer) ?? least), named, fade, Math.min(7, 2 + this.step / 4));
      }
    }
  }

  arrow(c, x0, y0, x1, y1, named, alpha, size) {
    const lift = Math.min(26, 8 + Math.abs(x1 - x0) / 12), xm = (x0 + x1) / 2, ym = Math.max(2, Math.min(y0, y1) - lift);
    c.globalAlpha = alpha;
    c.strokeStyle = c.fillStyle = theme.colour("--bad");
    c.lineWidth = named ? 2 : 1.2;
    c.setLineDash(named || size < 5 ? [] : [4, 3]); // short ones would be dots
    c.beginPath();
    c.moveTo(x0, y0 - 2);
    c.quadraticCurveTo(xm, ym, x1, y1 - 3);
    c.stroke();
    c.setLineDash([]);
    const angle = Math.atan2(y1 - 3 - ym, x1 - xm);
    c.beginPath();
    c.moveTo(x1, y1 - 3);
    c.lineTo(x1 - size * Math.cos(angle - 0.45), y1 - 3 - size * Math.sin(angle - 0.45));
    c.lineTo(x1 - size * Math.cos(angle + 0.45), y1 - 3 - size * Math.sin(angle + 0.45));
    c.fill();
    c.globalAlpha = 1;
  }
}
