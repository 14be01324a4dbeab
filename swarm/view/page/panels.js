// The table of robots, the log of events, the keys of one robot.

const cell = (text, kind = "") => {
  const element = document.createElement("td");
  element.textContent = text;
  element.className = kind;
  return element;
};

export class Robots {
  constructor(body, store, select) {
    this.body = body;
    this.store = store;
    this.select = select;
    this.rows = new Map();
  }

  draw(selected) {
    for (const name of this.store.names) {
      let row = this.rows.get(name);
      if (!row) {
        row = this.body.insertRow();
        row.tabIndex = 0;
        row.dataset.robot = name;
        row.addEventListener("click", () => this.select(name));
        row.addEventListener("keydown", (event) => event.key === "Enter" && this.select(name));
        this.rows.set(name, row);
      }
      row.setAttribute("aria-selected", String(name === selected));
      const cells = this.cells(name), shown = cells.map((each) => each.className + each.textContent).join("|");
      if (row.dataset.shown !== shown) {
        row.dataset.shown = shown;
        row.replaceChildren(...cells);
      }
    }
  }

  cells(name) {
    const get = (topic) => this.store.get(name, topic);
    const title = cell(name), swatch = document.createElement("span");
    swatch.className = "swatch";
    swatch.style.background = this.store.colour(name);
    title.prepend(swatch);
    const services = this.store.services[name] ?? {};
    const gone = Object.keys(services).filter((each) => !services[each]).sort();
    const degraded = Object.keys(services).filter((each) => services[each] && get(`${each}/status`)?.state === "degraded").sort();
    const body = get("balancer/state"), battery = get("balancer/battery");
    const links = get("mesh/links")?.links ?? [], up = links.filter((each) => each.state === "up").length;
    const [app, progress] = this.app(name), clock = get("mesh/clock"), fault = get("balancer/fault");
    const left = body?.battery_left, reach = get("view/reach");
    if (reach?.by === "mesh") title.append(" (mesh)");
    return [
      title,
      reach && !reach.by ? cell(`out of reach: ${reach.why}`, "bad text") : gone.length ? cell(`gone: ${gone.join(" ")}`, "bad") : degraded.length ? cell(`degraded: ${degraded.join(" ")}`, "warn") : Object.keys(services).length ? cell(`${Object.keys(services).length} ok`, "good") : cell("-"),
      body ? cell(`${body.mode} ${((body.tilt * 180) / Math.PI).toFixed(1)}°`, body.mode === "fault" ? "bad" : "") : cell("-"),
      cell(body?.battery ? `${body.battery.toFixed(2)} V${typeof left === "number" ? ` ${Math.round(left / 60)} min` : ""}` : battery?.voltage ? `${battery.voltage.toFixed(2)} V` : "-", { low: "warn", empty: "bad" }[body?.battery_level] ?? ""),
      cell(`${up}/${links.length}`, up < links.length ? "bad" : ""),
      cell(app ? `${app} ${progress?.phase ?? ""}` : "-", { fault: "bad", waiting: "warn" }[progress?.phase] ?? ""),
      cell(app ? String(this.k(name, app, progress)) : "-"),
      cell(progress?.waiting_for?.join(" ") || "-", progress?.waiting_for?.length ? "warn" : ""),
      cell(typeof clock?.error === "number" ? `±${(clock.error * 1000).toFixed(1)} ms by ${clock.root}` : "-"),
      cell(progress?.phase === "fault" ? progress.reason : fault?.name ? `${fault.name}: ${fault.reason}` : "-", progress?.phase === "fault" || fault?.name ? "bad text" : "text"),
    ];
  }

  app(name) {
    for (const [topic, value] of this.store.robots.get(name) ?? []) {
      // A recording has no progress, only states.
      const found = /^app\/([^/]+)\/(progress|state)$/.exec(topic);
      if (found) return [found[1], found[2] === "progress" ? value : this.store.get(name, `app/${found[1]}/progress`)];
    }
    return [null, null];
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
    return Object.entries(value).flatMap(([name, item]) => flat(item, [...path, name]));
  }
  return [[path, value]];
}

function show(value) {
  if (typeof value === "number") return String(Number.isInteger(value) ? value : +value.toPrecision(5));
  return value === null ? "-" : JSON.stringify(value);
}
