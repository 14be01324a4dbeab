// What the page knows of the swarm; filled by the steps that the server sends.

import { theme } from "./theme.js";

const TRAIL_S = 30; // of the swarm's time, as in picture.py
const TRAIL = 1000; // places at most
const TRAILS_S = 0.25; // of the swarm's time between two looks at trails
const STEP_MS = [40, 500]; // the way between two samples takes nearly as long as they are apart as a rule, within this
const NEARLY = 0.8; // else a late one would be waited for twice
const RULE = 0.2; // share of the newest one in what is the rule
const BADNESS = ["up", "suspect", "connecting", "down"];
const SLOWER = 3; // times its shortest round trip of the last minute
const SLOWER_S = 0.02;
const QUEUE = 4096; // bytes
const APPS = 32; // apps and channels of one robot; the page goes through all of them many times a second
const LINKS = 300; // links of one robot, which has at most 255 others to link to
const FAR = 1e4; // m; a robot that tells a place further away has none: the map would draw grid lines without end

export class Store {
  constructor() {
    this.clear();
  }

  clear() {
    this.t = 0;
    this.live = false;
    this.pace = null; // of virtual time
    this.swarm = null;
    this.layouts ??= null; // that the server keeps
    this.besidePlaces = null; // of the robots of the run beside this one
    this.measures = false; // whether an app measures its distance to a target
    this.apps = new Map(); // name -> [topic of a state of an app, ...], e.g. "app/consensus"
    this.edges = []; // [[a, b], ...]: links that are to be, as the newest topology has them
    this.topology = { version: -1, step: 0, by: "" }; // who has told it
    this.links = new Map(); // "r0 r1" -> link(); forgotten when a robot tells of its links
    this.robots = new Map(); // name -> Map(topic -> value)
    this.services = {};
    // Of now, also while an instant of the past is shown: whether a stop holds at a robot, and whether it is reached.
    this.stops = new Map();
    this.reached = new Map();
    this.events = [];
    this.faults = new Map(); // name -> the newest event that is an error
    this.trails = new Map(); // name -> [[x, y, the swarm's time], ...]
    this.trailed = (this.trailed ?? 0) + 1; // goes up as trails grow; their ends are below the robots, so not with each place
    this.trailedAt = -Infinity;
    this.hops = {};
    this.flashes = new Map(); // "r0>r1" -> {at, rate}
    this.places = new Map(); // name -> {from, to, at, span}: drawn between two samples
  }

  // One message of the server.
  take(step, now) {
    if (step.swarm !== undefined) this.become(step.swarm);
    if (step.services) this.services = step.services;
    if (step.pace) this.pace = step.pace;
    if (step.layouts) this.layouts = step.layouts;
    if (step.marks) this.marks = step.marks;
    if (step.beside_places) this.besidePlaces = step.beside_places;
    this.t = step.t;
    this.live = step.live;
    for (const [name, places] of Object.entries(step.trails ?? {})) this.trails.set(name, places.map(([x, y]) => [x, y, this.t]));
    for (const [name, topics] of Object.entries(step.robots ?? {})) {
      if (!this.robots.has(name)) this.robots.set(name, new Map());
      const known = this.robots.get(name);
      for (const [topic, value] of Object.entries(topics)) {
        if (!known.has(topic)) this.index(name, topic);
        known.set(topic, value);
      }
      if (topics["mesh/links"]) this.links.clear();
      if (topics["mesh/topology"]) this.rewire(name, topics["mesh/topology"]);
      if (topics["sim/truth"] || topics["dwm/pose"]) this.move(name, now);
    }
    if (step.events) {
      this.events = [...this.events, ...step.events].slice(-500);
      for (const event of step.events) if (event.level === "error") this.faults.set(event.robot, event);
    }
    if (step.hops) {
      for (const [edge, count] of Object.entries(step.hops)) {
        const before = this.flashes.get(edge) ?? { count, at: -1e9, rate: 0, seen: now };
        if (count !== before.count) {
          const seconds = Math.max(0.02, (now - before.seen) / 1000);
          const rate = 0.8 * before.rate + (0.2 * (count - before.count)) / seconds;
          this.flashes.set(edge, { count, at: now, rate, seen: now });
        } else if (before.seen === now) this.flashes.set(edge, before);
      }
    }
  }

