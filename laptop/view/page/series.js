// Numbers over time, of all robots: what a chart, a sparkline or an answer is made of. The server is asked for the past,
// then what the page is told is added; of a recording the whole run comes at once.

const WINDOW = 120; // s of a running swarm
const AWAY_S = 1; // the shortest gap in a line

// One field of one key.
export const plain = (topic, path) => ({
  name: `${topic} ${path.join(".")}`,
  sources: [{ topic, fields: [path] }],
  combine: ([rows]) => rows.filter(([, , y]) => y !== null).map(([t, k, y]) => [t, y, k]),
});

// How far a place that a key tells is from another one: told by a key too (of each robot, or of any), or fixed. Both are
// held against each other at the time that the messages carry, which the way to the page does not blur.
export const apart = (name, topic, path, reference) => ({
  name,
  positive: true,
  sources: [{ topic, fields: [["t"], [...path, "x"], [...path, "y"]] }, ...(reference.topic ? [{ topic: reference.topic, fields: [["t"], ["x"], ["y"]], anyone: reference.anyone }] : [])],
  combine: ([rows, truth]) => {
    const found = [];
    let after = 0;
    for (const [at, k, t, x, y] of rows) {
      if (x === null || y === null || Math.abs(x) > 500 || Math.abs(y) > 500) continue;
      let there = reference;
      if (reference.topic) {
        while (after < truth.length && truth[after][2] < t) after += 1;
        const next = truth[after], before = truth[after - 1];
        if (!next) break; // not known yet
        const share = before && next[2] > before[2] ? (t - before[2]) / (next[2] - before[2]) : 1;
        there = before ? { x: before[3] + share * (next[3] - before[3]), y: before[4] + share * (next[4] - before[4]) } : { x: next[3], y: next[4] };
      }
      found.push([at, Math.hypot(x - there.x, y - there.y), k]);
    }
    return found;
  },
});

// Whether zero is what is wanted: then the largest counts, of all else how far robots are apart.
export const isDistance = ({ positive, unit }) => Boolean(positive) || unit === "m";

export class Series {
  constructor(store, ask) {
    this.store = store;
    this.ask = ask;
    this.entries = new Map();
    this.beside = null; // the run beside the one that is shown
  }

  // Asks for it where it is new.
  want(wanted) {
    let entry = this.entries.get(wanted.name);
    if (!entry) {
      entry = { wanted, version: 0, cache: new Map(), sources: wanted.sources.map((each) => ({ ...each, rows: new Map(), beside: new Map(), told: false })) };
      this.entries.set(wanted.name, entry);
      this.fill(entry);
    }
    return entry;
  }

  fill(entry) {
    for (const { topic, fields } of entry.sources) this.ask({ series: { topic, fields } });
  }

  // All that was missed, or another run; of a recording the answers take the place of what is there.
  refill() {
    for (const entry of this.entries.values()) {
      if (!this.store.swarm?.recording) for (const source of entry.sources) source.rows = new Map();
      this.touch(entry);
      this.fill(entry);
    }
  }

  touch(entry) {
    entry.version += 1;
    entry.cache.clear();
  }

  answered({ topic, fields, rows, beside }) {
    const called = JSON.stringify(fields);
    for (const entry of this.entries.values()) {
      for (const source of entry.sources) {
        if (source.topic !== topic || JSON.stringify(source.fields) !== called) continue;
        source.told = true;
        if (this.store.swarm?.recording) source.rows = new Map();
        for (const [robot, before] of Object.entries(rows)) {
          const now = source.rows.get(robot) ?? [];
          source.rows.set(robot, [...before.filter(([t]) => !now.length || t < now[0][0]), ...now]);
        }
        source.beside = new Map(Object.entries(beside ?? {}));
        this.touch(entry);
      }
    }
  }

  // What a step of a running swarm tells.
  take(step) {
    if (this.store.swarm?.recording) return;
    for (const entry of this.entries.values()) {
      let fresh = false;
      for (const { topic, fields, rows } of entry.sources) {
        for (const [robot, topics] of Object.entries(step.robots ?? {})) {
          const value = topics[topic];
          if (value === undefined) continue;
          const numbers = fields.map((path) => number(dig(value, path)));
          if (numbers.every((each) => each === null)) continue;
          if (!rows.has(robot)) rows.set(robot, []);
          const kept = rows.get(robot);
          kept.push([step.t, number(value.k), ...numbers]);
          while (kept[0][0] < step.t - WINDOW) kept.shift();
          fresh = true;
        }
      }
      if (fresh) this.touch(entry);
    }
  }

  // [[t, y, k], ...] of a robot, oldest first.
  points(entry, robot, of = "rows") {
    const name = `${of} ${robot}`;
    if (!entry.cache.has(name)) {
      const rows = entry.sources.map((source) => source[of].get(robot) ?? (source.anyone ? source[of].values().next().value : undefined) ?? []);
      entry.cache.set(name, rows[0].length ? entry.wanted.combine(rows) : []);
    }
    return entry.cache.get(name);
  }

  // Those robots that have any, in the swarm's order.
  robots(entry, of = "rows") {
    const known = of === "rows" ? this.store.names : this.beside?.robots ?? [];
    return known.filter((name) => this.points(entry, name, of).length);
  }

  // Whether the server has answered, so that what is not there is known not to be.
  settled(entry) {
    return entry.sources.every((source) => source.told);
  }
}

const number = (value) => (typeof value === "boolean" ? Number(value) : typeof value === "number" && Number.isFinite(value) ? value : null);

// The points with one of null in each gap: where a robot with a pace told nothing for long. It was off, or out of reach.
export function withGaps(points) {
  const steps = points.slice(1).map(([t], index) => t - points[index][0]), ordered = steps.toSorted((a, b) => a - b);
  const median = ordered[ordered.length >> 1], paced = steps.length >= 10 && ordered[Math.floor(0.9 * steps.length)] <= 3 * median;
  if (!paced) return points;
  const long = Math.max(AWAY_S, 10 * median);
  return points.flatMap((point, index) => (index && steps[index - 1] > long ? [[points[index - 1][0] + 1e-3, null, null], point] : [point]));
}

// The last point at or before a time; null where there is none.
export function held(points, t) {
  let [low, high] = [0, points.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (points[middle][0] <= t) low = middle + 1;
    else high = middle;
  }
  return low ? points[low - 1] : null;
}

// Parts of a list are called by what tells them apart (links by their peer), which their place does not.
export function called(list, item) {
  return Array.isArray(list) && item instanceof Object ? item.peer ?? item.anchor ?? item.robot : undefined;
}

export function dig(value, path) {
  return path.reduce((each, name) => (Array.isArray(each) ? each.find((item) => called(each, item) === name) ?? each[name] : each?.[name]), value);
}
