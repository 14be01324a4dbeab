// How things on the map look: links, robots, ellipses. A pen has the canvas, the pixels of a metre and the theme.

import { theme } from "./theme.js";

const BODY = 0.055; // half a Balboa's width, m
const HEIGHT = 0.1; // of its upper end above the axle, m
const LEDS = { red: "#ff3b30", yellow: "#ffcc00", green: "#34c759" };
const STATES = { up: "--good", slow: "--fair", suspect: "--warn", connecting: "--warn", down: "--bad" };

export class Pen {
  constructor(context, ratio, view, width, height) {
    this.c = context;
    this.ratio = ratio;
    this.scale = view.scale;
    this.at = (x, y) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
    context.font = `${12 * ratio}px system-ui, sans-serif`;
  }

  grid(view, width, height) {
    const { c, ratio, scale } = this;
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
    const step = steps.find((each) => each * scale >= 60 * ratio) ?? 1000;
    c.strokeStyle = theme.colour("--line");
    c.fillStyle = theme.colour("--faint");
    c.lineWidth = 1;
    c.beginPath();
    const left = view.x - width / 2 / scale, bottom = view.y - height / 2 / scale;
    for (let x = Math.ceil(left / step) * step; x < left + width / scale; x += step) {
      const px = Math.round(this.at(x, 0)[0]) + 0.5;
      c.moveTo(px, 0);
      c.lineTo(px, height);
      c.fillText(`${+x.toFixed(2)}${Math.abs(x) < step / 2 ? " m" : ""}`, px + 3, height - 4 * ratio);
    }
    for (let y = Math.ceil(bottom / step) * step; y < bottom + height / scale; y += step) {
      const py = Math.round(this.at(0, y)[1]) + 0.5;
      c.moveTo(0, py);
      c.lineTo(width, py);
      c.fillText(`${+y.toFixed(2)}`, 3, py - 3);
    }
    c.stroke();
  }

  anchor({ name, x, y }) {
    const [px, py] = this.at(x, y), size = 6 * this.ratio, { c } = this;
    c.fillStyle = theme.colour("--faint");
    c.beginPath();
    c.moveTo(px, py - size);
    c.lineTo(px + size, py + size);
    c.lineTo(px - size, py + size);
    c.fill();
    c.fillText(name, px + size + 2, py + size);
  }

  // Where the target really is.
  target({ name, x, y }) {
    const [px, py] = this.at(x, y), { c, ratio } = this;
    c.strokeStyle = c.fillStyle = theme.colour("--ink");
    c.lineWidth = 1.5 * ratio;
    for (const radius of [4, 9]) {
      c.beginPath();
      c.arc(px, py, radius * ratio, 0, 7);
      c.stroke();
    }
    c.fillText(name, px + 12 * ratio, py + 16 * ratio);
  }

  // A robot's estimate of the target.
  cross({ x, y, colour }) {
    const [px, py] = this.at(x, y), size = 5 * this.ratio, { c } = this;
    c.strokeStyle = colour;
    c.lineWidth = 2 * this.ratio;
    c.beginPath();
    c.moveTo(px - size, py - size);
    c.lineTo(px + size, py + size);
    c.moveTo(px - size, py + size);
    c.lineTo(px + size, py - size);
    c.stroke();
  }

  trail(places, colour) {
    const { c } = this;
    c.strokeStyle = colour;
    c.globalAlpha = 0.35;
    c.lineWidth = 1.5 * this.ratio;
    c.beginPath();
    places.forEach(([x, y], index) => (index ? c.lineTo(...this.at(x, y)) : c.moveTo(...this.at(x, y))));
    c.stroke();
    c.globalAlpha = 1;
  }

  // Coloured by state and quality, thicker with traffic; broken where nothing goes through.
  link([ax, ay], [bx, by], { look, width }) {
    const { c, ratio } = this;
    c.strokeStyle = theme.colour(STATES[look] ?? "--faint");
    c.lineWidth = ratio * width;
    c.setLineDash(look === "up" || look === "slow" ? [] : [6 * ratio, 5 * ratio]);
    c.beginPath();
    c.moveTo(ax, ay);
    c.lineTo(bx, by);
    c.stroke();
    c.setLineDash([]);
  }

