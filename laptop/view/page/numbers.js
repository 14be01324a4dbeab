// Numbers as people read them.

export const SIGMAS = 2.45; // deviations that hold 95 % in a plane; twice the deviation holds 86 %

export const short = (value) => (typeof value !== "number" || !Number.isFinite(value) ? "-" : Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3) ? value.toExponential(1) : String(+value.toPrecision(3)));

// Writes the numbers of a column with the decimals that its largest one has in three digits, so that they compare at a glance.
// One that would be zero then keeps its own digits.
export function column(values) {
  const known = values.filter(Number.isFinite), most = largest(known.map(Math.abs));
  if (!(most > 0 && most < 1e5) || known.every(Number.isInteger)) return short;
  const digits = Math.min(3, Math.max(0, 2 - Math.floor(Math.log10(most))));
  return (value) => (!Number.isFinite(value) || (value !== 0 && Math.abs(value) < 0.5 * 10 ** -digits) ? short(value) : (value + 0).toFixed(digits));
}

// A spread call takes some hundred thousand arguments at most; a crowd's series hold more.
export const largest = (values) => values.reduce((most, each) => Math.max(most, each), 0);

// Metres below one are read as centimetres.
export function scaled(unit, most) {
  return unit === "m" && most < 2 ? { unit: "cm", factor: 100 } : { unit, factor: 1 };
}

export const some = (names) => (names.length > 4 ? `${names.slice(0, 4).join(" ")} and ${names.length - 4} more` : names.join(" "));

export const counted = (robots) => `${robots} robot${robots === 1 ? "" : "s"}`;

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
