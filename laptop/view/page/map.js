// The map: metres, anchors, robots, links, targets. Looked at for each frame of the screen as long as something moves,
// drawn where something that can be seen has changed. What seldom changes (grid, anchors, trails) is a picture of its own below the rest.

import { Pen, reach } from "./drawing.js";
import { sharp, theme } from "./theme.js";

const CROWD = 60; // robots above which links are thin, and trails and crowded names are left out
const ROOM = 60; // pixels between robots of a crowd that have names
const BUSY = 10; // messages a second above which a link no longer flashes
const FLASH_MS = 160;
const MARGIN = 0.3; // m around everything
const LOOSE = 1.4; // times as large as it might be, and it is fitted anew
const FAR = 1e4; // m; what is further away is no place

export class SwarmMap {
  constructor(canvas, store, select) {
    this.canvas = canvas;
    this.store = store;
    this.select = select;
    this.selected = null;
    this.view = null; // {x, y, scale}; null = fit
    this.box = null; // [left, bottom, right, top]: what is fitted
    this.frames = 0; // frames of the screen at which it was looked at
    this.moved = 0; // of them those behind which it went on to move
    this.drawn = 0; // how often it had to be drawn
    this.marks = []; // what is drawn
    this.spare = [];
    this.context = canvas.getContext("2d", { alpha: false });
    this.below = document.createElement("canvas");
    this.belowMarks = [];
    this.listen();
  }

  // Something may have changed: with the next frame of the screen, and with each one as long as something moves. A frame
  // that is asked for costs the browser as much as all that is done in it.
  wake() {
    if (this.awake) return;
    this.awake = true;
    requestAnimationFrame((now) => {
      this.awake = false;
      this.frames += 1;
      this.draw(now);
      if (this.moves(now)) {
        this.wake();
        this.moved += 1;
      }
    });
  }

  // Whether the next frame will differ by more than half a pixel, if nothing new is told.
  moves(now) {
    const { scale } = this.shown ?? { scale: 0 }, far = 0.5 / scale, turn = 0.5 / reach(scale, this.ratio);
    for (const [name, { to, at, span }] of this.store.places) {
      const is = now < at + span && this.placed?.get(name);
      if (is && (Math.hypot(to.x - is.x, to.y - is.y) > far || Math.abs(to.heading - is.heading) > turn || Math.abs(to.tilt - is.tilt) > turn)) return true;
    }
    return [...this.store.flashes.values()].some(({ at, rate }) => now < at + FLASH_MS && rate <= BUSY);
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

  // Where the target really is: where it is told to be where it moves, else where the configuration has it.
  target() {
    for (const name of this.store.names) {
      const told = this.store.get(name, "sim/target");
      if (told) return { name: "target", x: told.x, y: told.y };
    }
    return this.store.swarm?.target;
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
    const target = this.target();
    if (target) points.push(target);
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
    const { width, height } = this.canvas, store = this.store;
    const places = this.places(now), targets = this.targets();
    const view = this.view ?? this.fit(places, targets, width, height);
    [this.shown, this.ratio, this.placed] = [view, ratio, places];
    const below = this.drawBelow(view, ratio, width, height);
    const at = ({ x, y }) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];

    // What can be seen, in whole pixels: most frames of robots that only balance look like the one before.
    const marks = this.spare, tip = reach(view.scale, ratio);
    marks.length = 0;
    marks.push(below, width, height, theme.version, this.selected);
    const mark = (place) => at(place).forEach((each) => marks.push(Math.round(each)));
    for (const [name, place] of places) {
      const leds = this.leds(name), known = this.known(name);
      mark(place);
      marks.push(Math.round((place.heading ?? 9) * tip), Math.round((place.tilt ?? 0) * tip));
      marks.push(leds.red, leds.yellow, leds.green, this.gone(name), this.failed(name));
      if (!known) continue;
      mark(known);
      marks.push(Math.round(known.deviation_x * view.scale), Math.round((known.deviation_y ?? 0) * view.scale));
    }
    for (const target of targets) {
      mark(target);
      marks.push(target.known && Math.round(Math.sqrt(target.known.xx) * view.scale));
    }
    for (const [a, b] of store.edges) {
      const link = store.link(a, b);
      marks.push(link?.state, link?.slow, thickness(link));
    }
    for (const [edge, { at: began, rate }] of store.flashes) {
      if (now < began + FLASH_MS && rate <= BUSY) marks.push(edge, now);
    }
    if (same(marks, this.marks)) return;
    [this.marks, this.spare] = [marks, this.marks];
    this.drawn += 1;
    this.paint(new Pen(this.context, ratio, view, width, height), places, targets, now);
  }

