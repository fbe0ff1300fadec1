// Curves over interactions: seeds, interquartile mean and interval; zoom and readout by pointer, touch and keyboard.

function curveSection() {
  const stages = data.runs.flatMap((run) => run.stages);
  const names = unique(stages.flatMap((stage) => Object.keys(stage.metrics)));
  names.sort((a, b) => (a !== "return") - (b !== "return") || a.localeCompare(b));
  return section("curves", "Curves",
    make("p", { class: "lead" }, "Thick lines: interquartile mean over seeds. Bands: its 95 % bootstrap interval. Thin lines: seeds. Dashed: flat policies. " +
      "Drag over a span to zoom; a double click shows the whole range."),
    make("div", { class: "controls" },
      choice("metric ", names.map((name) => [name, name]), () => view.metric, (metric) => change({ metric, zoom: "" })),
      choice("interactions ", [["alone", "of the stage alone"], ["all", "pre-training counted in"]], () => view.x, (x) => change({ x, zoom: "" })),
      toggle("seeds", "seeds"), toggle("interval", "band"), toggle("logarithmic", "log")),
    make("div", { class: "charts" }, unique(stages.map((stage) => stage.task)).map(curveFigure)));
}

// The series of one task: every run and stage that has the metric in view.
function seriesOf(task) {
  return data.runs.flatMap((run, i) => run.stages.filter((stage) => stage.task === task && stage.metrics[view.metric]).map((stage) => {
    const key = `${i}.${stage.stage}`;
    const shift = view.x === "all" ? stage.pretraining : 0;
    return {
      key, stage, ...stage.metrics[view.metric], x: stage.x.map((x) => x + shift), hidden: view.hide.split(",").includes(key),
      name: (data.runs.length > 1 ? run.name + " · " : "") + stage.label,
    };
  }));
}

function curveFigure(task) {
  const legend = make("ul", { class: "legend" });
  const values = readout();
  const note = make("p", { class: "fine" });
  const empty = make("p", { class: "empty" });
  const reset = make("button", { type: "button", click: () => changeSetting("zoom", task, null) }, "Whole range");
  const chart = curveChart(task, values);
  const host = make("div", { class: "plot" }, chart.svg, empty);
  onWidth(host, (width) => {
    const all = seriesOf(task);
    const shown = all.filter((series) => !series.hidden);
    legend.replaceChildren(...all.map(legendItem));
    note.textContent = noteOf(all);
    values.replaceChildren();
    reset.hidden = !settings("zoom").has(task);
    empty.textContent = shown.length ? "" : all.length ? "every curve is switched off" : `no stage on ${task} has ${view.metric}`;
    empty.hidden = shown.length > 0;
    chart.svg.toggleAttribute("hidden", !shown.length);
    if (shown.length) chart.show(shown, curveFrame(shown, width, settings("zoom").get(task)));
  });
  return figure([make("b", {}, task), " ", reset], { "data-task": task }, host, values, legend, note);
}

function legendItem({ key, stage, iqm, hidden, name }) {
  const others = view.hide.split(",").filter((own) => own && own !== key);
  return make("li", {}, make("button", {
    type: "button", class: "chip", "aria-pressed": String(!hidden),
    click: () => change({ hide: (hidden ? others : [...others, key]).join(",") }),
  }, swatch(stage), name, make("span", { class: "fine" }, number(iqm.findLast((value) => value !== null)))));
}

function noteOf(all) {
  const notes = [];
  const thinned = all.map((s) => s.stage).filter((stage) => stage.x.length < stage.iterations).sort((a, b) => b.iterations - a.iterations);
  if (thinned.length) {
    notes.push(`Decimated: of up to ${count(thinned[0].iterations)} iterations, ${count(thinned[0].x.length)} evenly spaced ones are drawn, as they were.`);
  }
  const range = extent(all.flatMap((s) => s.seeds.flat()));
  if (view.log === "on" && range && range[0] <= 0) notes.push(range[1] > 0
    ? "A logarithmic axis has no place for values up to 0: they are left out." : "Nothing is above 0: the axis is not logarithmic.");
  const uncounted = all.filter(({ stage }) => view.x === "all" && stage.uncounted.length);
  notes.push(...uncounted.map(({ name, stage }) => `${name}: pre-training in ${stage.uncounted.join(", ")} is not known, and not counted in.`));
  if (all.length && all.every((s) => s.seeds.length === 1)) notes.push("One seed: there is no interval.");
  return notes.join(" ");
}

