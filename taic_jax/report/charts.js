// Curves over interactions: seeds, interquartile mean and interval; zoom and readout by pointer, touch and keyboard.

const MARGIN = { left: 58, right: 14, top: 10, bottom: 42 };

// The series of one task: every run and stage that has the metric in view.
function seriesOf(task) {
  const found = [];
  data.runs.forEach((run, i) => run.stages.forEach((stage) => {
    if (stage.task !== task) return;
    const curve = stage.metrics[view.metric];
    const key = `${i}.${stage.stage}`;
    const index = found.length;
    const shift = view.x === "all" ? stage.pretraining : 0;
    if (curve) found.push({
      key, run, stage, curve, colour: `var(--c${stage.colour % COLOURS})`, index,
      name: (data.runs.length > 1 ? run.name + " · " : "") + stage.label,
      x: stage.x.map((x) => x + shift), hidden: view.hide.split(",").includes(key),
    });
  }));
  return found;
}

function metricNames(task) {
  const names = new Set();
  for (const run of data.runs) for (const stage of run.stages) {
    if (!task || stage.task === task) Object.keys(stage.metrics).forEach((name) => names.add(name));
  }
  return [...names].sort((a, b) => (a !== "return") - (b !== "return") || a.localeCompare(b));
}

function chartOf(task) {
  const host = make("div", { class: "plot" });
  const legend = make("ul", { class: "legend" });
  const readout = make("p", { class: "readout", "aria-live": "polite" });
  const note = make("p", { class: "fine" });
  const reset = make("button", { type: "button", click: () => change(withSetting("zoom", task, null)) }, "Whole range");
  const figure = make("figure", { class: "chart", "data-task": task },
    make("figcaption", {}, make("b", {}, task), " ", reset), host, readout, legend, note);
  onWidth(host, (width) => drawChart(task, host, width, { legend, readout, note, reset, figure }));
  return figure;
}

function drawChart(task, host, width, parts) {
  const all = seriesOf(task);
  parts.figure.dataset.series = all.length;
  drawLegend(all, parts.legend);
  host.replaceChildren();
  parts.readout.textContent = "";
  parts.note.textContent = noteOf(all);
  const zoomed = setting("zoom", task);
  parts.reset.hidden = !zoomed;
  const shown = all.filter((series) => !series.hidden);
  if (!shown.length) {
    const why = all.length ? "every curve is switched off" : `no stage on ${task} has ${view.metric}`;
    host.append(make("p", { class: "empty" }, why));
    return;
  }
  const frame = frameOf(shown, width, zoomed);
  const svg = draw("svg", {
    width, height: frame.height, tabindex: 0, role: "img",
    "aria-label": `${view.metric} on ${task}: ${shown.map((s) => s.name).join(", ")}. ` +
      "Arrow keys read values, plus and minus zoom, 0 shows the whole range.",
  });
  const clip = "clip-" + task.replace(/\W/g, "-");
  svg.append(draw("clipPath", { id: clip },
    draw("rect", { x: MARGIN.left, y: MARGIN.top, width: frame.inner, height: frame.tall })));
  drawAxes(svg, frame, shown);
  const marks = draw("g", { "clip-path": `url(#${clip})` });
  for (const series of shown) drawSeries(marks, series, frame);
  svg.append(marks);
  host.append(svg);
  interact(svg, task, shown, frame, parts.readout);
}

function noteOf(all) {
  const thinned = all.filter((s) => s.stage.x.length < s.stage.iterations);
  const unknown = view.x === "all" ? all.filter((s) => s.stage.uncounted.length) : [];
  const notes = [];
  if (thinned.length) {
    const most = thinned.reduce((a, b) => (a.stage.iterations > b.stage.iterations ? a : b)).stage;
    notes.push(`Decimated: of up to ${count(most.iterations)} iterations, ${count(most.x.length)} evenly spaced ones are drawn, as they were.`);
  }
  const least = extent(all.flatMap((s) => s.curve.seeds.flat()));
  if (view.log === "on" && least && least[0] <= 0) notes.push(least[1] > 0
    ? "A logarithmic axis has no place for values up to 0: they are left out." : "Nothing is above 0: the axis is not logarithmic.");
  for (const s of unknown) notes.push(`${s.name}: pre-training in ${s.stage.uncounted.join(", ")} is not known, and not counted in.`);
  if (all.length && all.every((s) => s.curve.seeds.length === 1)) notes.push("One seed: there is no interval.");
  return notes.join(" ");
}

