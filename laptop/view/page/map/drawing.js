// How things on the map look: links, robots, ellipses. A pen has the canvas, the pixels of a metre and the theme.

import { SIGMAS } from "../numbers.js";
import { FONT, theme } from "../theme.js";

const BODY = 0.055; // half a Balboa's width, m
const HEIGHT = 0.1; // of its upper end above the axle, m
const HEAD = 38; // px of the panel's title, where no number of the grid stands
const RIM = 1.75; // times half a robot's width
const LEDS = { red: "#ff3b30", yellow: "#ffcc00", green: "#34c759" };
const STATES = { up: "--link", slow: "--warnmark", suspect: "--warn", connecting: "--warn", down: "--bad" };

const widths = new Map();
const labels = new Map(); // pictures of names, by what they say

export class Pen {
  constructor(context, ratio, view, width, height) {
    this.c = context;
    this.ratio = ratio;
    this.scale = view.scale;
    this.at = (x, y) => [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
    this.plain = `${11 * ratio}px ${FONT}`;
    this.bold = `600 ${12 * ratio}px ${FONT}`;
  }

  grid(view, width, height) {
    const { c, ratio, scale } = this;
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
    const step = steps.find((each) => each * scale >= 60 * ratio) ?? 1000;
    c.font = this.plain;
    c.strokeStyle = theme.colour("--grid");
    c.fillStyle = theme.colour("--muted");
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
      if (py > HEAD * ratio) c.fillText(`${+y.toFixed(2)}`, 3, py - 3);
    }
    c.stroke();
  }

  anchor({ x, y }) {
    const [px, py] = this.at(x, y), size = 6 * this.ratio, { c } = this;
    c.strokeStyle = theme.colour("--edge");
    c.lineWidth = 1.3 * this.ratio;
    c.beginPath();
    c.moveTo(px, py - size);
    c.lineTo(px + size, py + size);
    c.lineTo(px - size, py + size);
    c.closePath();
    c.stroke();

  }

