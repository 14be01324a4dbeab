// Numbers as people read them.

export const SIGMAS = 2.45; // deviations that hold 95 % in a plane; twice the deviation holds 86 %

export const short = (value) => (typeof value !== "number" || !Number.isFinite(value) ? "-" : Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3) ? value.toExponential(1) : String(+value.toPrecision(3)));

// Metres below one are read as centimetres.
export function scaled(unit, most) {
  return unit === "m" && most < 2 ? { unit: "cm", factor: 100 } : { unit, factor: 1 };
}

export const median = (values) => {
  const sorted = [...values].sort((a, b) => a - b), middle = sorted.length >> 1;
  return sorted.length ? (sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2) : NaN;
};

export function clock(t) {
  const seconds = Math.max(0, t), minutes = Math.floor(seconds / 60);
  return `${String(minutes).padStart(2, "0")}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

export const ago = (seconds) => (seconds < 90 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds / 60)} min`);

// Changes a text only where it is another one: a page that is written to is laid out anew.
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
