// What can be done to the swarm, where the server allows it: stop it, stand, rest, lie, start and stop apps, act on
// one robot, set an app's parameters, send a robot to a place. What came of it is told robot by robot.

import { short, write } from "../numbers.js";
import { Outcomes } from "./outcomes.js";

const CUT_S = 60;
const NAMED = 2; // robots that the stop button has room to name; the answer beside it names more
const [PARAMETERS, CHOICES] = [100, 100]; // that are shown
const DRIVE_MS = 120; // a robot stands when it has not been asked again for 0.4 s
const WAYS = [["◀", 0, 1.2, "left"], ["▲", 0.15, 0, "forward"], ["▼", -0.15, 0, "back"], ["▶", 0, -1.2, "right"]]; // m/s, rad/s
const STANDS = { stand: ["balancing"], rest: ["idle"], lie: ["idle"] };

const element = (name, properties) => Object.assign(document.createElement(name), properties);
const button = (text, act, more = {}) => element("button", { type: "button", textContent: text, onclick: act, ...more });

export class Controls {
  constructor(store, ask, focus) {
    Object.assign(this, { store, ask, focus });
    const find = (selector) => document.querySelector(selector);
    [this.stop, this.arm, this.said, this.whole, this.panel, this.sliders, this.apps, this.send] = ["#stop", "#arm", "#said", "#control", "#controls", "#parameters", "#apps", "#send-goal"].map(find);
    this.main = find("main");
    this.outcomes = new Outcomes(find("#outcomes"), store);
    this.shown = this.known = this.slid = "";
    this.stopping = ""; // of a stop: "owed" while it could not be sent, "refused" while the server reaches no robot, "given" until all robots that are there confirm it
    this.confirmed = new Set(); // robots that have said since that they are stopped
    this.number = Infinity; // of the stop, as the server counts those of all pages
    this.speaker = find("#halt [role=status]");
    this.whom = find("#whom");
    this.modes = ["stand", "rest", "lie"].map((mode) => button(mode, () => this.mode(mode), { hidden: true }));
    this.whom.after(...this.modes);
    this.stop.addEventListener("click", () => this.act({ act: "stop" }));
    this.arm.addEventListener("click", () => this.act({ act: "arm", t: this.store.newest })); // the stops that are shown, and none that comes meanwhile
    this.apps.addEventListener("submit", (event) => {
      event.preventDefault();
      const { value } = this.apps.elements.app;
      if (value) this.act({ act: "start", app: value });
    });
    this.send.addEventListener("click", () => this.sendGoal());
  }

  // Without a server nothing can be sent. A stop is kept until there is one again: a late stop harms nobody, all else might.
  act(act) {
    const sent = this.ask({ do: act });
    if (act.act === "stop") [this.stopping, this.confirmed, this.number] = [sent ? "given" : "owed", new Set(), Infinity];
    if (act.act === "arm") this.stopping = "";
    if (sent) {
      this.tell(act.act === "stop" ? "stop sent" : "", false); // what is told next is about this act
      return this.expect(act);
    }
    this.tell(this.stopping === "owed" ? "NOT SENT: the server is lost. swarm estop needs none; the stop goes out when it is back" : "not sent: the server is lost", true);
  }

  // By what of a robot it can be seen that an act has come to something.
  expect({ act, app, robot, name, value, mode }) {
    const robots = robot ? [robot] : [...this.store.names], get = (topic) => (each) => this.store.get(each, topic);
    const service = (each) => this.store.services[each]?.[`app/${app}`];
    const seen = {
      stop: (each) => this.store.stops.get(each) === true, arm: (each) => this.store.stops.get(each) === false,
      start: (each) => service(each) === true, end: (each) => service(each) === false,
      set: (each) => get(`app/${app}/parameters`)(each)?.parameters?.[name]?.value === value,
      mode: (each) => STANDS[mode]?.includes(get("balancer/state")(each)?.mode),
    }[act];
    if (seen) this.outcomes.watch([act === "mode" ? mode : act, app, name === undefined ? "" : `${name} ${typeof value === "number" ? short(value) : value}`].filter(Boolean).join(" "), robots, seen);
  }

  // A connection may have ended with a stop on its way.
  connected() {
    if (this.stopping) this.act({ act: "stop" });
  }

