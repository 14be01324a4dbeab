// What robots do that do not step together: a lane for each, with a tick for each step of a periodic app. Of an event app a
// dot for each change of its state, and bars and diamonds for the numbers that it records.

import { largest, write } from "../numbers.js";
import { plain } from "../series.js";
import { FONT, sharp, theme } from "../theme.js";

const SPAN_S = { periodic: 3, event: 60, lockstep: 5 };
const [OFTEN, OFTEN_S] = [40, 5]; // changes of one robot in a minute above which fewer seconds are shown
const LATE = 3; // periods
const RATE_S = 5;
const REDRAW_MS = 200;
const KINDS = ["bars", "diamonds"]; // of what an event app records
const LEFT = 44, RIGHT = 104, BOTTOM = 18, NAMED = 10; // px; the last one is the least height of a lane with its robot's name

export class Lanes {
  constructor(section, store, series, focus, select) {
    Object.assign(this, { section, store, series, focus });
    this.canvas = section.querySelector("canvas");
    this.empty = section.querySelector(".empty");
    this.drawn = -Infinity;
    this.canvas.addEventListener("click", ({ offsetY }) => {
      const name = store.names[Math.floor((offsetY - 2) / this.lane)];
      if (name) select(name);
    });
  }

  get entry() {
    const app = this.focus.app;
    return app && this.series.want(plain(`${app}/state`, ["k"]));
  }

  get now() {
    return this.store.t;
  }

  // Numbers that an event app records: each of them is a kind of mark.
  get records() {
    const recorded = ({ sources: [{ topic }] }) => topic.includes("/record/");
    return this.focus.kind === "event" ? this.focus.values().filter(recorded).slice(0, KINDS.length) : [];
  }

  // In words: what is in the lanes.
  get said() {
    const kind = this.focus.kind, names = this.records.map(({ label }, index) => `${KINDS[index]}: ${label}`);
    const what = kind === "periodic" ? "each robot's own" : names.length ? ["dots: changes", ...names].join(", ") : "changes of state";
    return `${what}, the last ${this.span} s`;
  }

  // Seconds that are shown.
  get span() {
    const kind = this.focus.kind, entry = this.entry;
    const often = kind === "event" && entry && this.series.robots(entry).some((name) => this.of(name, SPAN_S.event).length > OFTEN);
    return often ? OFTEN_S : SPAN_S[kind];
  }

  // Steps a second of the middle robot, over the last seconds.
  rate() {
    const entry = this.entry;
    if (!entry) return 0;
    const rates = this.series.robots(entry).map((name) => this.of(name, RATE_S)).map((points) => (points.length > 1 ? this.per(points) : 0)).sort((a, b) => a - b);
    return rates[rates.length >> 1] ?? 0;
  }

  per(points) {
    const [[t0, k0], [t1, k1]] = [points[0], points.at(-1)];
    return t1 > t0 ? Math.max(0, (this.focus.kind === "event" ? points.length - 1 : k1 - k0) / (t1 - t0)) : 0;
  }

  of(name, seconds) {
    const points = this.series.points(this.entry, name), now = this.now;
    let first = points.length;
    while (first > 0 && points[first - 1][0] > now - seconds) first -= 1;
    return points.slice(Math.max(0, first - 1)).filter(([t]) => t <= now);
  }

  // Robots of a periodic app that have not stepped for long.
  late() {
    const entry = this.entry, period = this.focus.period;
    if (!entry || !period) return [];
    const patience = Math.max(LATE * period, 1.5); // states come some times a second at most
    return this.series.robots(entry).filter((name) => !this.store.gone(name)).filter((name) => {
      const last = this.of(name, patience).at(-1);
      return (!last || this.now - last[0] > patience) && this.store.get(name, `${this.focus.app}/progress`)?.phase !== "done";
    });
  }

