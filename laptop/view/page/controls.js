// What can be done to the swarm, where the server allows it: stop it, start and stop apps, lay hands on one robot, set
// an app's parameters.

const CUT_S = 60;

const button = (text, act) => {
  const element = document.createElement("button");
  element.type = "button";
  element.textContent = text;
  element.addEventListener("click", act);
  return element;
};

export class Controls {
  constructor(header, panel, store, ask) {
    this.stop = header.querySelector("#stop");
    this.arm = header.querySelector("#arm");
    this.said = header.querySelector("#said");
    this.panel = panel;
    this.store = store;
    this.shown = "";
    this.ask = ask;
    this.owed = null; // a stop that could not be sent yet
    this.stop.addEventListener("click", () => this.act({ act: "stop" }));
    this.arm.addEventListener("click", () => this.act({ act: "arm" }));
    this.apps = document.querySelector("#apps");
    this.known = "";
    this.apps.addEventListener("submit", (event) => {
      event.preventDefault();
      const { value } = this.apps.elements.app;
      if (value) this.act({ act: "start", app: value });
    });
  }

  // Without a server nothing can be sent. A stop is kept until there is one again: a late stop harms nobody, all else might.
  act(act) {
    if (act.act === "stop" || act.act === "arm") this.owed = null;
    if (this.ask({ do: act })) return;
    if (act.act === "stop") this.owed = act;
    this.tell(this.owed ? "NOT SENT: the server is lost. The stop is sent as soon as it is back; swarm estop does not need it" : "not sent: the server is lost", true);
  }

  connected() {
    if (this.owed) this.act(this.owed);
  }

  tell(text, refused) {
    this.said.textContent = text;
    this.said.className = refused ? "bad" : "";
  }

  // A robot may find a value out of bounds.
  take(step) {
    for (const [name, topics] of Object.entries(step.robots ?? {})) {
      for (const [topic, value] of Object.entries(topics)) {
        if (topic.endsWith("/parameters_set") && value?.problem) this.tell(`${name}: ${value.problem}`, true);
      }
    }
  }

  // What the server lets be done to these robots.
  can(act) {
    return this.store.swarm?.acts?.includes(act) ?? false;
  }

  draw(robot) {
    const names = this.store.names;
    const stopped = names.filter((name) => this.store.get(name, "mesh/stopped")?.stopped);
    this.stop.hidden = !this.can("stop");
    this.arm.hidden = !this.can("arm") || !stopped.length;
    const text = stopped.length ? `STOPPED ${stopped.length}/${names.length}` : "STOP";
    if (this.stop.textContent !== text) this.stop.textContent = text;
    this.drawApps();
    this.panel.hidden = !robot || !this.can("set");
    if (this.panel.hidden) return;
    const parameters = this.parameters(robot);
    const peers = (this.store.get(robot, "mesh/links")?.links ?? []).map((each) => each.peer);
    const services = Object.keys(this.store.services[robot] ?? {}).sort();
    const apps = this.running([robot]);
    const shown = JSON.stringify([robot, peers, services, apps, parameters]);
    if (shown === this.shown || this.panel.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
    this.shown = shown;
    this.panel.replaceChildren(...this.laid(robot, peers, apps, services), ...parameters.map(([app, name, value]) => this.parameter(app, name, value)));
  }

  // What can be done to a robot. Real ones have buttons of their own, and hands of people.
  laid(robot, peers, apps, services) {
    const of = (act, each, buttons) => (this.can(act) ? each.flatMap(buttons) : []);
    return [
      ...of("press", ["A", "B", "C"], (each) => button(`press ${each}`, () => this.act({ act: "press", robot, button: each }))),
      ...of("push", [0.1], (impulse) => button("push", () => this.act({ act: "push", robot, impulse }))),
      ...of("lay", ["front", "back"], (side) => button(`lay on ${side}`, () => this.act({ act: "lay", robot, side }))),
      ...of("cut", peers, (peer) => [
        button(`cut ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: CUT_S })),
        button(`mend ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: 0 })),
      ]),
      ...of("start", apps, ([app, runs]) => this.app(app, runs, robot)),
      ...of("kill", services, (service) => button(`kill ${service}`, () => this.act({ act: "kill", robot, service }))),
    ];
  }

  // Parameters of a robot's apps that may change while these run: [[app, name, value], ...].
  parameters(robot) {
    return [...(this.store.robots.get(robot) ?? [])].flatMap(([topic, value]) => {
      const found = /^app\/([^/]+)\/parameters$/.exec(topic);
      return found ? Object.entries(value?.parameters ?? {}).filter(([, each]) => each?.live).map(([name, each]) => [found[1], name, each.value]) : [];
    });
  }

  // Apps that have been on these robots, and whether one of them runs: [[name, runs], ...].
  running(robots) {
    const found = new Map();
    for (const robot of robots) {
      for (const [service, there] of Object.entries(this.store.services[robot] ?? {})) {
        if (service.startsWith("app/")) found.set(service.slice(4), there || (found.get(service.slice(4)) ?? false));
      }
      for (const app of this.store.get(robot, "view/apps")?.apps ?? []) if (!found.has(app)) found.set(app, false);
    }
    return [...found].sort();
  }

  app(app, runs, robot) {
    return button(`${runs ? "stop" : "start"} ${app}${robot ? "" : " on all"}`, () => this.act({ act: runs ? "end" : "start", app, robot }));
  }

  drawApps() {
    this.apps.hidden = !this.can("start");
    if (this.apps.hidden) return;
    const apps = this.running(this.store.names), known = JSON.stringify(apps);
    if (known === this.known) return;
    this.known = known;
    this.apps.querySelector("span").replaceChildren(...apps.map(([app, runs]) => this.app(app, runs)));
  }

  // Of all robots: an algorithm's parameters differ between robots by intention only, and then by `swarm app param`.
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