  // Where the target really is.
  target({ x, y }) {
    const [px, py] = this.at(x, y), { c, ratio } = this;
    c.strokeStyle = c.fillStyle = theme.colour("--text");
    c.lineWidth = 1.5 * ratio;
    for (const radius of [4, 9]) {
      c.beginPath();
      c.arc(px, py, radius * ratio, 0, 7);
      c.stroke();
    }
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

  // What of a line between two robots is outside their rims; null where they touch.
  outside([ax, ay], [bx, by]) {
    const far = Math.hypot(bx - ax, by - ay), rim = rimSize(this.scale, this.ratio) + this.ratio;
    if (far < 2 * rim + 2 * this.ratio) return null;
    const [x, y] = [((bx - ax) * rim) / far, ((by - ay) * rim) / far];
    return [[ax + x, ay + y], [bx - x, by - y]];
  }

  // Within rims there is only what is below links: none of another pair goes through a robot.
  free(places, below) {
    const { c } = this, rim = rimSize(this.scale, this.ratio);
    c.fillStyle = below;
    c.beginPath();
    for (const { x, y } of places) {
      const [px, py] = this.at(x, y);
      c.moveTo(px + rim, py);
      c.arc(px, py, rim, 0, 7);
    }
    c.fill();
  }

  // Grey where all is well, coloured by state and quality where not, thicker with traffic; broken and crossed where nothing
  // goes through.
  link([[ax, ay], [bx, by]], { look, width }) {
    const { c, ratio } = this;
    c.strokeStyle = theme.colour(STATES[look] ?? "--line");
    c.lineWidth = ratio * width;
    c.setLineDash(look === "up" || look === "slow" ? [] : [6 * ratio, 5 * ratio]);
    c.beginPath();
    c.moveTo(ax, ay);
    c.lineTo(bx, by);
    c.stroke();
    c.setLineDash([]);
    if (look !== "down") return;
    const [x, y, size] = [(ax + bx) / 2, (ay + by) / 2, Math.min(5 * ratio, Math.hypot(bx - ax, by - ay) / 2 - 2 * ratio)];
    if (size < ratio) return;
    c.lineWidth = 2.2 * ratio;
    c.beginPath();
    c.moveTo(x - size, y - size);
    c.lineTo(x + size, y + size);
    c.moveTo(x - size, y + size);
    c.lineTo(x + size, y - size);
    c.stroke();
  }

  // Where a robot is to go, and the way there.
  goal([x, y], from, { colour, next, strong }) {
    const { c, ratio } = this;
    c.strokeStyle = c.fillStyle = strong ? theme.colour("--text") : colour;
    c.lineWidth = 1.3 * ratio;
    c.beginPath();
    c.arc(x, y, (strong ? 8 : 5) * ratio, 0, 7);
    c.stroke();
    if (strong || next) {
      c.beginPath();
      c.arc(x, y, (strong ? 2.5 : 1.5) * ratio, 0, 7);
      c.fill();
    }
    if (!from || !next) return;
    c.globalAlpha = strong ? 1 : 0.6;
    c.setLineDash([3 * ratio, 4 * ratio]);
    c.beginPath();
    c.moveTo(...from);
    c.lineTo(x, y);
    c.stroke();
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  // A robot of the run beside.
  beside([x, y], colour) {
    const { c, ratio } = this;
    c.strokeStyle = colour;
    c.lineWidth = 1.6 * ratio;
    c.setLineDash([3 * ratio, 3 * ratio]);
    c.beginPath();
    c.arc(x, y, bodySize(this.scale, ratio), 0, 7);
    c.stroke();
    c.setLineDash([]);
  }

  // A name and its value, readable on whatever is below. Drawn once: text with a halo costs as much as all else on the map.
  label([left, top, right, bottom], name, value, { faint }) {
    const { c, ratio } = this, known = [name, value, faint, ratio, theme.version].join(" "), pad = Math.ceil(2 * ratio);
    if (!(right - left > 0) || !(Math.abs(left) < 1e5)) return; // far outside, or nowhere
    if (!labels.has(known)) {
      if (labels.size > 500) labels.clear();
      const picture = document.createElement("canvas");
      [picture.width, picture.height] = [Math.ceil(right - left) + 2 * pad, Math.ceil(bottom - top) + 2 * pad];
      this.write(picture.getContext("2d"), pad, picture.height / 2, name, value, faint);
      labels.set(known, picture);
    }
    c.drawImage(labels.get(known), Math.round(left) - pad, Math.round(top) - pad);
  }

  write(c, left, y, name, value, faint) {
    const texts = [[name, this.bold, "--text", left], [value, this.plain, "--muted", name ? left + this.wide(name, this.bold) + 4 * this.ratio : left]];
    c.textBaseline = "middle";
    c.lineJoin = "round";
    c.lineWidth = 3.5 * this.ratio;
    c.strokeStyle = theme.colour("--sunk");
    c.globalAlpha = faint ? 0.5 : 1;
    for (const [text, font, colour, x] of texts) {
      c.font = font;
      c.fillStyle = theme.colour(colour);
      c.strokeText(text, x, y);
      c.fillText(text, x, y);
    }
  }

  // Pixels of a text; asked for once.
  wide(text, font) {
    const known = `${font} ${text}`;
    if (!widths.has(known)) {
      if (widths.size > 2000) widths.clear();
      this.c.font = font;
      widths.set(known, this.c.measureText(text).width);
    }
    return widths.get(known);
  }

  // Of a crowd: thin lines, those of a colour at once.
  crowd(links) {
    const { c } = this, lines = new Map();
    for (const { ends, look } of links) {
      if (!ends) continue;
      const [from, to] = ends;
      const colour = STATES[look] ?? "--muted";
      if (!lines.has(colour)) lines.set(colour, new Path2D());
      lines.get(colour).moveTo(...from);
      lines.get(colour).lineTo(...to);
    }
    c.lineWidth = this.ratio;
    for (const [colour, path] of lines) {
      c.globalAlpha = colour === "--link" ? 0.5 : 1;
      c.strokeStyle = theme.colour(colour);
      c.stroke(path);
    }
    c.globalAlpha = 1;
  }

  message([x, y]) {
    const { c } = this;
    c.fillStyle = theme.colour("--message");
    c.beginPath();
    c.arc(x, y, 3 * this.ratio, 0, 7);
    c.fill();
  }

  // What holds a place with 95 %.
  ellipse({ x, y, xx, xy, yy, colour }) {
    const middle = (xx + yy) / 2, rest = Math.hypot((xx - yy) / 2, xy), { c } = this;
    const [px, py] = this.at(x, y), angle = Math.atan2(2 * xy, xx - yy) / 2;
    const [long, short] = [middle + rest, middle - rest].map((each) => SIGMAS * Math.sqrt(Math.max(0, each)) * this.scale);
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
  robot({ at, heading, tilt, colour, leds, gone, fault, waits, selected }) {
    const { c, ratio } = this, size = bodySize(this.scale, ratio);
    c.save();
    c.translate(...at);
    c.globalAlpha = gone ? 0.3 : 1;
    if (selected || fault || waits) {
      c.strokeStyle = theme.colour(fault ? "--bad" : selected ? "--text" : "--warnmark");
      c.lineWidth = (selected ? 2.4 : 1.8) * ratio;
      if (waits && !fault && !selected) c.setLineDash([4 * ratio, 3 * ratio]);
      c.beginPath();
      c.arc(0, 0, size * RIM - ratio, 0, 7);
      c.stroke();
      c.setLineDash([]);
    }
    c.save();
    if (heading !== null) c.rotate(-heading);
    const lean = Math.sin(tilt) * size * (HEIGHT / BODY), back = -0.45 * size + Math.min(0, lean), front = 0.45 * size + Math.max(0, lean);
    c.fillStyle = colour;
    c.beginPath();
    c.roundRect(back, -size, front - back, 2 * size, 3 * ratio);
    c.fill();
    if (heading !== null) {
      c.strokeStyle = theme.colour("--text");
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
      c.arc((index - 1) * size * 0.55, -size * 1.35, size * 0.22, 0, 7);
      c.fill();
    });
    c.restore();
  }
}

// Around a robot with all that belongs to it: links end there.
export function rimSize(scale, ratio) {
  return RIM * bodySize(scale, ratio);
}

// Half a robot's width, and how far what turns and leans with it reaches, in pixels.
function bodySize(scale, ratio) {
  return Math.max(8 * ratio, BODY * scale);
}

export function reach(scale, ratio) {
  return (bodySize(scale, ratio) * HEIGHT) / BODY;
}
