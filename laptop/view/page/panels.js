// The table of robots, the log of events, the keys of one robot.

const COLUMNS = 9; // behind the name

// Clocks are apart by a few milliseconds (one machine) or by the time between two boots.
// What a robot says may lack anything, and hold what is no number.
const rounded = (value, digits) => (Number(value.toFixed(digits)) + 0).toFixed(digits); // without "-0.0"
const fixed = (value, digits, unit) => (typeof value === "number" ? `${rounded(value, digits)}${unit}` : "-");
const list = (value) => (Array.isArray(value) ? value : []);
const seconds = (value) => (Math.abs(value) < 1 ? `${rounded(value * 1000, 1)} ms` : `${value.toFixed(3)} s`);

export class Robots {
  constructor(body, store, select) {
    this.body = body;
    this.store = store;
    this.select = select;
    this.rows = new Map();
  }

  draw(selected) {
    for (const name of this.store.names) {
      const row = this.rows.get(name) ?? this.row(name);
      const chosen = String(name === selected), title = row.cells[0].lastChild;
      if (row.ariaSelected !== chosen) row.ariaSelected = chosen;
      const text = this.store.get(name, "view/reach")?.by === "mesh" ? `${name} (mesh)` : name;
      if (title.data !== text) title.data = text;
      this.cells(name).forEach(([text, kind = ""], index) => {
        const cell = row.cells[index + 1];
        if (cell.textContent !== text) cell.textContent = text;
        if (cell.className !== kind) cell.className = kind;
      });
    }
  }

  // The robot's name stays, the other cells are filled as it lives.
  row(name) {
    const row = this.body.insertRow(), title = row.insertCell(), swatch = document.createElement("span");
    row.tabIndex = 0;
    row.dataset.robot = name;
    row.addEventListener("click", () => this.select(name));
    row.addEventListener("keydown", (event) => event.key === "Enter" && this.select(name));
    swatch.className = "swatch";
    swatch.style.background = this.store.colour(name);
    title.append(swatch, name);
    for (let index = 0; index < COLUMNS; index += 1) row.insertCell();
    this.rows.set(name, row);
    return row;
  }

  // Text and kind of each cell.
  cells(name) {
    const get = (topic) => this.store.get(name, topic);
    const body = get("balancer/state"), battery = get("balancer/battery"), clock = get("mesh/clock");
    const links = list(get("mesh/links")?.links), up = links.filter((each) => each?.state === "up").length;
    const [app, progress] = this.app(name), left = body?.battery_left;
    const volts = body?.battery ?? battery?.voltage, waits = list(progress?.waiting_for);
    return [
      this.services(name),
      body ? [`${body.mode} ${fixed((body.tilt * 180) / Math.PI, 1, "°")}`, body.mode === "fault" ? "bad" : ""] : ["-"],
      [typeof volts === "number" ? `${fixed(volts, 2, " V")}${typeof left === "number" ? ` ${Math.round(left / 60)} min` : ""}` : "-", { low: "warn", empty: "bad" }[body?.battery_level] ?? ""],
      [`${up}/${links.length}`, up < links.length ? "bad" : ""],
      [app ? `${app} ${progress?.phase ?? ""}` : "-", { fault: "bad", waiting: "warn" }[progress?.phase] ?? ""],
      [app ? String(this.k(name, app, progress)) : "-"],
      [waits.join(" ") || "-", waits.length ? "warn" : ""],
      [typeof clock?.error === "number" ? `${typeof clock.offset === "number" ? `${seconds(clock.offset)} ` : ""}±${(clock.error * 1000).toFixed(1)} ms by ${clock.root}` : "-"],
      this.fault(name, progress),
    ];
  }

  services(name) {
    const services = this.store.services[name] ?? {}, names = Object.keys(services).sort(), reach = this.store.get(name, "view/reach");
    if (reach && !reach.by) return [`out of reach: ${reach.why}`, "bad text"];
    const gone = names.filter((each) => !services[each]);
    if (gone.length) return [`gone: ${gone.join(" ")}`, "bad"];
    const degraded = names.filter((each) => this.store.get(name, `${each}/status`)?.state === "degraded");
    if (degraded.length) return [`degraded: ${degraded.join(" ")}`, "warn"];
    return names.length ? [`${names.length} ok`, "good"] : ["-"];
  }