function curveFrame(shown, width, zoomed) {
  const whole = extent(shown.flatMap((s) => [s.x[0], s.x.at(-1)]));
  if (view.x === "all" || whole[0] < 0.2 * whole[1]) whole[0] = 0;
  const [low, high] = (zoomed ?? []).map(Number);
  const x = low < high && Number.isFinite(high - low) ? [low, high] : whole;
  const values = shown.flatMap((s) => [s.iqm, ...(view.seeds === "on" ? s.seeds : []), ...(view.band === "on" ? [s.low, s.high] : [])]
    .flatMap((curve) => curve.filter((value, i) => value !== null && s.x[i] >= x[0] && s.x[i] <= x[1])));
  const positive = values.filter((value) => value > 0);
  const log = view.log === "on" && positive.length > 0;
  const y = log ? extent(positive).map(Math.log10) : extent(values) ?? [0, 1];
  const pad = (y[1] - y[0]) * 0.05 || Math.abs(y[0]) * 0.1 || 1;
  const height = Math.max(240, Math.min(420, Math.round(width * 0.55)));
  return { ...frameOf(width, height, x, [y[0] - pad, y[1] + pad], log), whole };
}

function curveAxes(shown, frame) {
  const label = shown.every((s) => s.stage.unit === "steps") ? "gradient steps"
    : "interactions per seed" + (view.x === "all" ? ", pre-training counted in" : ", of the stage alone");
  const y = frame.log
    ? ticks(frame.y, 4, Number).filter(([power]) => Number.isInteger(power)).map(([power]) => [10 ** power, number(10 ** power, 3)])
    : ticks(frame.y, 5, (value) => number(value, 3));
  return axes(frame, ticks(frame.x, frame.width < 500 ? 3 : 6, short), y, label);
}

const drawable = (value, frame) => value !== null && (!frame.log || value > 0);

// A path along the values, or around the area between them and others; missing values leave gaps.
function path(x, values, frame, others) {
  const stretches = [];
  values.forEach((value, i) => {
    if (!drawable(value, frame)) return;
    if (i > 0 && drawable(values[i - 1], frame)) stretches.at(-1).push(i);
    else stretches.push([i]);
  });
  const points = (indices, y) => indices.map((i) => `${frame.toX(x[i]).toFixed(1)} ${frame.toY(y[i]).toFixed(1)}`);
  return stretches.map((indices) => {
    const back = others ? points(indices.toReversed(), others) : [];
    return "M" + [...points(indices, values), ...back].join("L") + (others ? "Z" : "");
  }).join("");
}

function curvePaths({ x, iqm, low, high, seeds, stage }, frame) {
  const line = (kind, d) => draw("path", { class: kind, d, style: `--own:${stage.colour}` });
  return [
    view.band === "on" && line("band", path(x, low, frame, high)),
    view.seeds === "on" && seeds.length > 1 && seeds.map((seed) => line("seed", path(x, seed, frame))),
    line(stage.dashed ? "mean dashed" : "mean", path(x, iqm, frame))];
}

// The values of the curves at x: marks in the chart, and a text.
function showReading(x, shown, frame, cross, values) {
  const near = shown.filter((s) => x >= s.x[0] && x <= s.x.at(-1)).map((s) => ({ ...s, i: nearest(s.x.length, (i) => Math.abs(s.x[i] - x)) }));
  const dots = near.filter((s) => drawable(s.iqm[s.i], frame)).map((s) => draw("circle", {
    cx: frame.toX(s.x[s.i]), cy: frame.toY(s.iqm[s.i]), r: 4, style: `--own:${s.stage.colour}`,
  }));
  cross.replaceChildren(draw("line", { x1: frame.toX(x), x2: frame.toX(x), y1: frame.top, y2: frame.bottom }), ...dots);
  values.replaceChildren(make("b", {}, `${count(x)}: `), ...near.map(({ stage, name, iqm, low, high, i }) =>
    make("span", { class: "value" }, swatch(stage), `${name} ${number(iqm[i])}`, low[i] !== null && ` (${bounds([low[i], high[i]])})`)));
}

