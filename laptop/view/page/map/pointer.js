// What people do on the map: move and zoom it, choose a robot, set a goal, put a robot elsewhere.

const NEAR = 24; // px

export function listen(map) {
  const canvas = map.canvas;
  for (const each of ["wheel", "pointermove", "pointerup", "dblclick", "keydown"]) canvas.addEventListener(each, () => map.wake());
  let from = null;
  const metres = (event) => {
    const box = canvas.getBoundingClientRect(), { x, y, scale } = map.shown;
    return [x + ((event.clientX - box.left) * map.ratio - canvas.width / 2) / scale, y - ((event.clientY - box.top) * map.ratio - canvas.height / 2) / scale];
  };
  const zoom = (factor, x, y) => {
    const view = map.view ?? { ...map.shown };
    map.view = { x: x + (view.x - x) / factor, y: y + (view.y - y) / factor, scale: view.scale * factor };
  };
  // The robot that is nearest, and how far it is, px.
  const nearest = (event) => {
    const [x, y] = metres(event);
    const [away, name] = [...map.placed].map(([name, place]) => [Math.hypot(place.x - x, place.y - y), name]).sort((a, b) => a[0] - b[0])[0] ?? [Infinity, null];
    return [name, (away * map.shown.scale) / map.ratio];
  };
  const fingers = new Map();
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500), ...metres(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event);
    const [name, away] = nearest(event);
    from = { event, view: map.view ?? { ...map.shown }, moved: fingers.size > 1, holds: map.canPlace && name === map.selected && away < NEAR ? name : null };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!from || !fingers.has(event.pointerId)) return;
    const other = [...fingers.values()].find((each) => each.pointerId !== event.pointerId);
    if (other) { // two fingers: what is between them grows as their distance does
      const before = fingers.get(event.pointerId), apart = (each) => Math.hypot(each.clientX - other.clientX, each.clientY - other.clientY);
      if (apart(before) > 0) zoom(apart(event) / apart(before), ...metres(other));
    } else {
      const dx = (event.clientX - from.event.clientX) * map.ratio, dy = (event.clientY - from.event.clientY) * map.ratio;
      if (Math.hypot(dx, dy) > 4) from.moved = true;
      if (from.moved && from.holds) {
        const [x, y] = metres(event);
        map.held = { robot: from.holds, x, y };
      } else if (from.moved && from.event.pointerId === event.pointerId) map.view = { ...from.view, x: from.view.x - dx / from.view.scale, y: from.view.y + dy / from.view.scale };
    }
    fingers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointerup", (event) => {
    const [name, away] = nearest(event), [x, y] = metres(event);
    if (map.held) map.place(map.held);
    else if (from && !from.moved && away < NEAR) map.select(name);
    else if (from && !from.moved && map.selected && map.canSend) map.wanted = { robot: map.selected, x, y };
    map.held = null;
    fingers.delete(event.pointerId);
    from = null;
  });
  canvas.addEventListener("pointercancel", (event) => {
    fingers.delete(event.pointerId);
    from = map.held = null;
  });
  canvas.addEventListener("dblclick", () => ([map.view, map.box] = [null, null]));
  canvas.addEventListener("keydown", (event) => {
    const view = map.view ?? { ...map.shown }, step = (40 * map.ratio) / view.scale;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[event.key]) map.view = { ...view, x: view.x + moves[event.key][0], y: view.y + moves[event.key][1] };
    else if (event.key === "+") zoom(1.25, view.x, view.y);
    else if (event.key === "-") zoom(0.8, view.x, view.y);
    else if (event.key === "0") [map.view, map.box] = [null, null];
    else return;
    event.preventDefault();
  });
}
