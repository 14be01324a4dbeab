// Which app the page is about, of what kind it is, and which of its numbers come first.

import { apart, dig, plain } from "./series.js";

const MOST = 64; // numbers of an app that the page offers
const FAR = 500; // m; apps say -1000 where they know no place
const PLACE = /^(x|y|vx|vy|known|rank|k|var_.*|cov_.*|other_.*|goal_.*)$/; // of a result: shown on the map, or about others
const UNITS = { s: "s", m: "m", rad: "rad" };

export class Focus {
  constructor(store) {
    this.store = store;
    this.chosen = null; // by a person
  }

  // All apps and channels of apps that tell their state, those that run first.
  get apps() {
    const names = [...new Set([...this.store.apps.values()].flat())];
    const running = new Set(Object.values(this.store.services).flatMap((services) => Object.keys(services).filter((each) => services[each])));
    const runs = (app) => running.has(app.split("/").slice(0, 2).join("/"));
    return names.sort((a, b) => runs(b) - runs(a) || a.split("/").length - b.split("/").length || (a < b ? -1 : 1));
  }

  get app() {
    const apps = this.apps;
    return apps.includes(this.chosen) ? this.chosen : apps[0] ?? null;
  }

  parameters(app = this.app) {
    const parent = app?.split("/").slice(0, 2).join("/");
    for (const name of this.store.names) {
      const found = this.store.get(name, `${parent}/parameters`)?.parameters;
      if (found && typeof found === "object") return found;
    }
    return null;
  }

  // lockstep, periodic or event. A channel of an app is a lockstep.
  get kind() {
    const app = this.app, parameters = this.parameters();
    if (!app) return "lockstep";
    if (app.split("/").length > 2) return "lockstep";
    if (parameters) return "period" in parameters ? "periodic" : "diverges_above" in parameters ? "lockstep" : "event";
    return this.store.names.some((name) => this.store.get(name, `${app}/state`)?.k > 0) ? "lockstep" : "event";
  }

  get period() {
    const period = this.parameters()?.period?.value;
    return typeof period === "number" && period > 0 ? period : null;
  }

  // Numbers of the app, what it records or tells first: series with a label and a unit.
  values() {
    const app = this.app, store = this.store, found = new Map();
    if (!app) return [];
    const parent = app.split("/").slice(0, 2).join("/");
    const kept = this.kind === "event"; // told when it changes, and what it was until then
    const steps = this.kind === "periodic"; // each robot's own, that say nothing of the others'
    const add = (value, label, unit = "", truth = false) => found.size >= MOST || found.has(value.name) || found.set(value.name, { ...value, label, unit, held: kept, steps, stepped: truth });
    const sample = (topic) => store.names.map((name) => store.get(name, topic)).find((value) => value !== undefined);
    const told = sample(`${app}/state`) ?? {}, result = told.result ?? {};
    const places = [told.state, told.result].some((part) => part && "x" in part && "y" in part);
    const target = this.target(), seen = store.names.some((name) => Math.abs(store.get(name, `${app}/state`)?.result?.x) < FAR);
    if (target && seen && /localization|target/.test(app)) add(apart(`${app} target error`, `${app}/state`, ["result"], target), "Error of the target", "m");
    for (const name of store.names) {
      for (const topic of store.robots.get(name)?.keys() ?? []) {
        const value = store.get(name, topic), path = value?.value !== undefined ? ["value"] : ["values", "value"]; // a recording's own, or from the bus
        if (topic.startsWith(`${parent}/record/`) && typeof dig(value, path) === "number") add(plain(topic, path), topic.split("/").at(-1), this.unit(topic.split("/").at(-1), places));
        else if (topic.startsWith(`${parent}/out/`) && !/\/(goal|shape)$/.test(topic)) {
          for (const [field, value] of Object.entries(store.get(name, topic)?.values ?? {})) {
            if (typeof value === "number") add(plain(topic, ["values", field]), field === "value" ? topic.split("/").at(-1) : `${topic.split("/").at(-1)} ${field}`);
          }
        }
      }
      if (found.size > 8) break;
    }
    const numbers = (part) => Object.entries(told[part] ?? {}).filter(([, value]) => typeof value === "number" || typeof value === "boolean");
    const labels = new Set([...found.values()].map((each) => each.label));
    const rest = numbers("result").sort(([a, x], [b, y]) => (typeof x === "boolean") - (typeof y === "boolean") || PLACE.test(a) - PLACE.test(b));
    const field = (part, name, value) => add(plain(`${app}/state`, [part, name]), typeof value === "boolean" ? `${name} (1 = true)` : name, this.unit(name, places), typeof value === "boolean");
    for (const [name, value] of rest) if (!labels.has(name)) field("result", name, value);
    for (const [name, value] of numbers("state")) if (!(name in result)) field("state", name, value);
    // What an event app records are its marks; what it comes to is its result.
    const all = [...found.values()], marks = ({ sources: [{ topic }] }) => kept && topic.startsWith(`${parent}/record/`);
    return [...all.filter((each) => !marks(each)), ...all.filter(marks)];
  }

  // By the end of the name; metres of an app that tells a place, x and y, and how far off it is. Others have none that is known.
  unit(name, places) {
    return UNITS[/_(s|m|rad)$/.exec(name)?.[1]] ?? (places && /^(off|sigma|x|y)$/.test(name) ? "m" : "");
  }

  // Where the target truly is, where that is known.
  target() {
    const store = this.store;
    if (store.names.some((name) => store.get(name, "sim/target"))) return { topic: "sim/target", anyone: true };
    const target = store.swarm?.target;
    return target ? { x: target.x, y: target.y } : null;
  }

  // How wrong robots are about their own place: against the truth, or what they claim themselves.
  error() {
    const store = this.store, any = (topic, field) => store.names.some((name) => typeof store.get(name, topic)?.[field] === "number");
    if (!any("dwm/pose", "x")) return null;
    if (any("sim/truth", "x")) return { ...apart("place error", "dwm/pose", [], { topic: "sim/truth" }), label: "Position error", unit: "m", truth: true };
    return any("dwm/pose", "deviation_x") ? { ...plain("dwm/pose", ["deviation_x"]), label: "Claimed deviation", unit: "m", positive: true } : null;
  }
}
