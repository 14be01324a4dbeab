// The map: metres, anchors, robots, links, targets. Looked at for each frame of the screen, drawn where something that can
// be seen has changed. What seldom changes (grid, anchors, trails) is a picture of its own below the rest.

import { Pen } from "./ink.js";
import { sharp, theme } from "./theme.js";

const CROWD = 60; // robots above which links are thin, and trails and crowded names are left out
const ROOM = 60; // pixels between robots of a crowd that have names
const BUSY = 10; // messages a second above which a link no longer flashes
const FLASH_MS = 160;
const MARGIN = 0.3; // m around everything
const LOOSE = 1.4; // times as large as it might be, and it is fitted anew
const FINE = 2; // parts of a pixel that count as a change
const FAR = 1e4; // m; what is further away is no place

export class SwarmMap {
  constructor(canvas, store, select) {
    this.canvas = canvas;
    this.store = store;
    this.select = select;
    this.selected = null;
    this.view = null; // {x, y, scale}; null = fit
    this.box = null; // [left, bottom, right, top]: what is fitted
    this.frames = 0; // frames of the screen at which it was up to date
    this.drawn = 0; // of them those for which it had to be drawn
    this.marks = [];
    this.context = canvas.getContext("2d", { alpha: false });
    this.below = document.createElement("canvas");
    this.belowMarks = [];
    this.listen();
  }

