// What has happened, the newest first.

import { write } from "../numbers.js";

export class Events {
  constructor(panel) {
    this.list = panel.querySelector("ol");
    this.empty = panel.querySelector(".empty");
    this.last = 0;
    for (const button of panel.querySelectorAll("[data-level]")) {
      button.addEventListener("click", () => {
        this.list.dataset.level = button.dataset.level;
        for (const each of panel.querySelectorAll("[data-level]")) if (each !== this.list) each.ariaPressed = String(each === button);
      });
    }
  }

  draw(events) {
    for (const event of events.filter((each) => each.number > this.last)) {
      const line = document.createElement("li"), time = document.createElement("time"), mark = document.createElement("i"), what = document.createElement("span"), who = document.createElement("b");
      time.textContent = Math.max(0, event.t).toFixed(1);
      line.className = { warning: "warn", error: "bad" }[event.level] ?? "";
      mark.textContent = { warning: "▲", error: "◆" }[event.level] ?? "·";
      mark.ariaLabel = event.level;
      who.textContent = event.robot;
      what.append(who, ` ${event.text}`);
      line.append(time, mark, what);
      this.list.prepend(line);
      this.last = event.number;
    }
    this.empty.hidden = this.list.children.length > 0;
    write(this.empty, "Nothing yet: links, faults, services and the outcome of acts are told here");
    while (this.list.children.length > 200) this.list.lastChild.remove();
  }

  clear() {
    this.last = 0;
    this.list.replaceChildren();
  }
}

