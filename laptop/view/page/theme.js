// Light and dark. Canvases ask for colours for each thing that they draw, which the browser would look up anew each time.

const root = document.documentElement;
const known = new Map();

export const theme = {
  version: 0, // goes up with each change: whoever has drawn must draw again

  set(name) {
    root.dataset.theme = name;
    known.clear();
    theme.version += 1;
  },

  toggle() {
    theme.set(root.dataset.theme === "dark" ? "light" : "dark");
  },

  colour(name) {
    if (!known.has(name)) known.set(name, getComputedStyle(root).getPropertyValue(name).trim());
    return known.get(name);
  },
};

const sizes = new WeakMap(); // of canvases, as the browser has laid them out: to ask for it anew would cost a layout
const laid = new ResizeObserver((entries) => {
  for (const { target, contentRect } of entries) sizes.set(target, [contentRect.width, contentRect.height]);
});

// Gives a canvas the pixels of its place on the screen; pixels for one of the page's, 0 where it cannot be seen.
export function sharp(canvas) {
  if (!sizes.has(canvas)) {
    sizes.set(canvas, [canvas.clientWidth, canvas.clientHeight]);
    laid.observe(canvas);
  }
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = sizes.get(canvas).map((each) => Math.round(each * ratio));
  if (!width || !height) return 0;
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  return ratio;
}
