// Parts of charts: a frame that maps values to pixels, its grid, ticks and labels, and the readout.

const MARGIN = { left: 58, right: 20, top: 10, bottom: 42 };

// The ranges [low, high] of x and y on a number of pixels; with `log`, y is of logarithms.
function frameOf(width, height, x, y, log = false, margin = MARGIN) {
  const [inner, tall] = [width - margin.left - margin.right, height - margin.top - margin.bottom];
  return {
    width, height, inner, tall, x, y, log, left: margin.left, right: margin.left + inner, top: margin.top, bottom: margin.top + tall,
    toX: (value) => margin.left + ((value - x[0]) / (x[1] - x[0] || 1)) * inner,
    fromX: (pixel) => x[0] + ((pixel - margin.left) / inner) * (x[1] - x[0]),
    toY: (value) => margin.top + (1 - ((log ? Math.log10(value) : value) - y[0]) / (y[1] - y[0] || 1)) * tall,
  };
}

// Grid, ticks and labels; `x` and `y` are the ticks, [value, text] each.
function axes({ width, height, inner, left, right, top, bottom, toX, toY }, x, y, xLabel, yLabel) {
  const rows = y.map(([value, text]) => [
    draw("line", { class: "grid", x1: left, x2: right, y1: toY(value), y2: toY(value) }),
    draw("text", { class: "tick", x: left - 8, y: toY(value) + 4, "text-anchor": "end" }, text)]);
  const columns = x.map(([value, text]) => [
    draw("line", { class: yLabel ? "grid" : "axis", x1: toX(value), x2: toX(value), y1: yLabel ? top : bottom, y2: bottom + 4 }),
    draw("text", { class: "tick", x: toX(value), y: bottom + 18, "text-anchor": "middle" }, text)]);
  return [rows, columns,
    draw("line", { class: "axis", x1: left, x2: right, y1: bottom, y2: bottom }),
    draw("text", { class: "label", x: left + inner / 2, y: height - 6, "text-anchor": "middle" }, xLabel),
    yLabel && draw("text", { class: "label", transform: `translate(12 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, yLabel)];
}

// About `amount` round numbers within [low, high], each with its text.
function ticks([low, high], amount, text) {
  const raw = (high - low) / amount || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const values = Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, i) => (first + i) * step);
  return values.map((value) => [value, text(value)]);
}

// The index below `length` with the least distance.
function nearest(length, distance) {
  let best = 0;
  for (let i = 1; i < length; i++) if (distance(i) < distance(best)) best = i;
  return best;
}

const figure = (title, attributes, ...children) =>
  make("figure", { class: "chart", ...attributes }, make("figcaption", {}, title), children);

const readout = () => make("p", { class: "readout", "aria-live": "polite" });

const swatch = ({ dashed, colour }) =>
  draw("svg", { width: 26, height: 10, "aria-hidden": "true", class: "swatch", style: `--own:${colour}` },
    draw("line", { class: dashed ? "mean dashed" : "mean", x1: 1, x2: 25, y1: 5, y2: 5 }));
