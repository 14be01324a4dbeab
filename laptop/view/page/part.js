// The page is drawn in parts, so that an error in one of them leaves the others as they should be.

const KEPT = 20; // different errors that are written to the browser's console

const told = new Set();

// Draws one part. An error ends this part only: a person can still read the others, and press stop.
export function part(draw) {
  try {
    draw();
  } catch (error) {
    if (told.size >= KEPT || told.has(error.message)) return;
    told.add(error.message);
    console.error(error);
  }
}