  // What holds now.
  hear(step) {
    this.live = step.live;
    if (step.services) this.services = step.services;
    for (const [name, topics] of Object.entries(step.robots ?? {})) {
      if (topics["mesh/stopped"]) this.stops.set(name, topics["mesh/stopped"].stopped);
      if (topics["view/reach"]) this.reached.set(name, topics["view/reach"].by !== null);
    }
    for (const name of this.stops.keys()) if (this.away(name)) this.stops.delete(name); // when it is back it says so anew
  }

  // Whether nobody tells any more what holds at a robot, as its mesh does.
  away(name) {
    const services = this.services[name] ?? {}, there = Object.values(services);
    return this.reached.get(name) === false || services.mesh === false || (there.length > 0 && !there.some(Boolean));
  }

  // Robots that are known to be stopped.
  get stopped() {
    return this.names.filter((name) => this.stops.get(name) === true);
  }

  // What does not move.
  become(swarm) {
    this.swarm = swarm;
    if (swarm && this.topology.version < 0) this.edges = swarm.edges;
  }

  index(name, topic) {
    const app = /^(app\/[^/]+(?:\/(?!out\/|record\/)[^/]+)?)\/state$/.exec(topic)?.[1];
    const apps = this.apps.get(name) ?? [];
    if (app && apps.length < APPS) this.apps.set(name, [...apps, app]);
    if (/^app\/.+\/measurement$/.test(topic)) this.measures = true;
  }

  // The links may be changed while the swarm runs, by a person (another version) or by the automatic rule (another
  // step). A robot that tells an older one than before has begun anew.
  rewire(by, { version, step, edges }) {
    const now = this.topology, newer = version > now.version || (version === now.version && step > now.step);
    if (!(newer || by === now.by) || !Array.isArray(edges)) return;
    this.topology = { version, step, by };
    const known = (edge) => Array.isArray(edge) && edge.length === 2 && edge.every((each) => !this.swarm || this.order.has(each));
    const pairs = new Map(edges.filter(known).map((edge) => [edge.join(), edge]));
    this.edges = [...pairs.values()];
  }

  neighbours(name) {
    return this.edges.filter((edge) => edge.includes(name)).map(([a, b]) => (a === name ? b : a));
  }

  // Since when a link is not up, by what its robots have told, s; null where they have not.
  since(a, b) {
    const from = new Map();
    for (const { t, robot, text } of this.events) {
      const peer = robot === a ? b : robot === b ? a : null;
      if (peer === null || !text.startsWith(`link to ${peer} `)) continue;
      if (text.startsWith(`link to ${peer} up`)) from.delete(robot);
      else if (!from.has(robot)) from.set(robot, t);
    }
    return from.size ? Math.min(...from.values()) : null;
  }

  // Links that are not as they should be, the worst first: [{a, b, state}].
  troubled() {
    const found = [];
    for (const [a, b] of this.edges) {
      const state = this.link(a, b)?.state;
      if (state && state !== "up") found.push({ a, b, state });
    }
    return found.sort((x, y) => BADNESS.indexOf(y.state) - BADNESS.indexOf(x.state));
  }

  get names() {
    return this.swarm ? this.swarm.robots : [...this.robots.keys()].sort();
  }

  // Where a robot stands among the others.
  get order() {
    const names = this.names;
    if (this.ordered !== names) [this.ordered, this.ranks] = [names, new Map(names.map((name, index) => [name, index]))];
    return this.ranks;
  }