  draw(now, selected) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    const entry = this.entry, names = this.store.names, known = entry ? this.series.robots(entry) : [];
    this.empty.hidden = known.length > 0;
    if (!known.length) write(this.empty, "No steps yet: no app has told its state");
    const ratio = sharp(this.canvas);
    if (!ratio || !known.length) return;
    this.marks = this.records.map((each) => this.series.want(each));
    const shape = [entry.version, ...this.marks.map(({ version }) => version), this.now.toFixed(1), selected, theme.version, this.canvas.width, this.canvas.height].join();
    if (shape === this.shape) return;
    this.shape = shape;
    this.paint(names, selected, ratio);
  }

  paint(names, selected, ratio) {
    const c = this.canvas.getContext("2d"), width = this.canvas.width / ratio, height = this.canvas.height / ratio;
    const kind = this.focus.kind, span = this.span, period = this.focus.period, late = new Set(this.late());
    const lane = (this.lane = Math.min(26, Math.max(4, (height - BOTTOM) / names.length)));
    c.font = `600 11px ${FONT}`;
    const left = (this.left = lane < NAMED ? LEFT : Math.max(LEFT, 24 + largest(names.map((name) => c.measureText(name).width))));
    const x = (t) => left + (width - left - RIGHT) * (1 - (this.now - t) / span);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.textBaseline = "middle";
    names.forEach((name, index) => {
      const y = 2 + lane * (index + 0.5), points = this.of(name, span), colour = this.store.colour(name), rate = points.length > 1 ? this.per(this.of(name, RATE_S)) : 0;
      if (name === selected) {
        c.fillStyle = theme.colour("--select");
        c.fillRect(0, y - lane / 2, width, lane);
      }
      c.fillStyle = late.has(name) ? theme.colour("--warnmark") : colour;
      const size = Math.max(2, lane * 0.55);
      for (const t of kind === "event" ? points.map(([t]) => t) : ticks(points)) {
        if (t < this.now - span) continue;
        if (kind === "event") {
          c.beginPath();
          c.arc(x(t), y, Math.min(this.marks.length ? 2 : 4, size / 2), 0, 7);
          c.fill();
        } else c.fillRect(x(t) - 0.75, y - size / 2, 1.5, size);
      }
      this.marks.forEach((entry, kind) => {
        for (const [t] of this.series.points(entry, name)) {
          if (t < this.now - span || t > this.now) continue;
          if (kind === 0) c.fillRect(x(t) - 1, y - size / 2, 2, size);
          else diamond(c, x(t), y, Math.min(5, size / 2));
        }
      });
      if (lane < NAMED) return;
      c.fillStyle = theme.colour("--text");
      c.font = `600 11px ${FONT}`;
      c.textAlign = "left";
      c.fillText(name, 14, y);
      c.font = `11px ${FONT}`;
      c.textAlign = "right";
      if (kind === "event") {
        const last = points.at(-1);
        c.fillStyle = theme.colour("--muted");
        c.fillText(last ? `${Math.max(0, this.now - last[0]).toFixed(0)} s ago` : "nothing", width - 12, y);
        return;
      }
      c.fillText(rate ? `${rate.toFixed(1)}/s` : "-", width - 56, y);
      const lateness = period && rate ? Math.round(1000 * (1 / rate - period)) : null;
      c.fillStyle = theme.colour(late.has(name) ? "--warn" : "--muted");
      if (lateness !== null) c.fillText(`${lateness > 0 ? "+" : lateness < 0 ? "−" : ""}${Math.abs(lateness)} ms`, width - 12, y);
    });
    c.textAlign = "center";
    c.font = `11px ${FONT}`;
    c.fillStyle = theme.colour("--muted");
    for (let back = 0; back <= span + 0.01; back += span / 3) c.fillText(back ? `−${+back.toFixed(1)} s` : this.store.looking || this.store.swarm?.recording ? "then" : "now", x(this.now - back), height - 8);
  }
}

function diamond(c, x, y, size) {
  c.beginPath();
  for (const [across, down] of [[0, -size], [size, 0], [0, size], [-size, 0]]) c.lineTo(x + across, y + down);
  c.fill();
}

// Times of steps: a page is told of some, and how many there were between them.
function ticks(points) {
  const found = [];
  points.slice(1).forEach(([t1, k1], index) => {
    const [t0, k0] = points[index];
    const steps = k1 - k0;
    for (let step = 1; step <= steps && steps < 200; step += 1) found.push(t0 + ((t1 - t0) * step) / steps);
  });
  return found;
}