// A chart that draws series on a frame, with readout and zoom; it keeps the keyboard's focus when drawn anew.
function curveChart(task, values) {
  let shown, frame, steps, at, from;
  const cross = draw("g", { class: "cross" });
  const chosen = draw("rect", { class: "chosen", y: MARGIN.top, width: 0 });
  const read = (index) => {
    if (!steps.length) return;
    at = Math.max(0, Math.min(steps.length - 1, index));
    showReading(steps[at], shown, frame, cross, values);
  };
  const whole = () => changeSetting("zoom", task, null);
  const zoom = (low, high) => {
    const [first, last] = frame.whole;
    const ends = [Math.max(low, first), Math.min(high, last)];
    if (low <= first && high >= last) whole();
    else if (ends[0] < ends[1]) changeSetting("zoom", task, ends.map((x) => Number(x.toPrecision(6))));
  };
  const scale = (factor) => { // the span, around the reading
    const middle = at < 0 ? (frame.x[0] + frame.x[1]) / 2 : steps[at];
    const half = factor * (frame.x[1] - frame.x[0]) / 2;
    zoom(middle - half, middle + half);
  };
  const keys = {
    ArrowLeft: () => read(at < 0 ? steps.length - 1 : at - 1), ArrowRight: () => read(at + 1), Home: () => read(0), End: () => read(steps.length - 1),
    "+": () => scale(0.5), "=": () => scale(0.5), "-": () => scale(2), 0: whole,
  };
  const pixel = (event) => event.clientX - svg.getBoundingClientRect().left;
  const drag = (event) => {
    read(nearest(steps.length, (i) => Math.abs(steps[i] - frame.fromX(pixel(event)))));
    const [low, high] = [from ?? pixel(event), pixel(event)].sort((a, b) => a - b);
    fill(chosen, { x: low, width: high - low }, []);
    return [low, high];
  };
  const release = () => { from = null; chosen.setAttribute("width", 0); };
  const svg = draw("svg", {
    width: 0, height: 0, tabindex: 0, role: "img", pointermove: drag, pointercancel: release, dblclick: whole,
    pointerdown: (event) => { from = pixel(event); drag(event); svg.setPointerCapture(event.pointerId); },
    pointerup: (event) => { const [low, high] = drag(event); release(); if (high - low > 12) zoom(frame.fromX(low), frame.fromX(high)); },
    pointerleave: () => { if (from === null) cross.replaceChildren(); },
    keydown: (event) => { if (keys[event.key]) { event.preventDefault(); keys[event.key](); } },
  });
  const show = (series, on) => {
    [shown, frame, at, from] = [series, on, -1, null];
    steps = unique(shown.flatMap((s) => s.x)).filter((x) => x >= frame.x[0] && x <= frame.x[1]).sort((a, b) => a - b);
    const clip = "clip-" + task.replace(/\W/g, "-");
    const label = `${view.metric} on ${task}: ${shown.map((s) => s.name).join(", ")}. Arrow keys read values, plus and minus zoom, 0 shows the whole range.`;
    cross.replaceChildren();
    svg.replaceChildren();
    fill(chosen, { width: 0, height: frame.tall }, []);
    fill(svg, { width: frame.width, height: frame.height, "aria-label": label }, [
      draw("clipPath", { id: clip }, draw("rect", { x: frame.left, y: frame.top, width: frame.inner, height: frame.tall })),
      curveAxes(shown, frame), draw("g", { "clip-path": `url(#${clip})` }, shown.map((series) => curvePaths(series, frame))), chosen, cross]);
  };
  return { svg, show };
}
