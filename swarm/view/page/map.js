// The map: metres, anchors, robots, links, targets. Drawn on a canvas, a picture for each frame of the screen.

import { sharp, theme } from "./theme.js";

const BODY = 0.055; // half a Balboa's width, m
const CROWD = 60; // robots above which links are thin, and trails and crowded names are left out
const ROOM = 60; // pixels between robots of a crowd that have names
const COLOURS = { up: "--good", suspect: "--warn", connecting: "--warn", down: "--bad" };
const BUSY = 10; // messages a second above which a link no longer flashes
const FLASH_MS = 160;

export class SwarmMap {
  constructor(canvas, store, select) {
    this.canvas = canvas;
    this.store = store;
    this.select = select;
    this.selected = null;
    this.view = null; // {x, y, scale}; null = fit
    this.frames = 0;
    this.context = canvas.getContext("2d");
    this.listen();
    requestAnimationFrame((now) => this.draw(now));
  }

  // Everything that has a place.
  bounds(now) {
    const points = (this.store.swarm?.anchors ?? []).map((anchor) => [anchor.x, anchor.y]);
    for (const name of this.store.names) {
      const place = this.place(name, now);
      if (place) points.push([place.x, place.y]);
    }
    if (!points.length) return { x: 0, y: 0, width: 2, height: 2 };
    const xs = points.map((each) => each[0]), ys = points.map((each) => each[1]);
    // An estimate that is far off must not make everything else small.
    const far = 2 * Math.max(1, Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys)), [x0, y0] = points[0];
    for (const { x, y } of this.targets()) {
      if (Math.abs(x - x0) > far || Math.abs(y - y0) > far) continue;
      xs.push(x);
      ys.push(y);
    }
    const x = (Math.min(...xs) + Math.max(...xs)) / 2, y = (Math.min(...ys) + Math.max(...ys)) / 2;
    return { x, y, width: 1.06 * (Math.max(...xs) - Math.min(...xs)) + 0.6, height: 1.06 * (Math.max(...ys) - Math.min(...ys)) + 0.6 };
  }

  // A robot without a pose yet has its place on a circle, so that its links can be seen.
  place(name, now) {
    const place = this.store.place(name, now);
    if (place) return place;
    const names = this.store.names, angle = (2 * Math.PI * names.indexOf(name)) / Math.max(1, names.length);
    return names.some((each) => this.store.pose(each)) ? null : { x: Math.cos(angle), y: Math.sin(angle), heading: null, tilt: 0 };
  }

  // Every robot's estimate of the target, where its app reports x and y.
  targets() {
    const found = [];
    for (const [name, apps] of this.store.apps) {
      for (const app of apps) {
        const { x, y, sigma } = this.store.get(name, `${app}/state`)?.result ?? {};
        if (typeof x === "number" && typeof y === "number" && Math.abs(x) < 1e4 && Math.abs(y) < 1e4) found.push({ name, x, y, sigma });
      }
    }
    return found;
  }

  fit(now) {
    const { width, height } = this.canvas;
    const bounds = this.bounds(now);
    return { x: bounds.x, y: bounds.y, scale: Math.min(width / bounds.width, height / bounds.height) };
  }

  draw(now) {
    requestAnimationFrame((next) => this.draw(next));
    const ratio = sharp(this.canvas);
    if (!ratio) return;
    const { width, height } = this.canvas;
    this.frames += 1;
    const view = this.view ?? this.fit(now), c = this.context;
    this.shown = view;
    this.ratio = ratio;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = theme.colour("--panel");
    c.fillRect(0, 0, width, height);
    this.at = (x, y) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
    c.font = `${12 * ratio}px system-ui, sans-serif`;
    this.grid(c, width, height, view);
    for (const anchor of this.store.swarm?.anchors ?? []) this.anchor(c, anchor);
    const names = this.store.names, crowd = names.length > CROWD;
    if (crowd) this.links(c, now);
    else for (const [a, b] of this.store.edges) this.link(c, a, b, now);
    if (!crowd) for (const name of names) this.trail(c, name);
    for (const target of this.targets()) this.target(c, target);
    this.named = !crowd || this.room(names) > ROOM * ratio;
    for (const name of names) this.robot(c, name, now);
  }

  // How far robots are apart, in pixels, were they spread evenly.
  room(names) {
    const places = names.map((name) => this.store.places.get(name)?.to).filter(Boolean);
    if (!places.length) return 0;
    const xs = places.map((each) => each.x), ys = places.map((each) => each.y);
    const area = (Math.max(...xs) - Math.min(...xs)) * (Math.max(...ys) - Math.min(...ys));
    return this.shown.scale * Math.sqrt(area / places.length);
  }

  // Of a crowd: thin lines, those of a colour at once.
  links(c, now) {
    const lines = new Map();
    for (const [a, b] of this.store.edges) {
      const from = this.place(a, now), to = this.place(b, now);
      if (!from || !to) continue;
      const colour = COLOURS[this.store.link(a, b)?.state] ?? "--faint";
      if (!lines.has(colour)) lines.set(colour, new Path2D());
      lines.get(colour).moveTo(...this.at(from.x, from.y));
      lines.get(colour).lineTo(...this.at(to.x, to.y));
    }
    c.lineWidth = this.ratio;
    for (const [colour, path] of lines) {
      c.globalAlpha = colour === "--good" ? 0.35 : 1;
      c.strokeStyle = theme.colour(colour);
      c.stroke(path);
    }
    c.globalAlpha = 1;
  }

  grid(c, width, height, view) {
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
    const step = steps.find((each) => each * view.scale >= 60 * this.ratio) ?? 1000;
    c.strokeStyle = theme.colour("--line");
    c.fillStyle = theme.colour("--faint");
    c.lineWidth = 1;
    c.beginPath();
    const left = view.x - width / 2 / view.scale, bottom = view.y - height / 2 / view.scale;
    for (let x = Math.ceil(left / step) * step; x < left + width / view.scale; x += step) {
      const [px] = this.at(x, 0);
      c.moveTo(px, 0); c.lineTo(px, height);
      c.fillText(`${+x.toFixed(2)}${Math.abs(x) < step / 2 ? " m" : ""}`, px + 3, height - 4 * this.ratio);
    }
    for (let y = Math.ceil(bottom / step) * step; y < bottom + height / view.scale; y += step) {
      const [, py] = this.at(0, y);
      c.moveTo(0, py); c.lineTo(width, py);
      c.fillText(`${+y.toFixed(2)}`, 3, py - 3);
    }
    c.stroke();
  }

  anchor(c, anchor) {
    const [x, y] = this.at(anchor.x, anchor.y), size = 6 * this.ratio;
    c.fillStyle = theme.colour("--faint");
    c.beginPath();
    c.moveTo(x, y - size); c.lineTo(x + size, y + size); c.lineTo(x - size, y + size);
    c.fill();
    c.fillText(anchor.name, x + size + 2, y + size);
  }

  link(c, a, b, now) {
    const from = this.place(a, now), to = this.place(b, now);
    if (!from || !to) return;
    const link = this.store.link(a, b), state = link?.state;
    c.strokeStyle = theme.colour(COLOURS[state] ?? "--faint");
    c.lineWidth = this.ratio * (1.2 + Math.min(4, Math.log10(1 + (link?.rate ?? 0) / 50)));
    c.setLineDash(state === "up" ? [] : [6 * this.ratio, 5 * this.ratio]);
    const [ax, ay] = this.at(from.x, from.y), [bx, by] = this.at(to.x, to.y);
    c.beginPath(); c.moveTo(ax, ay); c.lineTo(bx, by); c.stroke();
    c.setLineDash([]);
    for (const [edge, x0, y0, x1, y1] of [[`${a}>${b}`, ax, ay, bx, by], [`${b}>${a}`, bx, by, ax, ay]]) {
      const flash = this.store.flashes.get(edge), age = flash ? now - flash.at : 1e9;
      if (!flash || age > FLASH_MS || flash.rate > BUSY) continue;
      const share = age / FLASH_MS;
      c.fillStyle = theme.colour("--accent");
      c.beginPath(); c.arc(x0 + share * (x1 - x0), y0 + share * (y1 - y0), 4 * this.ratio, 0, 7); c.fill();
    }
  }

  trail(c, name) {
    const trail = this.store.trails.get(name);
    if (!trail || trail.length < 2) return;
    c.strokeStyle = this.store.colour(name);
    c.globalAlpha = 0.35;
    c.lineWidth = 1.5 * this.ratio;
    c.beginPath();
    trail.forEach(([x, y], index) => (index ? c.lineTo(...this.at(x, y)) : c.moveTo(...this.at(x, y))));
    c.stroke();
    c.globalAlpha = 1;
  }

  target(c, { name, x, y, sigma }) {
    const [px, py] = this.at(x, y), size = 5 * this.ratio;
    c.strokeStyle = this.store.colour(name);
    c.lineWidth = 2 * this.ratio;
    c.beginPath();
    c.moveTo(px - size, py - size); c.lineTo(px + size, py + size);
    c.moveTo(px - size, py + size); c.lineTo(px + size, py - size);
    c.stroke();
    if (typeof sigma === "number") this.ellipse(c, x, y, sigma, sigma, this.store.colour(name));
  }

  ellipse(c, x, y, sx, sy, colour) {
    const [px, py] = this.at(x, y);
    c.strokeStyle = colour;
    c.globalAlpha = 0.6;
    c.lineWidth = this.ratio;
    c.beginPath(); c.ellipse(px, py, sx * this.shown.scale, sy * this.shown.scale, 0, 0, 7); c.stroke();
    c.globalAlpha = 1;
  }

  robot(c, name, now) {
    const place = this.place(name, now);
    if (!place) return;
    const [x, y] = this.at(place.x, place.y), size = Math.max(8 * this.ratio, BODY * this.shown.scale);
    const services = Object.values(this.store.services[name] ?? {});
    const gone = (services.length && services.every((there) => !there)) || this.store.get(name, "view/reach")?.by === null;
    const estimate = this.store.get(name, "dwm/pose");
    if (typeof estimate?.deviation_x === "number") {
      this.ellipse(c, estimate.x, estimate.y, 2 * estimate.deviation_x, 2 * (estimate.deviation_y ?? estimate.deviation_x), this.store.colour(name));
    }
    c.save();
    c.translate(x, y);
    c.globalAlpha = gone ? 0.3 : 1;
    if (name === this.selected) {
      c.strokeStyle = theme.colour("--accent");
      c.lineWidth = 3 * this.ratio;
      c.beginPath(); c.arc(0, 0, size * 1.6, 0, 7); c.stroke();
    }
    c.save();
    if (place.heading !== null) c.rotate(-place.heading);
    // From above a body that leans is longer: that is how much it leans.
    const length = size * (0.45 + Math.abs(Math.sin(place.tilt ?? 0)));
    c.fillStyle = this.store.colour(name);
    c.beginPath(); c.roundRect(-length, -size, 2 * length, 2 * size, 3 * this.ratio); c.fill();
    if (place.heading !== null) {
      c.strokeStyle = theme.colour("--ink");
      c.lineWidth = 2 * this.ratio;
      c.beginPath(); c.moveTo(0, 0); c.lineTo(size * 1.5, 0); c.stroke();
    }
    c.restore();
    const leds = this.store.get(name, "sim/leds") ?? this.store.get(name, "balancer/leds") ?? {};
    ["red", "yellow", "green"].forEach((colour, index) => {
      c.fillStyle = leds[colour] ? { red: "#ff3b30", yellow: "#ffcc00", green: "#34c759" }[colour] : theme.colour("--line");
      c.beginPath(); c.arc((index - 1) * size * 0.62, -size * 1.45, size * 0.26, 0, 7); c.fill();
    });
    c.fillStyle = theme.colour("--ink");
    if (this.named || name === this.selected) c.fillText(name, size * 1.2, size * 1.4);
    c.restore();
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
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY / 500), ...metres(event));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      from = { event, view: this.view ?? { ...this.shown }, moved: false };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      const dx = (event.clientX - from.event.clientX) * this.ratio, dy = (event.clientY - from.event.clientY) * this.ratio;
      if (Math.hypot(dx, dy) > 4) from.moved = true;
      if (from.moved) this.view = { ...from.view, x: from.view.x - dx / from.view.scale, y: from.view.y + dy / from.view.scale };
    });
    canvas.addEventListener("pointerup", (event) => {
      if (from && !from.moved) {
        const [x, y] = metres(event), now = performance.now();
        const near = this.store.names
          .map((name) => [name, this.place(name, now)])
          .filter(([, place]) => place)
          .map(([name, place]) => [Math.hypot(place.x - x, place.y - y), name])
          .sort((a, b) => a[0] - b[0])[0];
        if (near && near[0] * this.shown.scale < 24 * this.ratio) this.select(near[1]);
      }
      from = null;
    });
    canvas.addEventListener("dblclick", () => (this.view = null));
    canvas.addEventListener("keydown", (event) => {
      const view = this.view ?? { ...this.shown }, step = (40 * this.ratio) / view.scale;
      const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
      if (moves[event.key]) this.view = { ...view, x: view.x + moves[event.key][0], y: view.y + moves[event.key][1] };
      else if (event.key === "+") zoom(1.25, view.x, view.y);
      else if (event.key === "-") zoom(0.8, view.x, view.y);
      else if (event.key === "0") this.view = null;
      else return;
      event.preventDefault();
    });
  }
}
