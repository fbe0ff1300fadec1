// Option spaces: codes on their first two principal components, coloured by the change they cause.

const SPREAD = 0.98; // quantile of |change| beyond which colours stay the same

function optionSection() {
  const reasons = Map.groupBy(data.runs.filter((run) => run.options.missing), (run) => run.options.missing);
  const missing = [...reasons].map(([reason, runs]) => `${runs.length > 3 ? `${runs.length} runs` : runs.map((run) => run.name).join(", ")}: ${reason}`);
  return section("options", "Option spaces", make("div", { class: "charts" }, data.runs.filter((run) => !run.options.missing).map(optionFigure)),
    missing.length > 0 && make("div", { class: "fine" }, make("p", {}, "Not drawn:"), list(missing)));
}

function optionFigure(run) {
  const { options, name } = run;
  const order = options.r2.map((r2, i) => [r2, i]).filter(([r2]) => r2 !== null).sort((a, b) => b[0] - a[0]);
  if (!order.length) return null;
  const coordinate = () => {
    const index = Number(settings("coordinate").get(name)?.[0]);
    return order.some(([, i]) => i === index) ? index : order[0][1];
  };
  const picker = choice("coloured by the change of ", order.map(([r2, i]) => [i, `coordinate ${i} (R² ${number(r2, 2)})`]),
    coordinate, (value) => changeSetting("coordinate", name, [value]));
  const host = make("div", { class: "plot square" });
  const key = make("div", { class: "key" });
  const value = readout();
  onWidth(host, (width) => drawScatter(host, Math.min(width, 520), run, coordinate(), key, value));
  const source = options.drawn === "windows"
    ? "Codes E gives to windows drawn from what the options were learnt from; the change is the one recorded."
    : `Drawn from the prior (${options.why}); the change is what P predicts from the mean state.`;
  return figure([make("b", {}, name), " ", picker], { "data-run": name }, host, key, value,
    make("p", { class: "fine" }, `First seed's model; ${count(options.x.length)} options of ${options.size} dimensions, of whose variance the two ` +
      `components hold ${options.shares.map((share) => percent(share, 2)).join(" and ")}. ${source} R² is the share of a change that is linear in the two components.`));
}

// Blue through grey to orange, for eyes of every kind.
function colourOf(t, dark) {
  const middle = dark ? [88, 96, 108] : [205, 209, 216];
  const end = t < 0 ? (dark ? [86, 170, 255] : [0, 90, 181]) : dark ? [255, 158, 64] : [200, 76, 0];
  const share = Math.min(1, Math.abs(t));
  return `rgb(${middle.map((m, i) => Math.round(m + (end[i] - m) * share)).join(",")})`;
}

function drawScatter(host, width, { name, options: { x, y, changes, shares } }, coordinate, key, value) {
  const values = changes[coordinate];
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const sizes = values.map(Math.abs).sort((a, b) => a - b);
  const most = sizes[Math.floor((sizes.length - 1) * SPREAD)] || 1;
  const half = Math.max(...x.map(Math.abs), ...y.map(Math.abs)) * 1.04 || 1;
  const frame = frameOf(width, width, [-half, half], [-half, half], false, { left: 48, right: 16, top: 16, bottom: 48 });
  const marks = ticks(frame.x, 4, (own) => number(own, 2));
  const dots = x.map((own, i) => draw("circle", {
    cx: frame.toX(own).toFixed(1), cy: frame.toY(y[i]).toFixed(1), r: 3, fill: colourOf(values[i] / most, dark),
  }));
  host.replaceChildren(draw("svg", {
    width, height: width, role: "img", "aria-label": `Options of ${name} on two principal components, coloured by the change of coordinate ${coordinate}`,
    pointermove: ({ clientX, clientY }) => {
      const box = host.firstChild.getBoundingClientRect();
      const best = nearest(x.length, (i) => Math.hypot(frame.toX(x[i]) - clientX + box.left, frame.toY(y[i]) - clientY + box.top));
      dots.forEach((dot, i) => dot.classList.toggle("near", i === best));
      value.textContent = `change of coordinate ${coordinate}: ${number(values[best])}, at (${number(x[best], 3)}, ${number(y[best], 3)})`;
    },
  }, axes(frame, marks, marks, `component 1 (${percent(shares[0], 2)})`, `component 2 (${percent(shares[1], 2)})`), draw("g", { class: "dots" }, dots)));
  value.textContent = "";
  const colours = [-1, -0.5, 0, 0.5, 1].map((t) => colourOf(t, dark)).join(",");
  key.replaceChildren(`≤ ${number(-most, 3)}`, make("span", { class: "bar", style: `background:linear-gradient(90deg,${colours})` }), `≥ ${number(most, 3)}`);
}