  colour(name) {
    return theme.robot(this.order.get(name) ?? 0);
  }

  get(name, topic) {
    return this.robots.get(name)?.get(topic);
  }

  // The true pose where there is one (a simulation), else the estimate.
  pose(name) {
    const pose = this.get(name, "sim/truth") ?? this.get(name, "dwm/pose");
    return isPlace(pose) ? pose : null;
  }

  move(name, now) {
    const pose = this.pose(name);
    if (!pose) return;
    const before = this.place(name, now);
    const last = this.places.get(name), apart = last ? Math.min(STEP_MS[1], now - last.at) : 0;
    const rule = last?.rule ? last.rule + RULE * (apart - last.rule) : apart;
    const span = Math.min(STEP_MS[1], Math.max(STEP_MS[0], NEARLY * rule));
    this.places.set(name, { from: before ?? pose, to: pose, at: now, span, rule });
    const trail = this.trails.get(name) ?? [], newest = trail[trail.length - 1];
    const grows = !newest || Math.hypot(newest[0] - pose.x, newest[1] - pose.y) > 0.01;
    if (grows) trail.push([pose.x, pose.y, this.t]);
    let old = Math.max(0, trail.length - TRAIL);
    while (old < trail.length - 1 && trail[old][2] < this.t - TRAIL_S) old += 1;
    trail.splice(0, old);
    if (grows || old) {
      if (!(this.t > this.trailedAt && this.t < this.trailedAt + TRAILS_S)) [this.trailed, this.trailedAt] = [this.trailed + 1, this.t];
    }
    this.trails.set(name, trail);
  }

  // Where to draw a robot now: samples come ten times a second (of a crowd five), the screen has sixty pictures.
  place(name, now) {
    const place = this.places.get(name);
    if (!place) return null;
    const share = Math.min(1, (now - place.at) / place.span);
    const ends = (key) => [place.from[key], place.to[key]].map((each) => (Number.isFinite(each) ? each : 0));
    const mix = (key, [from, to] = ends(key)) => from + share * (to - from);
    const [before, after] = ends("heading"), turn = Math.atan2(Math.sin(after - before), Math.cos(after - before));
    const heading = Number.isFinite(place.to.heading) ? before + share * turn : null;
    return { x: mix("x"), y: mix("y"), heading, tilt: mix("tilt") };
  }

  // Whether nothing of a robot is there.
  gone(name) {
    const services = Object.values(this.services[name] ?? {});
    return (services.length > 0 && services.every((there) => !there)) || this.get(name, "view/reach")?.by === null;
  }

  // Whether its balancer has given up.
  failed(name) {
    return this.get(name, "balancer/state")?.mode === "fault";
  }

  // State of a link as both ends see it: the worse of the two.
  link(a, b) {
    const name = `${a} ${b}`;
    if (!this.links.has(name)) this.links.set(name, this.judge(a, b));
    return this.links.get(name);
  }

  judge(a, b) {
    const seen = [[a, b], [b, a]].map(([from, to]) => [this.get(from, "mesh/links")?.links].flat().slice(0, LINKS).find((each) => each?.peer === to));
    const known = seen.filter(Boolean);
    if (!known.length) return null;
    const state = known.map((each) => each.state).sort((x, y) => BADNESS.indexOf(y) - BADNESS.indexOf(x))[0];
    const rate = Math.max(...known.map((each) => each.sent_rate ?? 0));
    return { state, rate, rtt: known[0].rtt, slow: known.some(slow) };
  }
}

export const isPlace = (place) => [place?.x, place?.y].every((each) => typeof each === "number" && Math.abs(each) < FAR);

// A link that is up and takes much longer than it could, or has more waiting than it may have on the way.
function slow({ rtt, rtt_min: least, queue, window }) {
  return (typeof rtt === "number" && typeof least === "number" && rtt > SLOWER * least + SLOWER_S) || queue > Math.max(window ?? 0, QUEUE);
}
