// Goes through a recording: the page asks for the instants that it wants to show.

import { clock, write } from "../numbers.js";

const ASK_MS = 100;
const IDLE_MS = 1000; // so that a lost server is noticed while paused

export class Player {
  constructor(section, store, ask, strip) {
    Object.assign(this, { section, store, ask, strip });
    this.button = section.querySelector("#play");
    this.slider = section.querySelector("#time");
    this.speed = section.querySelector("#speed select");
    this.playing = true;
    this.asked = -Infinity;
    this.begin();
  }

  // After a new connection: nothing is shown yet.
  begin() {
    this.since = null;
    this.waiting = false;
    this.drawn = performance.now();
  }

  // Another recording: from its beginning.
  restart() {
    this.begin();
    this.wanted = undefined;
  }

  toggle() {
    const { first, last } = this.store.swarm.recording;
    if (!this.playing && this.wanted >= last) this.wanted = first;
    this.playing = !this.playing;
  }

  // To an instant, which is shown with the next answer.
  go(t) {
    const { first, last } = this.store.swarm.recording;
    this.playing = false;
    this.wanted = Math.min(last, Math.max(first, t));
  }

  // Show an instant, and say when it is there.
  seek(t) {
    this.playing = false;
    this.wanted = t;
    return new Promise((resolve) => {
      this.arrived = resolve;
      this.ask({ seek: { since: this.since, t } });
    });
  }

  // After a step has been taken.
  taken() {
    this.arrived?.();
    this.arrived = null;
  }

  // Returns whether what is shown must be thrown away before a step is taken.
  answered(step) {
    this.waiting = false;
    this.since = step.t;
    return step.fresh;
  }

  draw(now) {
    const { first, last, damage } = this.store.swarm.recording;
    if (this.wanted === undefined) {
      this.wanted = first;
      write(this.section.querySelector(".damage"), damage.join("; "));
    }
    if (this.playing) this.wanted = Math.min(last, this.wanted + (Number(this.speed.value) * (now - this.drawn)) / 1000);
    if (this.wanted >= last) this.playing = false;
    this.drawn = now;
    write(this.button, this.playing ? "❚❚" : "▶");
    this.strip.tell(this.wanted, `of ${clock(last)}`);
    if (document.activeElement !== this.slider || this.playing) this.slider.value = this.wanted;
    const due = this.wanted !== this.since ? ASK_MS : IDLE_MS;
    if (!this.waiting && now >= this.asked + due && this.ask({ seek: { since: this.since, t: this.wanted } }) !== false) {
      this.waiting = true;
      this.asked = now;
    }
  }
}