function frameOf(shown, width, zoomed) {
  const height = Math.max(240, Math.min(420, Math.round(width * 0.55)));
  const whole = extent(shown.flatMap((s) => [s.x[0], s.x[s.x.length - 1]]));
  if (view.x === "all" || whole[0] < 0.2 * whole[1]) whole[0] = 0;
  const asked = (zoomed || []).map(Number);
  const x = asked.length === 2 && asked.every(Number.isFinite) && asked[0] < asked[1] ? asked : whole;
  const values = [];
  for (const s of shown) {
    const curves = [s.curve.iqm];
    if (view.seeds === "on") curves.push(...s.curve.seeds);
    if (view.band === "on") curves.push(s.curve.low, s.curve.high);
    for (const curve of curves) curve.forEach((value, i) => {
      if (value !== null && s.x[i] >= x[0] && s.x[i] <= x[1]) values.push(value);
    });
  }
  const positive = values.filter((value) => value > 0);
  const log = view.log === "on" && positive.length > 0;
  let y = extent(log ? positive : values) || [0, 1];
  const scale = log ? Math.log10 : (value) => value;
  y = y.map(scale);
  const pad = (y[1] - y[0]) * 0.05 || Math.abs(y[0]) * 0.1 || 1;
  y = [y[0] - pad, y[1] + pad];
  const inner = width - MARGIN.left - MARGIN.right;
  const tall = height - MARGIN.top - MARGIN.bottom;
  return {
    width, height, inner, tall, x, y, whole, log,
    toX: (value) => MARGIN.left + ((value - x[0]) / (x[1] - x[0] || 1)) * inner,
    fromX: (pixel) => x[0] + ((pixel - MARGIN.left) / inner) * (x[1] - x[0]),
    toY: (value) => MARGIN.top + (1 - (scale(value) - y[0]) / (y[1] - y[0])) * tall,
  };
}

function drawAxes(svg, frame, shown) {
  const bottom = MARGIN.top + frame.tall;
  const values = frame.log
    ? roundNumbers(Math.ceil(frame.y[0]), Math.floor(frame.y[1]), 4).filter(Number.isInteger).map((power) => 10 ** power)
    : roundNumbers(...frame.y);
  for (const value of values) {
    const y = frame.toY(value);
    svg.append(draw("line", { class: "grid", x1: MARGIN.left, x2: MARGIN.left + frame.inner, y1: y, y2: y }),
      draw("text", { class: "tick", x: MARGIN.left - 8, y: y + 4, "text-anchor": "end" }, number(value, 3)));
  }
  for (const value of roundNumbers(...frame.x, frame.width < 500 ? 3 : 6)) {
    const x = frame.toX(value);
    svg.append(draw("line", { class: "axis", x1: x, x2: x, y1: bottom, y2: bottom + 4 }),
      draw("text", { class: "tick", x, y: bottom + 18, "text-anchor": "middle" }, short(value)));
  }
  const steps = shown.every((s) => s.stage.unit === "steps");
  const label = steps ? "gradient steps"
    : "interactions per seed" + (view.x === "all" ? ", pre-training counted in" : ", of the stage alone");
  svg.append(draw("line", { class: "axis", x1: MARGIN.left, x2: MARGIN.left + frame.inner, y1: bottom, y2: bottom }),
    draw("text", { class: "label", x: MARGIN.left + frame.inner / 2, y: frame.height - 6, "text-anchor": "middle" }, label));
}

function drawable(value, frame) {
  return value !== null && (!frame.log || value > 0);
}

// An M where a gap ends, so that what is missing is not bridged.
function path(xs, ys, frame) {
  let text = "";
  let open = false;
  ys.forEach((y, i) => {
    if (!drawable(y, frame)) { open = false; return; }
    text += `${open ? "L" : "M"}${frame.toX(xs[i]).toFixed(1)} ${frame.toY(y).toFixed(1)}`;
    open = true;
  });
  return text;
}

function band(series, frame) {
  const { low, high } = series.curve;
  let text = "";
  let start = 0;
  while (start < low.length) {
    if (!drawable(low[start], frame)) { start++; continue; }
    let end = start;
    while (end + 1 < low.length && drawable(low[end + 1], frame)) end++;
    const at = Array.from({ length: end - start + 1 }, (_, i) => start + i);
    const point = (i, y) => `${frame.toX(series.x[i]).toFixed(1)} ${frame.toY(y).toFixed(1)}`;
    text += "M" + at.map((i) => point(i, high[i])).join("L") + "L" + at.reverse().map((i) => point(i, low[i])).join("L") + "Z";
    start = end + 1;
  }
  return text;
}

function drawSeries(marks, series, frame) {
  const style = `--own:${series.colour}`;
  if (view.band === "on") marks.append(draw("path", { class: "band", d: band(series, frame), style }));
  if (view.seeds === "on" && series.curve.seeds.length > 1) {
    for (const seed of series.curve.seeds) marks.append(draw("path", { class: "seed", d: path(series.x, seed, frame), style }));
  }
  marks.append(draw("path", { class: series.stage.dashed ? "mean dashed" : "mean", d: path(series.x, series.curve.iqm, frame), style }));
}

