// Where names stand on the map: around each robot there are eight places; of those the one that costs least, by what it would
// cover: other names, robots, links, the map's edges. A name moves when another place has been better for a while, and at once where
// it would cover another name.

const STAY_MS = 500;
const JUMP = 4; // times a robot's rim: what has gone so far since the last look is not the same picture
const LOOK_MS = 200; // between two looks; names go with their robots meanwhile
const BETTER = 0.7; // times as dear as the place that it has
const PLACES = [[1, 0], [1, -1], [1, 1], [-1, 0], [-1, -1], [-1, 1], [0, -1], [0, 1]];
const COST = { name: 40, robot: 25, link: 4, edge: 60 };

export class Labels {
  constructor() {
    this.chosen = new Map(); // name -> {place, other, since}
    this.looked = -Infinity;
  }

  // `items`: [{name, x, y, r, width, height}], the most important first; `links`: [[[x, y], [x, y]], ...], as they are
  // drawn; `kept`: [x, y, radius] of what else should be seen. Returns the boxes [left, top, right, bottom] by name.
  place(items, links, width, height, now, kept = []) {
    this.kept = kept;
    if (now >= this.looked + LOOK_MS || now < this.looked || items.some(({ name }) => !this.chosen.has(name))) this.look(items, links, width, height, now);
    return new Map(items.map((item) => [item.name, box(item, PLACES[this.chosen.get(item.name).place])]));
  }

  // Whether a name is about to move, though nothing else does.
  get moving() {
    return [...this.chosen.values()].some(({ other }) => other !== null);
  }

  look(items, links, width, height, now) {
    const put = [];
    this.looked = now;
    for (const item of items) {
      const costs = PLACES.map((place, index) => this.cost(box(item, place), item, items, links, put, width, height) + 0.01 * index);
      const best = costs.indexOf(Math.min(...costs)), known = this.chosen.get(item.name);
      const covers = known && costs[known.place] >= COST.name && costs[best] < COST.name; // it cannot be read until it moves
      if (!known || covers || Math.hypot(item.x - known.x, item.y - known.y) > JUMP * item.r) this.chosen.set(item.name, { place: best, other: null, since: now });
      else if (best === known.place || costs[best] > BETTER * costs[known.place]) known.other = null;
      else if (known.other === null || now < known.since) [known.other, known.since] = [best, now];
      else if (now >= known.since + STAY_MS) [known.place, known.other] = [best, null];
      const chosen = this.chosen.get(item.name);
      [chosen.x, chosen.y] = [item.x, item.y];
      put.push(box(item, PLACES[chosen.place]));
    }
    for (const name of this.chosen.keys()) if (!items.some((item) => item.name === name)) this.chosen.delete(name);
  }

  cost(mine, item, items, links, put, width, height) {
    let sum = 0;
    for (const other of put) if (overlap(mine, other)) sum += COST.name;
    for (const { name, x, y, r } of items) if (name !== item.name && overlap(mine, [x - r, y - r, x + r, y + r])) sum += COST.robot;
    for (const [x, y, r] of this.kept) if (overlap(mine, [x - r, y - r, x + r, y + r])) sum += COST.link;
    for (const [from, to] of links) if (crosses(mine, from, to)) sum += COST.link;
    if (mine[0] < 2 || mine[1] < 2 || mine[2] > width - 2 || mine[3] > height - 2) sum += COST.edge;
    return sum;
  }
}

function box({ x, y, r, width, height }, [across, down]) {
  const near = across && down ? 0.75 * r : r + 2;
  const left = across > 0 ? x + near : across < 0 ? x - near - width : x - width / 2;
  const top = down > 0 ? y + near : down < 0 ? y - near - height : y - height / 2;
  return [left, top, left + width, top + height];
}

const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

// Whether a line goes through a box (Liang, Barsky 1984).
function crosses([left, top, right, bottom], [x0, y0], [x1, y1]) {
  let [from, to] = [0, 1];
  for (const [p, q] of [[x0 - x1, x0 - left], [x1 - x0, right - x0], [y0 - y1, y0 - top], [y1 - y0, bottom - y0]]) {
    if (p === 0 && q < 0) return false;
    if (p < 0) from = Math.max(from, q / p);
    else if (p > 0) to = Math.min(to, q / p);
  }
  return from <= to;
}
