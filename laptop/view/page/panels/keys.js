// All keys of one robot, live, as `z_sub` shows them.

import { called } from "../series.js";

const FIELDS = 200; // of a key that are shown

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
    for (const topic of sorted(this.store.robots.get(this.robot)?.keys() ?? [])) {
      const value = this.store.get(this.robot, topic), text = JSON.stringify(value);
      let row = this.rows.get(topic);
      if (!row) {
        const name = document.createElement("dt"), data = document.createElement("dd");
        name.textContent = topic;
        row = { name, data, text: null, shape: null, fields: [] };
        this.rows.set(topic, row);
        const topics = sorted(this.rows.keys()), after = topics[topics.indexOf(topic) - 1];
        if (after) this.rows.get(after).data.after(name, data);
        else list.prepend(name, data);
      }
      if (row.text === text) continue;
      row.text = text;
      this.update(row, topic, flat(value).slice(0, FIELDS));
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

// By name, but for parameters: many lines that seldom change come last.
function sorted(topics) {
  const last = (topic) => topic.endsWith("/parameters");
  return [...topics].sort((a, b) => last(a) - last(b) || (a < b ? -1 : 1));
}

// Fields and fields of fields, as [path, value].
function flat(value, path = []) {
  if (value && typeof value === "object" && path.length < 4) {
    return Object.entries(value).flatMap(([name, item]) => flat(item, [...path, called(value, item) ?? name]));
  }
  return [[path, value]];
}

function show(value) {
  if (typeof value === "number") return String(Number.isInteger(value) ? value : +value.toPrecision(5));
  return value === null ? "-" : JSON.stringify(value);
}
