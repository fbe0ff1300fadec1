// Option spaces: codes on their first two principal components, coloured by what they change.

const SPREAD = 0.98; // of |change| is told apart by colour; beyond it, colours stay the same

function optionFigures() {
  return data.runs.filter((run) => !run.options.missing).map((run) => {
    const { options } = run;
    const known = options.r2.map((r2, i) => [r2, i]).filter(([r2]) => r2 !== null).sort((a, b) => b[0] - a[0]);
    if (!known.length) return null;
    const picker = choice("coloured by the change of ",
      known.map(([r2, i]) => [String(i), `coordinate ${i} (R² ${number(r2, 2)})`]), null,
      (value) => change(withSetting("coordinate", run.name, [value])));
    const host = make("div", { class: "plot square" });
    const key = make("div", { class: "key" });
    const readout = make("p", { class: "readout", "aria-live": "polite" });
    onWidth(host, (width) => {
      const asked = Number(setting("coordinate", run.name)?.[0] ?? known[0][1]);
      const coordinate = known.some(([, i]) => i === asked) ? asked : known[0][1];
      picker.list.value = String(coordinate);
      drawScatter(host, Math.min(width, 520), run, coordinate, key, readout);
    });
    return make("figure", { class: "chart scatter", "data-run": run.name },
      make("figcaption", {}, make("b", {}, run.name), " ", picker.node), host, key, readout,
      make("p", { class: "fine" }, sourceOf(options)));
  }).filter(Boolean);
}

function sourceOf(options) {
  const shares = options.shares.map((share) => number(100 * share, 2) + " %");
  const drawn = options.drawn === "windows"
    ? "Codes E gives to windows drawn from what the options were learnt from; the change is the one recorded."
    : `Drawn from the prior (${options.why}); the change is what P predicts from the mean state.`;
  return `First seed's model; ${count(options.x.length)} options of ${options.size} dimensions, of whose variance the two ` +
    `components hold ${shares.join(" and ")}. ${drawn} R² is the share of a change that is linear in the two components.`;
}

// Blue through grey to orange, which eyes of every kind tell apart.
function colourOf(t, dark) {
  const middle = dark ? [88, 96, 108] : [205, 209, 216];
  const end = t < 0 ? (dark ? [86, 170, 255] : [0, 90, 181]) : dark ? [255, 158, 64] : [200, 76, 0];
  const share = Math.min(1, Math.abs(t));
  return `rgb(${middle.map((m, i) => Math.round(m + (end[i] - m) * share)).join(",")})`;
}

function drawScatter(host, width, run, coordinate, key, readout) {
  const { x, y, changes, shares } = run.options;
  const values = changes[coordinate];
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const sizes = values.map(Math.abs).sort((a, b) => a - b);
  const most = sizes[Math.floor((sizes.length - 1) * SPREAD)] || 1;
  const margin = 34;
  const half = Math.max(...x.map(Math.abs), ...y.map(Math.abs)) * 1.04 || 1;
  const inner = width - 2 * margin;
  const toX = (v) => margin + ((v + half) / (2 * half)) * inner;
  const toY = (v) => margin + ((half - v) / (2 * half)) * inner;
  const svg = draw("svg", {
    width, height: width, role: "img",
    "aria-label": `Options of ${run.name} on two principal components, coloured by the change of coordinate ${coordinate}`,
  });
  for (const value of roundNumbers(-half, half, 4)) {
    svg.append(
      draw("line", { class: "grid", x1: toX(value), x2: toX(value), y1: margin, y2: width - margin }),
      draw("line", { class: "grid", x1: margin, x2: width - margin, y1: toY(value), y2: toY(value) }),
      draw("text", { class: "tick", x: toX(value), y: width - margin + 14, "text-anchor": "middle" }, number(value, 2)),
      draw("text", { class: "tick", x: margin - 5, y: toY(value) + 4, "text-anchor": "end" }, number(value, 2)));
  }
  svg.append(
    draw("text", { class: "label", x: width / 2, y: width - 4, "text-anchor": "middle" }, `component 1 (${number(100 * shares[0], 2)} %)`),
    draw("text", { class: "label", transform: `translate(10 ${width / 2}) rotate(-90)`, "text-anchor": "middle" }, `component 2 (${number(100 * shares[1], 2)} %)`));
  const dots = x.map((value, i) => draw("circle", {
    cx: toX(value).toFixed(1), cy: toY(y[i]).toFixed(1), r: 3, fill: colourOf(values[i] / most, dark),
  }));
  svg.append(draw("g", { class: "dots" }, dots));
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const [px, py] = [event.clientX - box.left, event.clientY - box.top];
    let best = 0;
    const distance = (i) => (toX(x[i]) - px) ** 2 + (toY(y[i]) - py) ** 2;
    for (let i = 1; i < x.length; i++) if (distance(i) < distance(best)) best = i;
    dots.forEach((dot, i) => dot.classList.toggle("near", i === best));
    readout.textContent = `change of coordinate ${coordinate}: ${number(values[best])}, at (${number(x[best], 3)}, ${number(y[best], 3)})`;
  });
  readout.textContent = "";
  host.replaceChildren(svg);
  const stops = [-1, -0.5, 0, 0.5, 1].map((t) => colourOf(t, dark)).join(",");
  key.replaceChildren(
    make("span", {}, `≤ ${number(-most, 3)}`),
    make("span", { class: "bar", style: `background:linear-gradient(90deg,${stops})` }),
    make("span", {}, `≥ ${number(most, 3)}`));
}
