// Parts of the page that are drawn each by itself.

const KEPT = 20; // different errors that are told to who develops the page

const told = new Set();

// Whatever keeps one part from being drawn, the others are: a person can read them, and press stop.
export function part(draw) {
  try {
    draw();
  } catch (error) {
    if (told.size >= KEPT || told.has(error.message)) return;
    told.add(error.message);
    console.error(error);
  }
}
