// What has happened, the newest first. What several robots tell at about the same time is one line.

import { some, write } from "../numbers.js";

const TOGETHER_S = 1;
const OPEN = 6; // lines that may still grow: robots' news mix
const KEPT = 200; // lines

export class Events {
  constructor(panel, store) {
    this.store = store;
    this.list = panel.querySelector("ol");
    this.empty = panel.querySelector(".empty");
    this.clear();
    for (const button of panel.querySelectorAll("[data-level]")) {
      button.addEventListener("click", () => {
        this.list.dataset.level = button.dataset.level;
        for (const each of panel.querySelectorAll("[data-level]")) if (each !== this.list) each.ariaPressed = String(each === button);
      });
    }
  }

  draw(events) {
    for (const event of events) {
      if (event.number <= this.last) continue;
      this.last = event.number;
      const { who, what, whom } = read(event, this.store.order), key = `${event.level} ${what}`;
      let line = this.lines.slice(0, OPEN).find((each) => each.key === key && event.t <= each.began + TOGETHER_S);
      line ??= { key, what, began: event.t, level: event.level, who: new Set(), whom: new Set(), ...element(event.level) };
      if (this.lines[0] !== line) {
        this.lines = [line, ...this.lines.filter((each) => each !== line)];
        this.list.prepend(line.element);
      }
      line.t = event.t;
      line.who.add(who);
      for (const each of whom) line.whom.add(each);
      line.time.textContent = Math.max(0, event.t).toFixed(1);
      const [robots, text] = this.words(line);
      [line.robots.textContent, line.text.textContent] = [robots, ` ${text}`];
    }
    this.empty.hidden = this.lines.length > 0;
    write(this.empty, "Nothing yet: links, faults, services and the outcome of acts are told here");
    for (const { element } of this.lines.splice(KEPT)) element.remove();
  }

  // {text, level, t} of the newest one; null where nothing has happened.
  get newest() {
    const line = this.lines[0];
    return line ? { text: this.words(line).join(" "), level: line.level, t: line.t } : null;
  }

  // Whom a line is about, and what it says of them.
  words({ what, who, whom }) {
    const named = (names) => (names.size > 1 && names.size === this.store.names.length ? "all" : some([...names].sort((a, b) => this.store.order.get(a) - this.store.order.get(b) || (a < b ? -1 : 1))));
    if (what.startsWith("link ") && who.size > 2) return [`${who.size} links`, what.slice(5)];
    const [robots, others] = [named(who), named(whom)];
    return [robots, whom.size ? `${what} for ${whom.size > 1 && [...whom].every((each) => who.has(each)) ? "each other" : others}` : what];
  }

  count(level) {
    return this.lines.filter((each) => each.level === level).length;
  }

  clear() {
    this.last = 0;
    this.lines = [];
    this.list.replaceChildren();
  }
}

// Both ends of a link tell of it; those that wait do so for others.
function read({ robot, text }, order) {
  const [, peer, how] = /^link to (\S+) (.*)$/.exec(text) ?? [];
  if (peer) return { who: order.get(robot) < order.get(peer) ? `${robot}–${peer}` : `${peer}–${robot}`, what: `link ${how}`, whom: [] };
  const [, before, others] = /^app\/(\S+ waiting) for (.*)$/.exec(text) ?? [];
  if (before && !/:| and /.test(others)) return { who: robot, what: before, whom: others.split(" ") };
  return { who: robot, what: text.replace(/^app\//, "").replace(` (by ${robot})`, ""), whom: [] };
}

function element(level) {
  const [line, time, mark, what, robots, text] = ["li", "time", "i", "span", "b", "span"].map((each) => document.createElement(each));
  line.className = { warning: "warn", error: "bad" }[level] ?? "";
  mark.textContent = { warning: "▲", error: "◆" }[level] ?? "·";
  mark.ariaLabel = level;
  what.append(robots, text);
  line.append(time, mark, what);
  return { element: line, time, robots, text };
}
