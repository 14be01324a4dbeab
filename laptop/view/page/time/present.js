// The time of a running swarm: the page follows it, or looks back into the last two minutes.

import { write } from "../numbers.js";

const ASK_MS = 150;

export class Present {
  constructor(section, store, ask, strip, again) {
    Object.assign(this, { section, store, ask, strip, again });
    this.button = section.querySelector("#play");
    this.follow = section.querySelector("#follow");
    this.slider = section.querySelector("#time");
    this.wanted = null; // the instant that is looked at; null: the present
    this.asked = null;
    this.at = -Infinity;
    this.follow.addEventListener("click", () => this.go(null));
  }

  // To an instant; null: back to the present.
  go(t) {
    const before = this.wanted;
    this.wanted = t === null || t >= this.strip.range[1] ? null : Math.max(this.strip.range[0], t);
    this.store.looking = this.wanted !== null;
    if (this.wanted === null && before !== null) this.again(); // the server tells all that is now
  }

  toggle() {
    this.go(this.wanted === null ? this.store.t : null);
  }

  draw(now) {
    const looks = this.wanted !== null;
    this.follow.hidden = !looks;
    write(this.button, looks ? "▶" : "❚❚");
    this.strip.tell(looks ? this.wanted : this.store.t, looks ? "looks back" : this.store.live ? "follows" : "the end");
    if (!looks || document.activeElement !== this.slider) this.slider.value = looks ? this.wanted : this.strip.range[1];
    if (looks && this.wanted !== this.asked && now > this.at + ASK_MS && this.ask({ look: { t: this.wanted } })) [this.asked, this.at] = [this.wanted, now];
    if (!looks) this.asked = null;
  }
}