  // What is wrong, else what was wrong last.
  fault(name, progress) {
    if (progress?.phase === "fault") return [progress.reason, "bad text"];
    const fault = this.store.get(name, "balancer/fault");
    if (fault?.name) return [`${fault.name}: ${fault.reason}`, "bad text"];
    const last = this.store.faults.get(name);
    return [last ? `${last.text} (at ${last.t.toFixed(1)} s)` : "-", "text faint"];
  }

  // Of several apps the one that runs; a recording has no progress, only states.
  app(name) {
    const apps = (this.store.apps.get(name) ?? []).map((topic) => topic.slice(4));
    const app = apps.find((each) => this.store.services[name]?.[`app/${each}`]) ?? apps[0];
    return app === undefined ? [null, null] : [app, this.store.get(name, `app/${app}/progress`)];
  }

  k(name, app, progress) {
    return Math.max(progress?.k ?? 0, this.store.get(name, `app/${app}/state`)?.k ?? 0);
  }
}

export class Events {
  constructor(list) {
    this.list = list;
    this.last = 0;
  }

  draw(events) {
    for (const event of events.filter((each) => each.number > this.last)) {
      const line = document.createElement("li"), time = document.createElement("time");
      time.textContent = event.t.toFixed(1);
      line.className = { warning: "warn", error: "bad" }[event.level] ?? "";
      line.append(time, `${event.robot} ${event.text}`);
      this.list.prepend(line);
      this.last = event.number;
    }
    while (this.list.children.length > 200) this.list.lastChild.remove();
  }

  clear() {
    this.last = 0;
    this.list.replaceChildren();
  }
}

export class Keys {
  constructor(section, store, chart) {
    this.section = section;
    this.store = store;
    this.chart = chart;
    this.rows = new Map();
    this.robot = null;
  }

  show(robot) {
    this.robot = robot;
    this.rows.clear();
    this.section.hidden = !robot;
    this.section.querySelector("h2").textContent = `swarm/${robot}`;
    this.section.querySelector("dl").replaceChildren();
  }

  draw() {
    if (!this.robot) return;
    const list = this.section.querySelector("dl");
    for (const topic of [...(this.store.robots.get(this.robot)?.keys() ?? [])].sort()) {
      const value = this.store.get(this.robot, topic), text = JSON.stringify(value);
      let row = this.rows.get(topic);
      if (!row) {
        const name = document.createElement("dt"), data = document.createElement("dd");
        name.textContent = topic;
        row = { name, data, text: null, shape: null, fields: [] };
        this.rows.set(topic, row);
        const after = [...this.rows.keys()].sort()[[...this.rows.keys()].sort().indexOf(topic) - 1];
        if (after) this.rows.get(after).data.after(name, data);
        else list.prepend(name, data);
      }
      if (row.text === text) continue;
      row.text = text;
      this.update(row, topic, flat(value));
    }
  }

  // `name=value` for each field; numbers are buttons that open a chart. The elements stay as long as the fields do, so
  // that they can be clicked while their values change.
  update(row, topic, fields) {
    const shape = fields.map(([path, value]) => `${path.join(".")}:${typeof value === "number"}`).join(" ");
    if (row.shape !== shape) {
      row.shape = shape;
      row.fields = fields.map(([path, value]) => {
        const number = typeof value === "number" && path.length, field = document.createElement(number ? "button" : "span");
        if (number) {
          field.type = "button";
          field.addEventListener("click", () => this.chart(topic, path));
        }
        return field;
      });
      row.data.replaceChildren(...row.fields.flatMap((field) => [field, " "]));
    }
    fields.forEach(([path, value], index) => {
      const text = `${path.join(".")}=${show(value)}`;
      if (row.fields[index].textContent !== text) row.fields[index].textContent = text;
    });
  }
}

// Fields and fields of fields, as [path, value].
function flat(value, path = []) {
  if (value && typeof value === "object" && path.length < 4) {
    return Object.entries(value).flatMap(([name, item]) => flat(item, [...path, called(value, item) ?? name]));
  }
  return [[path, value]];
}

// Parts of a list are called by what tells them apart (links by their peer), which their place does not.
function called(list, item) {
  return Array.isArray(list) && item instanceof Object ? item.peer ?? item.anchor ?? item.robot : undefined;
}

// What `flat` has called by this path.
export function dig(value, path) {
  return path.reduce((each, name) => (Array.isArray(each) ? each.find((item) => called(each, item) === name) ?? each[name] : each?.[name]), value);
}

function show(value) {
  if (typeof value === "number") return String(Number.isInteger(value) ? value : +value.toPrecision(5));
  return value === null ? "-" : JSON.stringify(value);
}
