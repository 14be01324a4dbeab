// The map: metres, anchors, robots, links, targets. Drawn where something that can be seen has changed, or has moved by a
// step. What seldom changes (grid, anchors, trails) is a picture of its own below the rest.

import { Pen, reach, rimSize } from "./drawing.js";
import { listen } from "./pointer.js";
import { Labels } from "./labels.js";
import { isPlace } from "../store.js";
import { sharp, theme } from "../theme.js";

const CROWD = 60; // robots above which links are thin, and trails and crowded names are left out
const ROOM = 60; // pixels between robots of a crowd that have names
const BUSY = 5; // messages a second above which a link no longer flashes: one would begin before the other has ended, in each frame
const FLASH_MS = 160;
const FRAME_MS = 16;
const STEP = 2; // pixels by which something may be off before it is drawn anew: nobody sees less
const LABELS_MS = 250; // between two looks at names that are about to move
const MARGIN = 0.3; // m around everything, and
const EDGE = 20; // px around it at least: a robot is as large in a swarm that is spread far
const LOOSE = 1.4; // times as large as it might be, and it is fitted anew
const [HEAD, HEAD_OF_PHONE] = [34, 52]; // px of the panel's title above the map
const phone = matchMedia("(max-width: 760px)");
const calm = matchMedia("(prefers-reduced-motion: reduce)"); // links are thicker where messages pass; dots that fly along them say no more

// Whether a message is on its way along a link.
const flies = ({ at, rate }, now) => now < at + FLASH_MS && rate <= BUSY && !calm.matches;

export class SwarmMap {
  constructor(canvas, store, select) {
    this.canvas = canvas;
    this.store = store;
    this.select = select;
    this.selected = null;
    this.view = null; // {x, y, scale}; null = fit
    this.box = null; // [left, bottom, right, top]: what is fitted
    this.frames = 0; // frames of the screen at which it was looked at
    this.drawn = 0; // how often it had to be drawn
    this.marks = []; // what is drawn
    this.spare = [];
    this.context = canvas.getContext("2d", { alpha: false });
    this.below = document.createElement("canvas");
    this.belowMarks = [];
    this.layers = { links: true, trails: true, ellipses: true };
    this.labels = new Labels();
    this.boxes = new Map(); // of names, as they stand
    this.worth = () => ""; // what stands behind a robot's name
    this.goals = []; // where robots are to go
    this.waiting = new Set(); // robots that wait for others
    this.wanted = null; // {robot, x, y}: where somebody wants the selected one to go
    this.held = null; // {robot, x, y}: a robot that the pointer puts elsewhere
    this.place = () => {}; // a robot is put elsewhere
    listen(this);
  }

  // Something has changed: it is drawn with the next frame of the screen. A frame that is asked for costs the browser some
  // milliseconds even where nothing is drawn in it, so that the next one is asked for when something will have moved by a step.
  wake() {
    clearTimeout(this.timer);
    if (this.awake) return;
    this.awake = true;
    requestAnimationFrame((now) => {
      this.awake = false;
      this.frames += 1;
      this.draw(now);
      this.rest(now);
    });
  }

  // Something may have changed.
  look() {
    if (this.awake) return;
    if (!this.placed || !same(this.seen([]), this.marked)) this.wake();
    else this.rest(performance.now());
  }

  rest(now) {
    const wait = this.due(now);
    clearTimeout(this.timer);
    if (wait < FRAME_MS / 2) this.wake();
    else if (wait < Infinity) this.timer = setTimeout(() => this.wake(), wait - FRAME_MS / 2); // the frame that is nearest
  }

  // ms until what moves will be a step away from where it has been drawn, if nothing new is told.
  due(now) {
    const { scale } = this.shown ?? { scale: 0 }, tip = reach(scale, this.ratio), pixels = { x: scale, y: scale, heading: tip, tilt: tip };
    let wait = this.labels.moving ? LABELS_MS : Infinity;
    for (const flash of this.store.flashes.values()) if (flies(flash, now)) return 0;
    for (const [name, { to, at, span }] of this.store.places) {
      const drawn = this.painted?.get(name), is = drawn && this.store.place(name, now), left = Math.max(0, at + span - now);
      if (!is) continue;
      for (const [axis, size] of Object.entries(pixels)) {
        const turn = axis === "heading", off = size * apart(is[axis], drawn[axis], turn), rest = size * apart(to[axis], is[axis], turn), whole = size * apart(to[axis], drawn[axis], turn);
        if (off >= STEP) return 0;
        if (whole >= STEP) wait = Math.min(wait, rest > 0 ? (left * (STEP - off)) / rest : 0);
      }
    }
    return wait;
  }

