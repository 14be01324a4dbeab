// The five questions, answered in words: is everyone alive, does it converge, who holds us up, how wrong are places, what
// happened. An answer is a button to the panel that explains it.

import { ago, counted, median, scaled, short, SIGMAS, some, write } from "../numbers.js";
import { held, isDistance } from "../series.js";

const BACK_S = 8; // what converging is judged by
const SAMPLES = 24;
const JUDGE_MS = 400; // what is made of many numbers
const STILL = 0.02; // 1/s: slower than that it stands
const SETTLED = 0.01; // of the largest spread
const NEARLY = 0.05; // where what no longer gets less is noise
const LOW_S = 45 * 60;

export class Answers {
  constructor(section, { store, series, focus, values, lockstepChart, lanes, events }) {
    Object.assign(this, { section, store, series, focus, values, lockstepChart, lanes, events });
    this.buttons = new Map([...section.querySelectorAll("button")].map((button) => [button.dataset.answer, button]));
    for (const button of this.buttons.values()) button.addEventListener("click", () => this.go(button.dataset.panel));
    this.speaker = section.querySelector("[role=status]");
    this.spoken = -Infinity;
  }

  go(panel) {
    const element = document.querySelector(`main [data-panel=${panel}]`);
    element?.scrollIntoView({ block: "nearest" });
    element?.querySelector("canvas, button, select, tr[tabindex], li")?.focus?.();
    element?.classList.add("found");
    setTimeout(() => element?.classList.remove("found"), 600);
  }

  draw(now) {
    if (!this.judged || now >= this.judgedAt + JUDGE_MS || now < this.judgedAt) {
      [this.judged, this.judgedAt] = [{ converging: this.converging(), error: this.error() }, now];
    }
    const told = { alive: this.alive(), held: this.held(), ...this.judged, event: this.event() };
    for (const [name, { value, note, kind = "" }] of Object.entries(told)) {
      const button = this.buttons.get(name);
      write(button.querySelector("b"), value);
      write(button.querySelector("small"), note);
      if (button.dataset.kind !== kind) button.dataset.kind = kind;
    }
    // A screen reader hears of trouble, at most once a second.
    const trouble = Object.values(told).filter(({ kind }) => kind === "bad").map(({ value }) => value).join("; ");
    if (now >= this.spoken + 1000 && this.speaker.textContent !== trouble) [this.speaker.textContent, this.spoken] = [trouble, now];
    return told;
  }

  alive() {
    const store = this.store, names = store.names;
    const dead = names.filter((name) => store.gone(name)), failed = names.filter((name) => store.failed(name));
    const silent = names.filter((name) => !store.robots.has(name) && !dead.includes(name));
    const left = names.map((name) => [store.get(name, "balancer/state")?.battery_left, name]).filter(([each]) => typeof each === "number").sort(([a], [b]) => a - b)[0];
    const { stopped } = store, open = names.filter((name) => !stopped.includes(name));
    const value = `${names.length - dead.length - silent.length} of ${names.length}`;
    if (stopped.length) return { value: `${stopped.length} of ${names.length} stopped`, note: `${open.length ? `not confirmed by ${some(open)}; ` : ""}take the stops back to go on`, kind: "bad" };
    if (dead.length) return { value, note: `gone: ${some(dead)}`, kind: "bad" };
    if (failed.length) return { value, note: `in a fault: ${some(failed)}`, kind: "bad" };
    const ended = this.ended();
    if (ended.length) return { value, note: `the app has failed on ${some(ended)}`, kind: "bad" };
    if (left) return { value, note: `lowest battery ${left[1]}, ${Math.round(left[0] / 60)} min`, kind: left[0] < LOW_S / 3 ? "warn" : "" };
    return { value, note: silent.length ? `nothing heard of ${some(silent)}` : "no faults" };
  }

  converging() {
    const value = this.values.first, store = this.store;
    if (!value) return { value: "No values", note: this.focus.app ? "self.robot.record(name, value)" : "no app has told anything" };
    const entry = this.series.want(value), robots = this.series.robots(entry);
    if (!robots.length) return { value: "No values yet", note: value.label };
    const t = store.swarm?.recording || store.looking ? store.t : Math.max(...robots.map((name) => this.series.points(entry, name).at(-1)[0]));
    const points = robots.map((name) => this.series.points(entry, name));
    const positive = isDistance(value);
    const spread = (at) => {
      const ys = points.map((each) => held(each, at)?.[1]).filter((each) => each !== undefined);
      return ys.length ? Math.max(...ys) - (positive ? 0 : Math.min(...ys)) : NaN;
    };
    const last = spread(t);
    if (Number.isNaN(last)) return { value: "No values yet", note: value.label };
    const most = Math.max(...points.map((each) => Math.max(...each.map(([, y]) => y)))) - (positive ? 0 : Math.min(...points.map((each) => Math.min(...each.map(([, y]) => y)))));
    const scale = scaled(value.unit, last), now = `${value.label}: ${positive ? "worst" : "spread"} ${short(last * scale.factor)}${scale.unit ? ` ${scale.unit}` : ""}`;
    const agreed = held(points[0], t)?.[1];
    if (this.focus.kind === "event" && last === 0 && agreed !== undefined) return { value: `All at ${short(agreed)}`, note: `${value.label} of ${counted(robots.length)}` };
    if (this.focus.kind === "event") return { value: now.slice(value.label.length + 2), note: `${value.label} of ${counted(robots.length)}` };
    const ended = this.focus.kind === "lockstep" ? this.ended() : [];
    if (ended.length) return { value: "No, it has ended", note: `the app has failed on ${some(ended)}`, kind: "bad" };
    if (this.focus.kind === "lockstep" && this.waiting().size && this.still()) return { value: "Held", note: now, kind: "warn" };
    const rate = slope(spread, t, Math.min(BACK_S, t - Math.min(...points.map((each) => each[0][0]))));
    if (!(last > SETTLED * most) || (last < NEARLY * most && rate > -STILL)) return { value: "Yes, settled", note: now };
    if (rate < -STILL) return { value: `Yes, halves in ${+(Math.LN2 / -rate).toPrecision(2)} s`, note: now };
    return rate > STILL ? { value: "No, it grows", note: now, kind: "warn" } : { value: "It stays", note: now };
  }