  // The server's answer to a stop. One that it refuses, since it reaches no robot, is given when it does.
  halted({ act, refused, halt }) {
    if (act !== "stop" || this.stopping !== "given") return;
    if (refused) this.stopping = "refused";
    else this.number = halt.number;
  }

  // A stop is under way until all robots that are there have confirmed it, or it is taken back elsewhere.
  hear({ halt, robots = {} }) {
    if (this.stopping !== "given") return;
    let back = halt && halt.number > this.number && !halt.stop;
    for (const [name, topics] of Object.entries(robots)) {
      const stopped = topics["mesh/stopped"]?.stopped;
      if (stopped === true) this.confirmed.add(name);
      back ||= stopped === false && this.confirmed.has(name);
    }
    if (back) this.tell("the stop was taken back elsewhere", true);
    if (back || (this.confirmed.size && this.store.names.every((name) => this.confirmed.has(name) || this.store.away(name)))) this.stopping = "";
  }

  tell(text, refused) {
    this.said.textContent = text;
    this.said.title = text;
    this.said.className = refused ? "bad" : "";
  }

  // A robot may find a value out of bounds.
  take(step) {
    for (const [name, topics] of Object.entries(step.robots ?? {})) {
      for (const [topic, value] of Object.entries(topics)) {
        if (topic.endsWith("/parameters_set") && value?.problem) {
          this.tell(`${name}: ${value.problem}`, true);
          this.outcomes.refused(name, String(value.problem));
        }
      }
    }
  }

  // What the server lets be done to these robots.
  can(act) {
    return this.store.swarm?.acts?.includes(act) ?? false;
  }

  mode(mode) {
    this.act({ act: "mode", mode, ...(this.robot ? { robot: this.robot } : {}) });
  }

  // What the stop button says. While the server is lost nobody knows what holds.
  state(stopped, silent) {
    const all = this.store.names.length, { stopping } = this;
    if (stopping === "owed" || stopping === "refused") return "STOP NOT SENT";
    if (silent) return stopping ? "STOP NOT CONFIRMED" : "STOP";
    return stopped ? `STOPPED ${stopped}/${all}` : stopping ? `STOPPING 0/${all}` : "STOP";
  }

  drawStop(silent) {
    const { stopped, names } = this.store, state = this.state(stopped.length, silent), counts = state.startsWith("STOPPED");
    const open = counts ? names.filter((name) => !stopped.includes(name)) : [], more = open.length - NAMED;
    const all = open.map((name) => (this.store.away(name) ? `${name} (gone)` : name)).join(" "), said = all ? `${state}, not confirmed by ${all}` : state;
    const [button, missing] = this.stop.children;
    write(button, state);
    write(missing, open.length ? `not ${open.slice(0, NAMED).join(" ")}${more > 0 ? ` +${more}` : ""}` : "");
    if (this.stop.ariaLabel !== `${said}: stop all robots`) this.stop.ariaLabel = this.stop.title = `${said}: stop all robots`;
    write(this.speaker, state === "STOP" ? "" : said);
  }

  draw(robot, map, silent) {
    this.robot = robot;
    const stopped = this.store.stopped.length;
    this.stop.hidden = !this.can("stop");
    this.arm.hidden = !this.can("arm") || !stopped;
    if (this.stopping === "refused" && !silent && this.store.live) this.act({ act: "stop" }); // the server reaches a robot again
    this.drawStop(silent);
    this.whom.hidden = !this.can("mode");
    write(this.whom, robot ?? "all");
    for (const each of this.modes) [each.hidden, each.ariaLabel] = [this.whom.hidden, `${each.textContent} ${robot ?? "all"}`];
    const acts = this.can("set") || this.can("start");
    this.whole.hidden = !acts;
    this.main.classList.toggle("controlled", acts);
    if (!acts) return;
    this.drawApps();
    this.drawParameters(robot);
    this.drawGoal(robot, map);
    this.outcomes.draw();
    this.panel.hidden = !robot;
    if (this.panel.hidden) return;
    const peers = (this.store.get(robot, "mesh/links")?.links ?? []).map((each) => each.peer);
    const services = Object.entries(this.store.services[robot] ?? {}).filter(([, there]) => there).map(([service]) => service).sort();
    const apps = this.running([robot]), shown = JSON.stringify([robot, peers, services, apps]);
    if (shown === this.shown) return;
    this.shown = shown;
    this.panel.replaceChildren(element("h3", { textContent: `Robot ${robot}` }), ...this.laid(robot, peers, apps, services));
  }