  // Of a crowd: thin lines, those of a colour at once.
  crowd(links) {
    const { c } = this, lines = new Map();
    for (const { ends: [from, to], look } of links) {
      const colour = STATES[look] ?? "--faint";
      if (!lines.has(colour)) lines.set(colour, new Path2D());
      lines.get(colour).moveTo(...from);
      lines.get(colour).lineTo(...to);
    }
    c.lineWidth = this.ratio;
    for (const [colour, path] of lines) {
      c.globalAlpha = colour === "--good" ? 0.35 : 1;
      c.strokeStyle = theme.colour(colour);
      c.stroke(path);
    }
    c.globalAlpha = 1;
  }

  message([x, y]) {
    const { c } = this;
    c.fillStyle = theme.colour("--accent");
    c.beginPath();
    c.arc(x, y, 4 * this.ratio, 0, 7);
    c.fill();
  }

  // Twice the standard deviation in each direction.
  ellipse({ x, y, xx, xy, yy, colour }) {
    const middle = (xx + yy) / 2, rest = Math.hypot((xx - yy) / 2, xy), { c } = this;
    const [px, py] = this.at(x, y), angle = Math.atan2(2 * xy, xx - yy) / 2;
    const [long, short] = [middle + rest, middle - rest].map((each) => 2 * Math.sqrt(Math.max(0, each)) * this.scale);
    if (!(long < 1e5)) return;
    c.strokeStyle = colour;
    c.globalAlpha = 0.6;
    c.lineWidth = this.ratio;
    c.beginPath();
    c.ellipse(px, py, long, short, -angle, 0, 7);
    c.stroke();
    c.globalAlpha = 1;
  }

  // From above: the wheels' axle, the body that leans ahead or back, where it looks, its LEDs, its name.
  robot({ name, at, heading, tilt, colour, leds, gone, fault, selected, named }) {
    const { c, ratio } = this, size = bodySize(this.scale, ratio);
    c.save();
    c.translate(...at);
    c.globalAlpha = gone ? 0.3 : 1;
    if (selected || fault) {
      c.strokeStyle = theme.colour(selected ? "--accent" : "--bad");
      c.lineWidth = (selected ? 3 : 2) * ratio;
      c.beginPath();
      c.arc(0, 0, size * 1.6, 0, 7);
      c.stroke();
    }
    c.save();
    if (heading !== null) c.rotate(-heading);
    const lean = Math.sin(tilt) * size * (HEIGHT / BODY), back = -0.45 * size + Math.min(0, lean), front = 0.45 * size + Math.max(0, lean);
    c.fillStyle = colour;
    c.beginPath();
    c.roundRect(back, -size, front - back, 2 * size, 3 * ratio);
    c.fill();
    if (heading !== null) {
      c.strokeStyle = theme.colour("--ink");
      c.lineWidth = 2 * ratio;
      c.beginPath();
      c.moveTo(0, 0);
      c.lineTo(size * 1.5, 0);
      c.stroke();
    }
    c.restore();
    Object.entries(LEDS).forEach(([led, shine], index) => {
      c.fillStyle = leds[led] ? shine : theme.colour("--line");
      c.beginPath();
      c.arc((index - 1) * size * 0.62, -size * 1.45, size * 0.26, 0, 7);
      c.fill();
    });
    if (named || selected) {
      c.fillStyle = theme.colour("--ink");
      c.fillText(name, size * 1.2, size * 1.4);
    }
    c.restore();
  }
}

// Half a robot's width, and how far what turns and leans with it reaches, in pixels.
function bodySize(scale, ratio) {
  return Math.max(8 * ratio, BODY * scale);
}

export function reach(scale, ratio) {
  return (bodySize(scale, ratio) * HEIGHT) / BODY;
}
