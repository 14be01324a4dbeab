// What came of an act, robot by robot: seen by what the robots tell afterwards.

const KEPT = 6;
const PATIENCE_MS = 20000;

export class Outcomes {
  constructor(list, store) {
    Object.assign(this, { list, store });
    this.acts = [];
    this.shown = "";
  }

  // `seen(robot)`: whether the robot tells that it is so.
  watch(what, robots, seen) {
    this.acts.unshift({ what, robots, seen, since: performance.now(), done: new Set(), refused: new Map() });
    this.acts.length = Math.min(this.acts.length, KEPT);
  }

  refused(robot, why) {
    this.acts[0]?.refused.set(robot, why);
  }

  draw() {
    const lines = this.acts.map((act) => {
      const waits = performance.now() < act.since + PATIENCE_MS;
      for (const robot of act.robots) if (waits && act.seen(robot)) act.done.add(robot);
      const open = act.robots.filter((robot) => !act.done.has(robot) && !act.refused.has(robot));
      const parts = [`${act.done.size} of ${act.robots.length}${act.done.size && act.done.size <= 8 ? ` (${[...act.done].join(" ")})` : ""}`, ...[...act.refused].map(([robot, why]) => `${robot}: ${why}`)];
      if (open.length) parts.push(`${waits ? "waiting for" : "nothing heard of"} ${open.slice(0, 8).join(" ")}${open.length > 8 ? ` and ${open.length - 8} more` : ""}`);
      return `${act.what}: ${parts.join("; ")}`;
    });
    const shown = lines.join("\n");
    if (shown === this.shown) return;
    this.shown = shown;
    this.list.replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), { textContent: line })));
  }
}