  // Drives as long as the button is held: by a finger, a mouse, space or Enter.
  way([text, speed, turn, called], robot) {
    let again = null;
    const go = () => (held.isConnected && document.hasFocus() && !document.hidden ? this.ask({ do: { act: "drive", robot, speed, turn } }) : end());
    const begin = () => (again ??= setInterval(go, DRIVE_MS));
    const end = () => {
      if (again === null) return;
      clearInterval(again);
      again = null;
      this.ask({ do: { act: "drive", robot, speed: 0, turn: 0 } });
    };
    const held = button(text, null, { ariaLabel: `drive ${robot} ${called} while held`, className: "way" });
    held.addEventListener("pointerdown", begin);
    for (const each of ["pointerup", "pointerleave", "pointercancel", "blur", "keyup"]) held.addEventListener(each, end);
    held.addEventListener("keydown", (event) => {
      if (event.key !== " " && event.key !== "Enter") return;
      event.preventDefault();
      begin();
    });
    return held;
  }

  // What can be done to a robot. Real robots have buttons of their own, which people press.
  laid(robot, peers, apps, services) {
    const of = (act, each, buttons) => (this.can(act) ? each.flatMap(buttons) : []);
    const rows = {
      drive: of("drive", WAYS, (each) => this.way(each, robot)),
      press: of("press", ["A", "B", "C"], (each) => button(each, () => this.act({ act: "press", robot, button: each }), { ariaLabel: `press ${each}` })),
      body: [
        ...of("push", [0.1], (impulse) => button("push", () => this.act({ act: "push", robot, impulse }))),
        ...of("lay", ["front", "back"], (side) => button(`lay on ${side}`, () => this.act({ act: "lay", robot, side }))),
      ],
      links: of("cut", peers, (peer) => [
        button(`cut ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: CUT_S })),
        button(`mend ${peer}`, () => this.act({ act: "cut", robot, peer, seconds: 0 })),
      ]),
      apps: of("start", apps, ([app, runs]) => this.app(app, runs, robot)),
      kill: of("kill", services, (service) => button(service, () => this.act({ act: "kill", robot, service }), { className: "bad", ariaLabel: `kill ${service}` })),
    };
    return Object.entries(rows).filter(([, buttons]) => buttons.length).map(([what, buttons]) => {
      const row = element("div", { className: "acts" }), all = element("div");
      all.append(...buttons);
      row.append(element("span", { textContent: what }), all);
      return row;
    });
  }

  // Parameters of robots' apps that may change while these run: [[app, name, parameter], ...].
  parameters(robots) {
    const found = new Map();
    for (const robot of robots) {
      for (const [topic, value] of this.store.robots.get(robot) ?? []) {
        const app = /^app\/([^/]+)\/parameters$/.exec(topic)?.[1];
        if (app && this.store.services[robot]?.[`app/${app}`] === false) continue; // it has ended
        for (const [name, each] of Object.entries((app && value?.parameters) ?? {})) if (each?.live && !found.has(`${app} ${name}`)) found.set(`${app} ${name}`, [app, name, each]);
      }
    }
    return [...found.values()].slice(0, PARAMETERS);
  }

  // A slider where bounds are declared, a list where choices are; sent when it is let go.
  drawParameters(robot) {
    const parameters = this.can("set") ? this.parameters(robot ? [robot] : this.store.names) : [], slid = JSON.stringify(parameters);
    if (slid === this.slid || this.sliders.contains(document.activeElement) && document.activeElement.tagName === "INPUT") return;
    this.slid = slid;
    const heads = new Set();
    this.sliders.replaceChildren(...parameters.flatMap(([app, name, parameter]) => {
      const head = heads.has(app) ? [] : [element("h3", { textContent: `Parameters of ${app}, on all robots` })];
      heads.add(app);
      return [...head, this.parameter(app, name, parameter)];
    }));
  }

  // Of all robots: an algorithm's parameters differ between robots by intention only, and then by `swarm app param`.
  parameter(app, name, { value, unit, expected, kind, low, high, choices }) {
    const row = element("div", { className: "slider" }), title = element("span", { textContent: name, title: `${expected}` }), label = `${app} ${name}`;
    const set = (typed) => this.act({ act: "set", app, name, value: typed });
    row.append(title);
    if (choices?.length || typeof value === "boolean") {
      const select = element("select", { ariaLabel: label });
      select.append(...(choices?.length ? choices.slice(0, CHOICES) : ["true", "false"]).map((each) => new Option(each, each)));
      select.value = String(value);
      select.addEventListener("change", () => set(choices?.length ? select.value : select.value === "true"));
      row.append(select);
      return row;
    }
    const input = element("input", { value: String(value), ariaLabel: label });
    input.addEventListener("change", () => {
      set(typeof value === "number" ? Number(input.value) : input.value);
      input.blur();
    });
    if (Number.isFinite(low) && high > low) {
      const whole = kind === "int", wide = !whole && low > 0 && high / low > 300; // then equal steps are equal shares
      const there = (each) => (wide ? low * (high / low) ** each : low + each * (high - low)), back = (each) => (wide ? Math.log(each / low) / Math.log(high / low) : (each - low) / (high - low));
      const slider = element("input", { type: "range", min: 0, max: 1, step: "any", value: back(value), ariaLabel: `slider of ${name}` }), output = element("span", { className: "slid" });
      const at = () => (whole ? Math.round(there(slider.value)) : +there(slider.value).toPrecision(3));
      slider.addEventListener("input", () => (input.value = at()));
      slider.addEventListener("change", () => {
        set(at());
        slider.blur();
      });
      output.append(input, ` ${unit === "1" ? "" : unit}`);
      row.append(slider, output);
      row.classList.add("ranged");
    } else row.append(input);
    return row;
  }

  // Apps that have been on these robots, and whether one of them runs: [[name, runs], ...].
  running(robots) {
    const found = new Map();
    for (const robot of robots) {
      for (const [service, there] of Object.entries(this.store.services[robot] ?? {})) {
        if (service.startsWith("app/")) found.set(service.slice(4), there || (found.get(service.slice(4)) ?? false));
      }
      const there = this.store.get(robot, "view/apps")?.apps;
      for (const app of Array.isArray(there) ? there : []) if (typeof app === "string" && !found.has(app)) found.set(app, false);
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

  // A click on the map sets a goal for the selected robot, a button sends it there by the app goto. All robots have to run
  // that, or this one would not know their places: the others stay where they are.
  drawGoal(robot, map) {
    map.canSend = this.can("set") && this.can("start");
    map.canPlace = this.can("place");
    if (map.wanted && map.wanted.robot !== robot) map.wanted = null;
    const wanted = this.can("set") && robot ? map.wanted : null;
    this.wanted = wanted;
    this.send.hidden = !wanted;
    if (!wanted) return;
    const ends = this.runsGoto() ? [] : this.driving();
    write(this.send, `Send ${robot} to ${wanted.x.toFixed(2)}, ${wanted.y.toFixed(2)} m${this.runsGoto() ? "" : `: ${ends.length ? `ends ${ends.join(" and ")}, ` : ""}starts goto on all, the others stay`}`);
  }

  runsGoto() {
    return this.store.names.every((name) => this.store.services[name]?.["app/goto"]);
  }

  // Apps that drive robots now.
  driving() {
    const drives = (app) => (name) => this.store.services[name]?.[`app/${app}`] && this.store.get(name, `app/${app}/parameters`)?.parameters?.apart;
    return this.running(this.store.names).filter(([app, runs]) => runs && app !== "goto" && this.store.names.some(drives(app))).map(([app]) => app);
  }

  // goto starts with the goal, lest the robot sets out for another place.
  sendGoal() {
    const { robot, x, y } = this.wanted, waypoints = `${x.toFixed(3)},${y.toFixed(3)} stay`;
    if (this.runsGoto()) return this.act({ act: "set", app: "goto", name: "waypoints", value: waypoints, robot });
    for (const app of this.driving()) this.act({ act: "end", app });
    this.act({ act: "start", app: "goto", settings: { waypoints: "stay", [`${robot}.waypoints`]: waypoints } });
  }
}
