// What can be done to the swarm, where the server allows it: stop it, lay hands on one robot, set an app's parameters.

const CUT_S = 60;

const button = (text, act) => {
  const element = document.createElement("button");
  element.type = "button";
  element.textContent = text;
  element.addEventListener("click", act);
  return element;
};

export class Hands {
  constructor(header, panel, store, ask) {
    this.stop = header.querySelector("#stop");
    this.arm = header.querySelector("#arm");
    this.said = header.querySelector("#said");
    this.panel = panel;
    this.store = store;
    this.shown = "";
    this.act = (act) => ask({ do: act });
    this.stop.addEventListener("click", () => this.act({ act: "stop" }));
    this.arm.addEventListener("click", () => this.act({ act: "arm" }));
  }

  tell(text, refused) {
    this.said.textContent = text;
    this.said.className = refused ? "bad" : "";
  }

  draw(robot) {
    const control = Boolean(this.store.swarm?.control), names = this.store.names;
    const stopped = names.filter((name) => this.store.get(name, "mesh/stopped")?.stopped);
    this.stop.hidden = !control;
    this.arm.hidden = !control || !stopped.length;
    const text = stopped.length ? `STOPPED ${stopped.length}/${names.length}` : "STOP";
    if (this.stop.textContent !== text) this.stop.textContent = text;
    this.panel.hidden = !control || !robot;
    if (this.panel.hidden) return;
    const peers = (this.store.get(robot, "mesh/links")?.links ?? []).map((each) => each.peer);
    const services = Object.keys(this.store.services[robot] ?? {}).sort();
    const parameters = [...(this.store.robots.get(robot) ?? [])].flatMap(([topic, value]) => {
      const found = /^app\/([^/]+)\/parameters$/.exec(topic);
      return found ? Object.entries(value.parameters ?? {}).filter(([, each]) => each.live).map(([name, each]) => [found[1], name, each.value]) : [];
    });
    const shown = JSON.stringify([robot, peers, services, parameters]);
    if (shown === this.shown || this.panel.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
    this.shown = shown;
    this.panel.replaceChildren(
      ...["A", "B", "C"].map((each) => button(`press ${each}`, () => this.act({ act: "press", robot, button: each }))),
      button("push", () => this.act({ act: "push", robot, impulse: 0.1 })),
      ...["front", "back"].map((side) => button(`lay on ${side}`, () => this.act({ act: "lay", robot, side }))),
      ...peers.flatMap((peer) => [
        button(`cut ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: CUT_S })),
        button(`mend ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: 0 })),
      ]),
      ...services.map((service) => button(`kill ${service}`, () => this.act({ act: "kill", robot, service }))),
      ...parameters.map(([app, name, value]) => this.parameter(app, name, value)),
    );
  }

  // Of all robots: an algorithm's parameters differ between robots by intention only, and then by `swarm param`.
  parameter(app, name, value) {
    const label = document.createElement("label"), input = document.createElement("input");
    input.value = String(value);
    input.addEventListener("change", () => {
      const typed = typeof value === "number" ? Number(input.value) : typeof value === "boolean" ? input.value === "true" : input.value;
      this.act({ act: "set", app, name, value: typed });
      input.blur();
    });
    label.append(`${app} ${name}`, input);
    return label;
  }
}
