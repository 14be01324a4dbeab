// Goes through a recording: the page asks for the instants that it wants to show.

const ASK_MS = 100;
const IDLE_MS = 1000; // so that a lost server is noticed while paused

export class Player {
  constructor(section, store, ask) {
    this.section = section;
    this.store = store;
    this.ask = ask;
    this.button = section.querySelector("#play");
    this.slider = section.querySelector("#time");
    this.output = section.querySelector("output");
    this.speed = section.querySelector("select");
    this.playing = true;
    this.asked = -Infinity;
    this.begin();
    this.button.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => {
      this.playing = false;
      this.wanted = Number(this.slider.value);
    });
  }

  // After a new connection: nothing is shown yet.
  begin() {
    this.since = null;
    this.waiting = false;
    this.drawn = performance.now();
  }

  toggle() {
    const { first, last } = this.store.swarm.recording;
    if (!this.playing && this.wanted >= last) this.wanted = first;
    this.playing = !this.playing;
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
    const recording = this.store.swarm?.recording;
    this.section.hidden = !recording;
    if (!recording) return;
    if (this.wanted === undefined) {
      [this.slider.min, this.slider.max] = [recording.first, recording.last];
      this.wanted = recording.first;
      this.section.querySelector("span").textContent = recording.damage.join("; ");
    }
    if (this.playing) this.wanted = Math.min(recording.last, this.wanted + (Number(this.speed.value) * (now - this.drawn)) / 1000);
    if (this.wanted >= recording.last) this.playing = false;
    this.drawn = now;
    const label = this.playing ? "❚❚" : "▶";
    if (this.button.textContent !== label) this.button.textContent = label;
    if (document.activeElement !== this.slider || this.playing) this.slider.value = this.wanted;
    this.output.textContent = `${this.wanted.toFixed(2)} s of ${recording.last.toFixed(1)} s`;
    const due = this.wanted !== this.since ? ASK_MS : IDLE_MS;
    if (!this.waiting && now >= this.asked + due && this.ask({ seek: { since: this.since, t: this.wanted } }) !== false) {
      this.waiting = true;
      this.asked = now;
    }
  }
}