  // A robot without a pose yet has its place on a circle, so that its links can be seen.
  places(now) {
    const names = this.store.names, found = new Map();
    for (const name of names) {
      const place = this.store.place(name, now);
      if (place) found.set(name, place);
    }
    if (this.imagined && found.size) this.box = null; // fitted to a circle that is no more
    this.imagined = !found.size;
    if (this.imagined) {
      names.forEach((name, index) => {
        const angle = (2 * Math.PI * index) / names.length;
        found.set(name, { x: Math.cos(angle), y: Math.sin(angle), heading: null, tilt: 0 });
      });
    }
    return found;
  }

  // Where the target really is: where it is told to be where it moves, else where the configuration has it, if an app looks for it.
  target() {
    for (const name of this.store.names) {
      const told = this.store.get(name, "sim/target");
      if (isPlace(told)) return { name: "target", x: told.x, y: told.y };
    }
    const apps = [...this.store.apps.values()].flat(), looked = this.store.measures || apps.some((app) => /localization|target/.test(app));
    return looked || !apps.length ? this.store.swarm?.target : null;
  }

  // Every robot's estimate of the target, where its app reports x and y.
  targets() {
    const found = [];
    for (const [name, apps] of this.store.apps) {
      for (const app of apps) {
        const { x, y, sigma, var_x: xx, cov_xy: xy, var_y: yy } = this.store.get(name, `${app}/state`)?.result ?? {};
        if (!isPlace({ x, y })) continue;
        const known = typeof xx === "number" && typeof yy === "number" ? { xx, xy: typeof xy === "number" ? xy : 0, yy } : typeof sigma === "number" ? { xx: sigma ** 2, xy: 0, yy: sigma ** 2 } : null;
        if (known || app === "app/localization") found.push({ x, y, colour: this.store.colour(name), known }); // others tell their own place so
      }
    }
    return found;
  }

