// Light and dark. Canvases ask for colours for each thing that they draw, which the browser would look up anew each time.

const root = document.documentElement;
const known = new Map();

// Of robots, told apart by colour-blind eyes too: 10 apart in OKLab x 100 at least, in the worst of normal and three
// colour-blind sights.
const ROBOTS = {
  light: ["#2743b8", "#ad3a0e", "#128270", "#70305e", "#c58128", "#3b9ac2"],
  dark: ["#5f7bee", "#f3652f", "#93efdc", "#b2548a", "#f4ca3a", "#3fb4cc"],
};

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

  robot(index) {
    const colours = ROBOTS[root.dataset.theme === "dark" ? "dark" : "light"];
    return colours[index % colours.length];
  },
};

export const FONT = "Inter, system-ui, sans-serif";

const sizes = new WeakMap(); // of elements, as the browser has laid them out: to ask for it anew would cost a layout
const laid = new ResizeObserver((entries) => {
  for (const { target, contentRect } of entries) sizes.set(target, [contentRect.width, contentRect.height]);
});

// Width and height of an element without a padding, px. A program that takes pictures waits for no frame: it asks anew.
export function sizeOf(element) {
  if (!sizes.get(element)?.[0] || document.body.classList.contains("directed")) {
    sizes.set(element, [element.clientWidth, element.clientHeight]);
    laid.observe(element);
  }
  return sizes.get(element);
}

// Gives a canvas the pixels of its place on the screen; pixels for one of the page's, 0 where it cannot be seen.
export function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = sizeOf(canvas).map((each) => Math.round(each * ratio));
  if (!width || !height) return 0;
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  return ratio;
}