function drawLegend(all, legend) {
  legend.replaceChildren(...all.map((series) => {
    const last = series.curve.iqm.findLast((value) => value !== null);
    const button = make("button", {
      type: "button", class: "chip", "aria-pressed": String(!series.hidden), style: `--own:${series.colour}`,
      click: () => {
        const hidden = view.hide.split(",").filter(Boolean);
        const others = hidden.filter((key) => key !== series.key);
        change({ hide: (series.hidden ? others : [...others, series.key]).join(",") });
      },
    }, swatch(series.stage.dashed), series.name, make("span", { class: "fine" }, number(last)));
    return make("li", {}, button);
  }));
}

function swatch(dashed) {
  return draw("svg", { width: 26, height: 10, "aria-hidden": "true", class: "swatch" },
    draw("line", { class: dashed ? "mean dashed" : "mean", x1: 1, x2: 25, y1: 5, y2: 5 }));
}

// The iteration of a series that is nearest to x.
function nearest(xs, x) {
  let best = 0;
  for (let i = 1; i < xs.length; i++) if (Math.abs(xs[i] - x) < Math.abs(xs[best] - x)) best = i;
  return best;
}

function interact(svg, task, shown, frame, readout) {
  const cross = draw("g", { class: "cross", visibility: "hidden" });
  const chosen = draw("rect", { class: "chosen", y: MARGIN.top, height: frame.tall, width: 0 });
  svg.append(chosen, cross);
  const steps = [...new Set(shown.flatMap((s) => s.x))].filter((x) => x >= frame.x[0] && x <= frame.x[1]).sort((a, b) => a - b);
  let at = -1;
  let from = null;
  const point = (index) => {
    at = Math.max(0, Math.min(steps.length - 1, index));
    const x = frame.toX(steps[at]);
    cross.replaceChildren(draw("line", { x1: x, x2: x, y1: MARGIN.top, y2: MARGIN.top + frame.tall }));
    cross.setAttribute("visibility", "visible");
    const told = [];
    for (const series of shown) {
      if (steps[at] < series.x[0] || steps[at] > series.x[series.x.length - 1]) continue;
      const i = nearest(series.x, steps[at]);
      const { iqm, low, high } = series.curve;
      if (drawable(iqm[i], frame)) cross.append(draw("circle", {
        cx: frame.toX(series.x[i]), cy: frame.toY(iqm[i]), r: 4, style: `--own:${series.colour}`,
      }));
      const value = interval({ iqm: iqm[i], ci95: [low[i], high[i]] });
      told.push(make("span", { class: "value", style: `--own:${series.colour}` }, swatch(series.stage.dashed), `${series.name} ${value}`));
    }
    readout.replaceChildren(make("b", {}, `${count(steps[at])}: `), ...told);
  };
  const position = (event) => event.clientX - svg.getBoundingClientRect().left;
  const zoom = (low, high) => {
    const [first, last] = frame.whole;
    low = Math.max(low, first); high = Math.min(high, last);
    const whole = low <= first && high >= last;
    if (high > low) change(withSetting("zoom", task, whole ? null : [low.toPrecision(6) * 1, high.toPrecision(6) * 1]));
  };
  svg.addEventListener("pointermove", (event) => {
    point(nearest(steps, frame.fromX(position(event))));
    if (from === null) return;
    const ends = [from, position(event)].sort((a, b) => a - b);
    chosen.setAttribute("x", ends[0]);
    chosen.setAttribute("width", ends[1] - ends[0]);
  });
  svg.addEventListener("pointerdown", (event) => {
    from = position(event);
    point(nearest(steps, frame.fromX(from)));
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointerup", (event) => {
    const ends = [from, position(event)].sort((a, b) => a - b);
    from = null;
    chosen.setAttribute("width", 0);
    if (ends[1] - ends[0] > 12) zoom(frame.fromX(ends[0]), frame.fromX(ends[1]));
  });
  svg.addEventListener("pointercancel", () => { from = null; chosen.setAttribute("width", 0); });
  svg.addEventListener("pointerleave", () => { if (from === null) cross.setAttribute("visibility", "hidden"); });
  svg.addEventListener("dblclick", () => change(withSetting("zoom", task, null)));
  svg.addEventListener("keydown", (event) => {
    const middle = at < 0 ? (frame.x[0] + frame.x[1]) / 2 : steps[at];
    const half = (frame.x[1] - frame.x[0]) / 2;
    const actions = {
      ArrowLeft: () => point(at < 0 ? steps.length - 1 : at - 1), ArrowRight: () => point(at + 1),
      Home: () => point(0), End: () => point(steps.length - 1),
      "+": () => zoom(middle - half / 2, middle + half / 2), "=": () => zoom(middle - half / 2, middle + half / 2),
      "-": () => zoom(middle - half * 2, middle + half * 2), 0: () => change(withSetting("zoom", task, null)),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
    // Zooming draws the figure anew: keep the keyboard where it was.
    document.querySelector(`figure[data-task="${CSS.escape(task)}"] svg[tabindex]`)?.focus();
  });
}