  // Robots on which the app has failed.
  ended() {
    const app = this.focus.app?.split("/").slice(0, 2).join("/");
    return this.store.names.filter((name) => this.store.get(name, `${app}/progress`)?.phase === "fault");
  }

  waiting() {
    return this.lockstepChart.app && this.focus.kind === "lockstep" ? this.lockstepChart.waits(this.lockstepChart.iterations()) : new Map();
  }

  // Whether nobody has gone on for a while.
  still() {
    return this.store.names.some((name) => this.store.robots.has(name) && this.lockstepChart.still(name));
  }

  held() {
    const store = this.store, there = store.names.filter((name) => !store.gone(name)), waits = this.waiting();
    // Links of a robot that is gone are down for that: it is named itself where somebody waits for it.
    const troubled = store.troubled().filter(({ a, b }) => there.includes(a) && there.includes(b)), [worst] = troubled;
    const waiting = waits.size ? `${waits.size === there.length ? `all ${waits.size}` : waits.size} ${waits.size === 1 ? "waits" : "wait"}` : "";
    if (worst && (worst.state !== "connecting" || waits.size)) {
      const since = store.since(worst.a, worst.b), lasts = since === null ? "" : `, ${ago(Math.max(0, store.t - since))}`;
      const more = troubled.length - 1;
      return { value: `Link ${worst.a}–${worst.b} ${worst.state}${lasts}`, note: [waiting || "nobody waits for it", more ? `${more} more links` : ""].filter(Boolean).join("; "), kind: worst.state === "down" ? "bad" : "warn" };
    }
    if (waits.size) {
      const awaited = [...new Set([...waits.values()].flat().map(({ peer }) => peer))], idle = awaited.filter((name) => !waits.has(name));
      return { value: some((idle.length ? idle : awaited).map((name) => (store.gone(name) ? `${name} (gone)` : name))), note: waiting, kind: this.still() ? "bad" : "" };
    }
    if (this.focus.kind === "periodic") {
      const late = this.lanes.late();
      if (late.length) return { value: some(late), note: "no step for three periods", kind: "warn" };
    }
    const rate = this.lanes.rate();
    return { value: "Nobody", note: rate ? `${short(rate)} ${this.focus.kind === "event" ? "changes" : this.focus.kind === "periodic" ? "steps" : "iterations"}/s each` : "nobody waits" };
  }

  error() {
    const value = this.focus.error(), store = this.store;
    if (!value) return { value: "Not known", note: "no estimates of places" };
    const entry = this.series.want(value), robots = this.series.robots(entry);
    if (!robots.length) return { value: "Not known", note: "no truth yet" };
    const at = store.swarm?.recording || store.looking ? store.t : Infinity;
    const newest = robots.map((name) => [held(this.series.points(entry, name), at)?.[1], name]).filter(([each]) => each !== undefined);
    if (!newest.length) return { value: "Not known", note: "nothing told yet" };
    const [most, name] = newest.reduce((worst, each) => (each[0] > worst[0] ? each : worst));
    const scale = scaled("m", most), claims = newest.map(([each, robot]) => [each, SIGMAS * store.get(robot, "dwm/pose")?.deviation_x]).filter(([, each]) => each > 0);
    const inside = value.truth && claims.length ? `; ${claims.filter(([error, claim]) => error <= claim).length} of ${claims.length} in their 95 %` : "";
    return { value: `${short(median(newest.map(([each]) => each)) * scale.factor)} ${scale.unit} median`, note: value.truth ? `worst ${short(most * scale.factor)} ${scale.unit}, ${name}${inside}` : "as they claim: no truth of real robots" };
  }

  event() {
    const last = this.events.newest;
    if (!last) return { value: "Nothing yet", note: "links, faults and services are told here" };
    const [warnings, errors] = ["warning", "error"].map((level) => this.events.count(level));
    const trouble = [errors ? `${errors} error${errors > 1 ? "s" : ""}` : "", warnings ? `${warnings} warning${warnings > 1 ? "s" : ""}` : ""].filter(Boolean).join(", ");
    return { value: last.text, note: [`${ago(Math.max(0, this.store.t - last.t))} ago`, trouble].filter(Boolean).join(" · "), kind: last.level === "error" ? "bad" : last.level === "warning" ? "warn" : "" };
  }
}

// How fast something goes up or down, 1/s: the slope of its logarithm (least squares).
function slope(f, t, back) {
  const rows = [];
  for (let index = 0; index <= SAMPLES; index += 1) {
    const at = t - back + (back * index) / SAMPLES, y = f(at);
    if (y > 0) rows.push([at, Math.log(y)]);
  }
  if (rows.length < 3) return 0;
  const [x0, y0] = [0, 1].map((each) => rows.reduce((sum, row) => sum + row[each], 0) / rows.length);
  const square = rows.reduce((sum, [x]) => sum + (x - x0) ** 2, 0);
  return square > 0 ? rows.reduce((sum, [x, y]) => sum + (x - x0) * (y - y0), 0) / square : 0;
}
