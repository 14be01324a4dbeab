// Where robots are to go, as their apps tell it: waypoints of goto, `goal_x` and `goal_y` of any app's result, or what it
// publishes as `goal`.

const FAR = 500; // m
const MOST = 100; // waypoints of a robot

export function goals(store) {
  const found = [];
  for (const name of store.names) {
    for (const app of store.apps.get(name) ?? []) {
      if (store.services[name]?.[app] === false) continue; // it has ended
      const result = store.get(name, `${app}/state`)?.result ?? {}, told = store.get(name, `${app}/out/goal`)?.values;
      for (const [x, y] of [[result.goal_x, result.goal_y], [told?.x, told?.y]]) if (Math.abs(x) < FAR && Math.abs(y) < FAR) found.push({ name, x, y, next: true });
      const points = waypoints(store.get(name, `${app}/parameters`)?.parameters?.waypoints?.value);
      points.forEach((point, index) => index >= (result.reached ?? 0) && found.push({ name, ...point, next: index === (result.reached ?? 0) }));
    }
  }
  return found;
}

function waypoints(text) {
  if (typeof text !== "string") return [];
  return text.split(/\s+/, MOST).map((word) => word.split(",").map(Number)).filter(([x, y]) => Math.abs(x) < FAR && Math.abs(y) < FAR).map(([x, y]) => ({ x, y }));
}