  // All that has a place, with room to move: the map does not follow each step.
  fit(places, targets, width, height) {
    const points = [...(this.store.swarm?.anchors ?? []), ...places.values()];
    const target = this.target();
    if (target) points.push(target);
    // An estimate that is far off must not make everything else small.
    const apart = (name) => Math.max(...points.map((each) => each[name])) - Math.min(...points.map((each) => each[name]));
    const far = points.length ? 2 * Math.max(1, apart("x"), apart("y")) : Infinity, [first = { x: 0, y: 0 }] = points;
    points.push(...targets.filter(({ x, y }) => Math.abs(x - first.x) < far && Math.abs(y - first.y) < far));
    let [left, bottom, right, top] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { x, y } of points) {
      [left, right] = [Math.min(left, x), Math.max(right, x)];
      [bottom, top] = [Math.min(bottom, y), Math.max(top, y)];
    }
    if (left > right) [left, bottom, right, top] = [-1, -1, 1, 1];
    const head = (phone.matches ? HEAD_OF_PHONE : HEAD) * (window.devicePixelRatio || 1), free = Math.max(height / 2, height - head); // below the switches
    const scale = ([x0, y0, x1, y1]) => Math.min(width / (x1 - x0), free / (y1 - y0));
    const margin = Math.max(MARGIN, (EDGE * (window.devicePixelRatio || 1)) / scale([left, bottom, right, top]));
    const box = this.box, tight = [left - margin, bottom - margin, right + margin, top + margin];
    const inside = box && left > box[0] && bottom > box[1] && right < box[2] && top < box[3];
    if (!inside || scale(tight) > LOOSE * scale(box)) this.box = tight;
    const [x0, y0, x1, y1] = this.box;
    return { x: (x0 + x1) / 2, y: (y0 + y1) / 2 + (height - free) / 2 / scale(this.box), scale: scale(this.box) };
  }

  draw(now) {
    const ratio = sharp(this.canvas);
    if (!ratio) return;
    const { width, height } = this.canvas, store = this.store;
    const places = this.places(now), targets = this.targets();
    const view = this.view ?? this.fit(places, targets, width, height);
    [this.shown, this.ratio, this.placed] = [view, ratio, places];
    const below = this.drawBelow(view, ratio, width, height);
    const at = ({ x, y }) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];

    // What can be seen, in whole pixels: most frames of robots that only balance look like the one before.
    const marks = this.seen(this.spare), tip = reach(view.scale, ratio);
    this.marked = marks.slice();
    marks.push(below, width, height, view.x, view.y, view.scale);
    const mark = (place) => at(place).forEach((each) => marks.push(Math.round(each)));
    for (const [name, place] of places) {
      const known = this.known(name);
      mark(place);
      marks.push(Math.round((place.heading ?? 9) * tip), Math.round((place.tilt ?? 0) * tip));
      if (!known) continue;
      mark(known);
      marks.push(Math.round(known.deviation_x * view.scale), Math.round((known.deviation_y ?? 0) * view.scale));
    }
    for (const target of targets) {
      mark(target);
      marks.push(target.known && Math.round(Math.sqrt(target.known.xx) * view.scale));
    }
    for (const [edge, flash] of store.flashes) if (flies(flash, now)) marks.push(edge, now);
    if (this.labels.moving) marks.push(Math.floor(now / LABELS_MS));
    if (same(marks, this.marks)) return;
    [this.marks, this.spare, this.painted] = [marks, this.marks, places];
    this.drawn += 1;
    this.paint(new Pen(this.context, ratio, view, width, height), places, targets, now);
  }

  // All that can be seen but for what moves from frame to frame, into a list.
  seen(marks) {
    const { store, layers } = this;
    marks.length = 0;
    marks.push(theme.version, store.swarm, this.selected, layers.links, layers.trails, layers.ellipses);
    for (const each of [this.wanted, this.held]) marks.push(each?.x, each?.y);
    for (const { x, y, next } of this.goals) marks.push(x, y, next);
    for (const [x, y] of Object.values(store.besidePlaces ?? {})) marks.push(x, y);
    for (const name of store.names) {
      const { red, yellow, green } = this.leds(name);
      marks.push(red, yellow, green, store.gone(name), store.failed(name), this.waiting.has(name), this.worth(name));
    }
    for (const [a, b] of store.edges) {
      const link = store.link(a, b);
      marks.push(link?.state, link?.slow, thickness(link));
    }
    return marks;
  }

  paint(pen, places, targets, now) {
    const store = this.store, crowd = store.names.length > CROWD, named = !crowd || this.room(places) > ROOM * this.ratio;
    const links = [];
    for (const [a, b] of this.layers.links ? store.edges : []) {
      const from = places.get(a), to = places.get(b);
      if (!from || !to) continue;
      const link = store.link(a, b), look = link?.state === "up" && link.slow ? "slow" : link?.state;
      links.push({ ends: pen.outside(pen.at(from.x, from.y), pen.at(to.x, to.y)), look, width: thickness(link), edges: [`${a}>${b}`, `${b}>${a}`] });
    }
    this.context.drawImage(this.below, 0, 0);
    if (crowd) pen.crowd(links);
    else {
      for (const link of links) if (link.ends) pen.link(link.ends, link);
      pen.free(places.values(), (this.belowPattern ??= this.context.createPattern(this.below, "no-repeat")));
    }
    for (const { ends, edges } of links) {
      edges.forEach((edge, index) => {
        const flash = store.flashes.get(edge);
        if (!ends || !flash || !flies(flash, now)) return;
        const [[x0, y0], [x1, y1]] = index ? [ends[1], ends[0]] : ends, share = (now - flash.at) / FLASH_MS;
        pen.message([x0 + share * (x1 - x0), y0 + share * (y1 - y0)]);
      });
    }
    for (const target of this.layers.ellipses ? targets : []) if (target.known) pen.ellipse({ ...target, ...target.known });
    for (const name of this.layers.ellipses ? places.keys() : []) {
      const known = this.known(name);
      if (!known) continue;
      const sx = known.deviation_x, sy = known.deviation_y ?? sx;
      pen.ellipse({ x: known.x, y: known.y, xx: sx * sx, xy: (known.correlation ?? 0) * sx * sy, yy: sy * sy, colour: store.colour(name) });
    }
    for (const target of targets) pen.cross(target);
    for (const [name, [x, y]] of Object.entries(store.besidePlaces ?? {})) pen.beside(pen.at(x, y), store.colour(name));
    for (const goal of this.goals) pen.goal(pen.at(goal.x, goal.y), places.has(goal.name) && pen.at(places.get(goal.name).x, places.get(goal.name).y), { ...goal, colour: store.colour(goal.name) });
    for (const wish of [this.wanted, this.held]) {
      const from = wish && places.get(wish.robot);
      if (from) pen.goal(pen.at(wish.x, wish.y), pen.at(from.x, from.y), { next: true, strong: true });
    }
    for (const [name, { x, y, heading, tilt }] of places) {
      pen.robot({ at: pen.at(x, y), heading, tilt: tilt ?? 0, colour: store.colour(name), leds: this.leds(name), gone: store.gone(name), fault: store.failed(name), waits: this.waiting.has(name), selected: name === this.selected });
    }
    this.name(pen, places, links, named, now);
  }

  // Names: the selected one first, then who is in trouble, then in order; of a crowd where there is room.
  name(pen, places, links, named, now) {
    const { width, height } = this.canvas, store = this.store, ratio = this.ratio, rim = rimSize(pen.scale, ratio);
    const rank = (name) => (name === this.selected ? 0 : store.failed(name) || this.waiting.has(name) ? 1 : 2);
    const items = [...places].filter(([name]) => named || rank(name) === 0).map(([name, { x, y }]) => {
      const value = this.worth(name), [px, py] = pen.at(x, y);
      return { name, value, x: px, y: py, r: rim, width: pen.wide(name, pen.bold) + (value ? 4 * ratio + pen.wide(value, pen.plain) : 0), height: 13 * ratio };
    }).sort((a, b) => rank(a.name) - rank(b.name));
    const target = this.target(), fixed = [...(this.store.swarm?.anchors ?? []), ...(target ? [target] : [])];
    for (const { name, x, y } of fixed) {
      const [px, py] = pen.at(x, y);
      items.push({ name: `at ${name}`, text: name, x: px, y: py, r: 9 * ratio, width: pen.wide(name, pen.plain), height: 12 * ratio });
    }
    this.boxes = this.labels.place(items, links.flatMap(({ ends }) => (ends ? [ends] : [])), width, height, now, this.goals.map(({ x, y }) => [...pen.at(x, y), 6 * ratio]));
    for (const { name, value, text } of items) pen.label(this.boxes.get(name), text ? "" : name, text ?? value, { faint: !text && store.gone(name) });
  }

  leds(name) {
    return this.store.get(name, "sim/leds") ?? this.store.get(name, "balancer/leds") ?? {};
  }

  // A robot's estimate of its own place, where it says how sure it is.
  known(name) {
    const pose = this.store.get(name, "dwm/pose");
    return typeof pose?.deviation_x === "number" && isPlace(pose) ? pose : null;
  }

  // How far robots are apart, in pixels, were they spread evenly.
  room(places) {
    const all = [...places.values()], xs = all.map((each) => each.x), ys = all.map((each) => each.y);
    return this.shown.scale * Math.sqrt(((Math.max(...xs) - Math.min(...xs)) * (Math.max(...ys) - Math.min(...ys))) / all.length);
  }

  // Counts how often it has changed.
  drawBelow(view, ratio, width, height) {
    const store = this.store, target = this.target();
    const marks = [view.x, view.y, view.scale, width, height, theme.version, store.swarm, store.trailed, target?.x, target?.y, this.layers.trails];
    if (same(marks, this.belowMarks)) return this.belows;
    this.belowMarks = marks;
    this.belowPattern = null;
    this.belows = (this.belows ?? 0) + 1;
    if (this.below.width !== width || this.below.height !== height) [this.below.width, this.below.height] = [width, height];
    const c = (this.belowContext ??= this.below.getContext("2d", { alpha: false })), pen = new Pen(c, ratio, view, width, height);
    c.fillStyle = theme.colour("--sunk");
    c.fillRect(0, 0, width, height);
    pen.grid(view, width, height);
    for (const anchor of store.swarm?.anchors ?? []) pen.anchor(anchor);
    if (target) pen.target(target);
    if (this.layers.trails && store.names.length <= CROWD) {
      for (const [name, trail] of store.trails) if (trail.length > 1) pen.trail(trail, store.colour(name));
    }
    return this.belows;
  }
}

// Of a line: by its traffic, bytes/s.
function thickness(link) {
  return Math.round(2 * (1.2 + 0.6 * Math.min(4, Math.log10(1 + (link?.rate ?? 0) / 50)))) / 2;
}

function apart(a, b, turn) {
  const off = Math.abs((Number.isFinite(a) ? a : 0) - (Number.isFinite(b) ? b : 0));
  return turn ? Math.min(off, Math.abs(2 * Math.PI - off)) : off;
}

function same(a, b) {
  if (a.length !== b.length) return false;
  for (let index = 0; index < a.length; index += 1) if (a[index] !== b[index]) return false;
  return true;
}