  paint(pen, places, targets, now) {
    const store = this.store, crowd = store.names.length > CROWD, named = !crowd || this.room(places) > ROOM * this.ratio;
    const links = [];
    for (const [a, b] of store.edges) {
      const from = places.get(a), to = places.get(b);
      if (!from || !to) continue;
      const link = store.link(a, b), look = link?.state === "up" && link.slow ? "slow" : link?.state;
      links.push({ ends: [pen.at(from.x, from.y), pen.at(to.x, to.y)], look, width: thickness(link), edges: [`${a}>${b}`, `${b}>${a}`] });
    }
    this.context.drawImage(this.below, 0, 0);
    if (crowd) pen.crowd(links);
    else for (const link of links) pen.link(...link.ends, link);
    for (const { ends, edges } of links) {
      edges.forEach((edge, index) => {
        const flash = store.flashes.get(edge), share = flash ? (now - flash.at) / FLASH_MS : 2;
        const [[x0, y0], [x1, y1]] = index ? [ends[1], ends[0]] : ends;
        if (share <= 1 && flash.rate <= BUSY) pen.message([x0 + share * (x1 - x0), y0 + share * (y1 - y0)]);
      });
    }
    for (const target of targets) if (target.known) pen.ellipse({ ...target, ...target.known });
    for (const name of places.keys()) {
      const known = this.known(name);
      if (!known) continue;
      const sx = known.deviation_x, sy = known.deviation_y ?? sx;
      pen.ellipse({ x: known.x, y: known.y, xx: sx * sx, xy: (known.correlation ?? 0) * sx * sy, yy: sy * sy, colour: store.colour(name) });
    }
    for (const target of targets) pen.cross(target);
    for (const [name, { x, y, heading, tilt }] of places) {
      const fault = this.failed(name), selected = name === this.selected;
      pen.robot({ name, at: pen.at(x, y), heading, tilt: tilt ?? 0, colour: store.colour(name), leds: this.leds(name), gone: this.gone(name), fault, selected, named });
    }
  }

  leds(name) {
    return this.store.get(name, "sim/leds") ?? this.store.get(name, "balancer/leds") ?? {};
  }

  // A robot's estimate of its own place, where it says how sure it is.
  known(name) {
    const pose = this.store.get(name, "dwm/pose");
    return typeof pose?.deviation_x === "number" && Math.abs(pose.x) < FAR && Math.abs(pose.y) < FAR ? pose : null;
  }

  // Whether its balancer has given up.
  failed(name) {
    return this.store.get(name, "balancer/state")?.mode === "fault";
  }

  // Whether nothing of a robot is there.
  gone(name) {
    const services = Object.values(this.store.services[name] ?? {});
    return (services.length > 0 && services.every((there) => !there)) || this.store.get(name, "view/reach")?.by === null;
  }

  // How far robots are apart, in pixels, were they spread evenly.
  room(places) {
    const all = [...places.values()], xs = all.map((each) => each.x), ys = all.map((each) => each.y);
    return this.shown.scale * Math.sqrt(((Math.max(...xs) - Math.min(...xs)) * (Math.max(...ys) - Math.min(...ys))) / all.length);
  }

  // Counts how often it has changed.
  drawBelow(view, ratio, width, height) {
    const store = this.store, target = this.target();
    const marks = [view.x, view.y, view.scale, width, height, theme.version, store.swarm, store.trailed, target?.x, target?.y];
    if (same(marks, this.belowMarks)) return this.belows;
    this.belowMarks = marks;
    this.belows = (this.belows ?? 0) + 1;
    if (this.below.width !== width || this.below.height !== height) [this.below.width, this.below.height] = [width, height];
    const c = (this.belowContext ??= this.below.getContext("2d", { alpha: false })), pen = new Pen(c, ratio, view, width, height);
    c.fillStyle = theme.colour("--panel");
    c.fillRect(0, 0, width, height);
    pen.grid(view, width, height);
    for (const anchor of store.swarm?.anchors ?? []) pen.anchor(anchor);
    if (target) pen.target(target);
    if (store.names.length <= CROWD) {
      for (const [name, trail] of store.trails) if (trail.length > 1) pen.trail(trail, store.colour(name));
    }
    return this.belows;
  }

  listen() {
    const canvas = this.canvas;
    for (const each of ["wheel", "pointermove", "pointerup", "dblclick", "keydown"]) canvas.addEventListener(each, () => this.wake());
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

// Of a line: by its traffic, bytes/s.
function thickness(link) {
  return Math.round(2 * (1.2 + Math.min(4, Math.log10(1 + (link?.rate ?? 0) / 50)))) / 2;
}

function same(a, b) {
  if (a.length !== b.length) return false;
  for (let index = 0; index < a.length; index += 1) if (a[index] !== b[index]) return false;
  return true;
}