  // With each frame of the screen, from now on.
  run() {
    requestAnimationFrame((now) => {
      this.draw(now);
      this.run();
    });
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

  // Every robot's estimate of the target, where its app reports x and y.
  targets() {
    const found = [];
    for (const [name, apps] of this.store.apps) {
      for (const app of apps) {
        const { x, y, sigma, var_x: xx, cov_xy: xy, var_y: yy } = this.store.get(name, `${app}/state`)?.result ?? {};
        if (!(Math.abs(x) < FAR && Math.abs(y) < FAR)) continue;
        const known = typeof xx === "number" && typeof yy === "number" ? { xx, xy: xy ?? 0, yy } : typeof sigma === "number" ? { xx: sigma ** 2, xy: 0, yy: sigma ** 2 } : null;
        if (known || app === "app/localization") found.push({ x, y, colour: this.store.colour(name), known }); // others tell their own place so
      }
    }
    return found;
  }

  // All that has a place, with room to move: the map does not follow each step.
  fit(places, targets, width, height) {
    const points = [...(this.store.swarm?.anchors ?? []), ...places.values()];
    if (this.store.swarm?.target) points.push(this.store.swarm.target);
    // An estimate that is far off must not make everything else small.
    const apart = (name) => Math.max(...points.map((each) => each[name])) - Math.min(...points.map((each) => each[name]));
    const far = points.length ? 2 * Math.max(1, apart("x"), apart("y")) : FAR, [first = { x: 0, y: 0 }] = points;
    points.push(...targets.filter(({ x, y }) => Math.abs(x - first.x) < far && Math.abs(y - first.y) < far));
    let [left, bottom, right, top] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { x, y } of points) {
      [left, right] = [Math.min(left, x), Math.max(right, x)];
      [bottom, top] = [Math.min(bottom, y), Math.max(top, y)];
    }
    if (left > right) [left, bottom, right, top] = [-1, -1, 1, 1];
    const scale = ([x0, y0, x1, y1]) => Math.min(width / (x1 - x0), height / (y1 - y0));
    const box = this.box, tight = [left - MARGIN, bottom - MARGIN, right + MARGIN, top + MARGIN];
    const inside = box && left > box[0] && bottom > box[1] && right < box[2] && top < box[3];
    if (!inside || scale(tight) > LOOSE * scale(box)) this.box = tight;
    const [x0, y0, x1, y1] = this.box;
    return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale: scale(this.box) };
  }

  draw(now) {
    const ratio = sharp(this.canvas);
    if (!ratio) return;
    this.frames += 1;
    const { width, height } = this.canvas, store = this.store;
    const places = this.places(now), targets = this.targets();
    const view = this.view ?? this.fit(places, targets, width, height);
    [this.shown, this.ratio, this.placed] = [view, ratio, places];
    const pen = new Pen(this.context, ratio, view, width, height);
    const below = this.drawBelow(view, ratio, width, height);

    const marks = [below, width, height, theme.version, this.selected];
    const fine = (x, y) => [Math.round(x * FINE) / FINE, Math.round(y * FINE) / FINE];
    const links = [];
    for (const [a, b] of store.edges) {
      const from = places.get(a), to = places.get(b);
      if (!from || !to) continue;
      const link = store.link(a, b), look = link?.state === "up" && link.slow ? "slow" : link?.state;
      const width = Math.round(10 * (1.2 + Math.min(4, Math.log10(1 + (link?.rate ?? 0) / 50)))) / 10;
      const ends = [fine(...pen.at(from.x, from.y)), fine(...pen.at(to.x, to.y))], messages = [];
      for (const [edge, [x0, y0], [x1, y1]] of [[`${a}>${b}`, ...ends], [`${b}>${a}`, ends[1], ends[0]]]) {
        const flash = store.flashes.get(edge), share = flash ? (now - flash.at) / FLASH_MS : 2;
        if (share > 1 || flash.rate > BUSY) continue;
        messages.push([x0 + share * (x1 - x0), y0 + share * (y1 - y0)]);
      }
      links.push({ ends, look, width, messages });
      marks.push(ends[0][0], ends[0][1], ends[1][0], ends[1][1], look, width, ...messages.flat());
    }
    const ellipses = [], crowd = store.names.length > CROWD, named = !crowd || this.room(places) > ROOM * ratio;
    for (const target of targets) {
      if (target.known) ellipses.push({ ...target, ...target.known });
      marks.push(...fine(...pen.at(target.x, target.y)), target.known?.xx);
    }
    const robots = [];
    for (const [name, place] of places) {
      const leds = store.get(name, "sim/leds") ?? store.get(name, "balancer/leds") ?? {};
      const services = Object.values(store.services[name] ?? {}), colour = store.colour(name);
      const [x, y] = fine(...pen.at(place.x, place.y)), known = store.get(name, "dwm/pose");
      const heading = place.heading === null ? null : Math.round(place.heading * 90) / 90, tilt = Math.round((place.tilt ?? 0) * 30) / 30;
      const gone = (services.length > 0 && services.every((there) => !there)) || store.get(name, "view/reach")?.by === null;
      const fault = store.get(name, "balancer/state")?.mode === "fault";
      robots.push({ name, x, y, heading, tilt, colour, leds, gone, fault, selected: name === this.selected, named });
      marks.push(x, y, heading, tilt, leds.red, leds.yellow, leds.green, gone, fault);
      if (typeof known?.deviation_x === "number" && Math.abs(known.x) < FAR && Math.abs(known.y) < FAR) {
        const sx = known.deviation_x, sy = known.deviation_y ?? sx;
        ellipses.push({ x: known.x, y: known.y, xx: sx * sx, xy: (known.correlation ?? 0) * sx * sy, yy: sy * sy, colour });
        marks.push(...fine(...pen.at(known.x, known.y)), Math.round(sx * view.scale * FINE), Math.round(sy * view.scale * FINE));
      }
    }
    if (same(marks, this.marks)) return;
    this.marks = marks;
    this.drawn += 1;
    this.context.drawImage(this.below, 0, 0);
    if (crowd) pen.crowd(links);
    else for (const link of links) pen.link(...link.ends, link);
    for (const link of links) link.messages.forEach((place) => pen.message(place));
    for (const ellipse of ellipses) pen.ellipse(ellipse);
    for (const target of targets) pen.cross(target);
    for (const robot of robots) pen.robot(robot);
  }

  // How far robots are apart, in pixels, were they spread evenly.
  room(places) {
    const all = [...places.values()], xs = all.map((each) => each.x), ys = all.map((each) => each.y);
    return this.shown.scale * Math.sqrt(((Math.max(...xs) - Math.min(...xs)) * (Math.max(...ys) - Math.min(...ys))) / all.length);
  }

  // Counts how often it has changed.
  drawBelow(view, ratio, width, height) {
    const store = this.store, marks = [view.x, view.y, view.scale, width, height, theme.version, store.swarm, store.trailed];
    if (same(marks, this.belowMarks)) return this.belows;
    this.belowMarks = marks;
    this.belows = (this.belows ?? 0) + 1;
    if (this.below.width !== width || this.below.height !== height) [this.below.width, this.below.height] = [width, height];
    const c = (this.belowContext ??= this.below.getContext("2d", { alpha: false })), pen = new Pen(c, ratio, view, width, height);
    c.fillStyle = theme.colour("--panel");
    c.fillRect(0, 0, width, height);
    pen.grid(view, width, height);
    for (const anchor of store.swarm?.anchors ?? []) pen.anchor(anchor);
    if (store.swarm?.target) pen.target(store.swarm.target);
    if (store.names.length <= CROWD) {
      for (const [name, trail] of store.trails) if (trail.length > 1) pen.trail(trail, store.colour(name));
    }
    return this.belows;
  }

  listen() {
    const canvas = this.canvas;
    let from = null;
    const metres = (event) => {
      const box = canvas.getBoundingClientRect(), { x, y, scale } = this.shown;
      return [x + ((event.clientX - box.left) * this.ratio - canvas.width / 2) / scale, y - ((event.clientY - box.top) * this.ratio - canvas.height / 2) / scale];
    };
    const zoom = (factor, x, y) => {
      const view = this.view ?? { ...this.shown };
      this.view = { x: x + (view.x - x) / factor, y: y + (view.y - y) / factor, scale: view.scale * factor };
    };
    const fingers = new Map();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY / 500), ...metres(event));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, event);
      from = { event, view: this.view ?? { ...this.shown }, moved: fingers.size > 1 };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!from || !fingers.has(event.pointerId)) return;
      const other = [...fingers.values()].find((each) => each.pointerId !== event.pointerId);
      if (other) { // two fingers: what is between them grows as their distance does
        const before = fingers.get(event.pointerId), apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
        if (apart(before) > 0) zoom(apart(event) / apart(before), ...metres(other));
      } else {
        const dx = (event.clientX - from.event.clientX) * this.ratio, dy = (event.clientY - from.event.clientY) * this.ratio;
        if (Math.hypot(dx, dy) > 4) from.moved = true;
        if (from.moved && from.event.pointerId === event.pointerId) this.view = { ...from.view, x: from.view.x - dx / from.view.scale, y: from.view.y + dy / from.view.scale };
      }
      fingers.set(event.pointerId, event);
    });
    canvas.addEventListener("pointerup", (event) => {
      if (from && !from.moved) {
        const [x, y] = metres(event);
        const near = [...this.placed].map(([name, place]) => [Math.hypot(place.x - x, place.y - y), name]).sort((a, b) => a[0] - b[0])[0];
        if (near && near[0] * this.shown.scale < 24 * this.ratio) this.select(near[1]);
      }
      fingers.delete(event.pointerId);
      from = null;
    });
    canvas.addEventListener("pointercancel", (event) => {
      fingers.delete(event.pointerId);
      from = null;
    });
    canvas.addEventListener("dblclick", () => ([this.view, this.box] = [null, null]));
    canvas.addEventListener("keydown", (event) => {
      const view = this.view ?? { ...this.shown }, step = (40 * this.ratio) / view.scale;
      const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
      if (moves[event.key]) this.view = { ...view, x: view.x + moves[event.key][0], y: view.y + moves[event.key][1] };
      else if (event.key === "+") zoom(1.25, view.x, view.y);
      else if (event.key === "-") zoom(0.8, view.x, view.y);
      else if (event.key === "0") [this.view, this.box] = [null, null];
      else return;
      event.preventDefault();
    });
  }
}

function same(a, b) {
  if (a.length !== b.length) return false;
  for (let index = 0; index < a.length; index += 1) if (a[index] !== b[index]) return false;
  return true;
}
