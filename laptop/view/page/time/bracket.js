// Which part of a recording all charts show: two ends on the strip of time, put by hand or with the arrow keys.

const EDGE = 15; // px, as in the strip
const LEAST = 0.02; // of the recording
const STEP = 0.01;

export class Bracket {
  constructor(track, store, strip) {
    Object.assign(this, { track, store, strip });
    this.kept = null; // [from, to], s; null: all of it
    this.edges = [...track.querySelectorAll(".edge")];
    this.edges.forEach((edge, index) => {
      edge.addEventListener("pointerdown", (event) => edge.setPointerCapture(event.pointerId));
      edge.addEventListener("pointermove", (event) => {
        const { left, width } = track.getBoundingClientRect();
        if (edge.hasPointerCapture(event.pointerId)) this.put(index, (event.clientX - left - EDGE) / (width - 2 * EDGE));
      });
      edge.addEventListener("dblclick", () => (this.kept = null));
      edge.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: -STEP, ArrowDown: -STEP, ArrowRight: STEP, ArrowUp: STEP }[event.key];
        if (!step) return;
        event.preventDefault();
        event.stopPropagation(); // the time stays
        this.put(index, this.shares[index] + step);
      });
    });
  }

  // What charts show, s.
  get range() {
    if (!this.store.swarm?.recording) this.kept = null;
    return this.kept ?? this.strip.range;
  }

  // Where the ends are, as shares of the recording.
  get shares() {
    const [first, last] = this.strip.range;
    return this.range.map((t) => (t - first) / (last - first));
  }

  put(index, share) {
    const [first, last] = this.strip.range, shares = this.shares;
    shares[index] = index ? Math.min(1, Math.max(shares[0] + LEAST, share)) : Math.max(0, Math.min(shares[1] - LEAST, share));
    this.kept = shares[0] <= 0 && shares[1] >= 1 ? null : shares.map((each) => first + each * (last - first));
    this.draw();
  }

  draw() {
    const recording = this.store.swarm?.recording, range = this.range, shares = this.shares, told = JSON.stringify([recording, range]);
    if (told === this.told) return;
    this.told = told;
    this.edges.forEach((edge, index) => {
      edge.hidden = !recording;
      edge.style.left = `calc(${EDGE}px + ${shares[index]} * (100% - ${2 * EDGE}px))`;
      [edge.ariaValueMin, edge.ariaValueMax] = this.strip.range.map((each) => each.toFixed(1));
      [edge.ariaValueNow, edge.ariaValueText] = [range[index].toFixed(1), `${range[index].toFixed(1)} s`];
    });
    this.strip.drawn = -Infinity;
  }
}
