// The strip of time below everything: what happened when, the worst value as a hill, and where one is in it.

import { clock, write } from "../numbers.js";
import { held, isDistance } from "../series.js";
import { FONT, sharp, sizeOf, theme } from "../theme.js";

const WINDOW = 120; // s of a running swarm
const REDRAW_MS = 900;
const STEPS = 120;
const EDGE = 15; // px: half the slider's thumb, and what stands beside it

export class Strip {
  constructor(section, store, series, values) {
    Object.assign(this, { section, store, series, values });
    this.canvas = section.querySelector("#track canvas");
    this.slider = section.querySelector("#time");
    [this.track, this.now] = [section.querySelector("#track"), section.querySelector("#track .now")];
    this.bracket = null; // what charts show of it
    [this.output, this.note] = [section.querySelector("#clock output"), section.querySelector("#clock small")];
    this.drawn = -Infinity;
  }

  // From when to when it goes, s.
  get range() {
    const recording = this.store.swarm?.recording;
    if (recording) return [recording.first, Math.max(recording.last, recording.first + 0.1)];
    const last = this.store.newest ?? this.store.t;
    return [Math.max(0, last - WINDOW), Math.max(last, 1)];
  }

  // `t`: what is shown; `note`: what kind of time it is.
  tell(t, note) {
    const [first, last] = this.range, [width] = sizeOf(this.track), share = Math.min(1, Math.max(0, (t - first) / (last - first)));
    const place = `translateX(${(EDGE + share * (width - 2 * EDGE) - 1).toFixed(1)}px)`;
    if (this.now.style.transform !== place) this.now.style.transform = place;
    this.shown = t;
    if (Number(this.slider.min) !== first) this.slider.min = first;
    if (Number(this.slider.max) !== last) this.slider.max = last;
    write(this.output, clock(t));
    write(this.note, note);
    const text = `${t.toFixed(1)} s, ${note}`;
    if (this.slider.ariaValueText !== text) this.slider.ariaValueText = text;
  }

  draw(now) {
    if (now < this.drawn + REDRAW_MS) return;
    this.drawn = now;
    const ratio = sharp(this.canvas);
    if (!ratio) return;
    const [first, last] = this.range, marks = this.marks(), hill = this.hill(first, last);
    const [from, to] = this.bracket?.kept ?? [first, last], until = Math.min(to, this.shown ?? last);
    const shape = [from, to, this.store.swarm?.recording ? until.toFixed(1) : "", first.toFixed(1), last.toFixed(1), marks.length, hill?.version, theme.version, this.canvas.width].join();
    if (shape === this.shape) return;
    this.shape = shape;
    const c = this.canvas.getContext("2d"), width = this.canvas.width / ratio, height = this.canvas.height / ratio, floor = height - 22;
    const x = (t) => EDGE + ((t - first) / (last - first)) * (width - 2 * EDGE);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    if (hill) {
      const path = new Path2D();
      path.moveTo(x(hill.points[0][0]), floor);
      for (const [t, y] of hill.points) path.lineTo(x(t), floor - y * (floor - 16));
      path.lineTo(x(hill.points.at(-1)[0]), floor);
      c.fillStyle = theme.colour("--hair");
      c.fill(path);
      if (until > from) { // what has been shown of it
        c.save();
        c.beginPath();
        c.rect(x(from), 0, x(until) - x(from), floor);
        c.clip();
        c.fillStyle = theme.colour("--line");
        c.fill(path);
        c.restore();
      }
    }
    if (this.bracket?.kept) {
      c.fillStyle = theme.colour("--text");
      c.fillRect(x(from), floor - 1, x(to) - x(from), 3);
    }
    for (const [t, level] of marks) {
      if (t < first || t > last) continue;
      const colour = theme.colour({ error: "--bad", warning: "--warnmark" }[level] ?? "--edge"), at = x(t);
      c.fillStyle = c.strokeStyle = colour;
      c.lineWidth = 1;
      if (level !== "info") {
        c.globalAlpha = 0.5;
        c.beginPath();
        c.moveTo(at, 12);
        c.lineTo(at, floor);
        c.stroke();
        c.globalAlpha = 1;
      }
      c.beginPath();
      if (level === "error") c.moveTo(at, 2), c.lineTo(at + 4.5, 7), c.lineTo(at, 12), c.lineTo(at - 4.5, 7);
      else if (level === "warning") c.moveTo(at, 3), c.lineTo(at + 4.5, 11), c.lineTo(at - 4.5, 11);
      else c.arc(at, 7, 2, 0, 7);
      c.fill();
    }
    c.font = `10.5px ${FONT}`;
    c.fillStyle = theme.colour("--muted");
    c.textAlign = "center";
    const step = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 3600, 7200, 21600].find((each) => ((width - 2 * EDGE) * each) / (last - first) > 70) ?? 86400;
    for (let t = Math.ceil(first / step) * step; t <= last; t += step) c.fillText(step < 60 ? `${+t.toFixed(1)} s` : clock(t).slice(0, -2), Math.min(width - 18, Math.max(18, x(t))), height - 3);
  }

  marks() {
    return this.store.marks ?? this.store.events.map(({ t, level }) => [t, level]);
  }

  // Of the app's first value the worst, or how far robots are apart, as a share of the most.
  hill(first, last) {
    const value = this.values.first, entry = value && this.series.want(value), robots = entry ? this.series.robots(entry) : [];
    if (!robots.length || robots.length > 60) return null;
    const all = robots.map((name) => this.series.points(entry, name)), points = [];
    const positive = isDistance(value);
    for (let step = 0; step <= STEPS; step += 1) {
      const t = first + ((last - first) * step) / STEPS, ys = all.map((each) => held(each, t)?.[1]).filter((each) => each !== undefined);
      if (ys.length) points.push([t, Math.max(...ys) - (positive ? 0 : Math.min(...ys))]);
    }
    const most = Math.max(...points.map(([, y]) => y));
    return points.length > 1 && most > 0 ? { points: points.map(([t, y]) => [t, Math.max(0, y / most)]), version: entry.version } : null;
  }
}
