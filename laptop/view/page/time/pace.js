// How fast virtual time passes: pause, and a speed. The server tells what it comes to.

export class Pace {
  constructor(section, store, ask) {
    this.section = section;
    this.store = store;
    this.button = section.querySelector("button");
    this.output = section.querySelector("output");
    this.speed = section.querySelector("select");
    const tell = (paused) => ask({ pace: { speed: this.speed.value === "max" ? null : Number(this.speed.value), paused } });
    this.button.addEventListener("click", () => tell(!this.store.pace.paused));
    this.speed.addEventListener("change", () => tell(this.store.pace.paused));
  }

  draw() {
    const pace = this.store.pace;
    this.section.hidden = !pace;
    if (!pace) return;
    const label = pace.paused ? "▶" : "❚❚", speed = pace.speed === null ? "max" : String(pace.speed);
    if (this.button.textContent !== label) this.button.textContent = label;
    this.button.disabled = this.speed.disabled = !this.store.live;
    if (document.activeElement !== this.speed && this.speed.value !== speed) {
      if (![...this.speed.options].some((each) => each.value === speed)) this.speed.add(new Option(speed, speed), 0);
      this.speed.value = speed;
    }
    const behind = pace.speed !== null && pace.actual < 0.9 * pace.speed && !pace.paused && this.store.live;
    const text = pace.paused || !this.store.live ? "" : `${+pace.actual.toPrecision(2)} s a second${behind ? ", as fast as it computes" : ""}`;
    if (this.output.textContent !== text) this.output.textContent = text;
  }
}
