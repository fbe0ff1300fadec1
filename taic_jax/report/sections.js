// The page, from top to bottom.

// Colours count the policies of each task, so that those in one chart differ; a flat policy's line is dashed.
function assignColours() {
  const next = {};
  const first = (stage) => (stage.stage === "train" ? 0 : 1);
  for (const run of data.runs) {
    for (const stage of [...run.stages].sort((a, b) => first(a) - first(b))) {
      stage.dashed = !["train", "learn"].includes(stage.stage);
      if (stage.stage !== "learn") stage.colour = next[stage.task] = (next[stage.task] ?? -1) + 1;
    }
    // Learning options is in no chart with training over them.
    for (const stage of run.stages) stage.colour ??= run.stages.find((own) => own.stage === "train")?.colour ?? 0;
  }
}

function heading() {
  const tasks = [...new Set(data.runs.flatMap((run) => run.facts.tasks))];
  const partial = data.runs.filter((run) => !run.facts.finished).length;
  const links = [...document.querySelectorAll("main section")].map((own) => make("a", {
    href: "#" + own.id,
    click: (event) => { // the address holds the view, not the place
      event.preventDefault();
      own.scrollIntoView();
      own.querySelector("h2").focus();
    },
  }, own.querySelector("h2").textContent));
  document.querySelectorAll("h2").forEach((own) => own.setAttribute("tabindex", -1));
  fill(document.getElementById("top"), {}, [
    make("h1", {}, "taic_jax ", make("span", {}, tasks.join(", "))),
    make("p", {}, `${data.runs.length} ${data.runs.length === 1 ? "run" : "runs"}` +
      (partial ? `, ${partial} of them partial` : "") + `; written ${data.made}`),
    data.notes.length ? make("ul", { class: "notes" }, data.notes.map((note) => make("li", {}, note))) : null,
    make("nav", { "aria-label": "Sections" }, links)]);
}

function curveSection() {
  const names = metricNames();
  const metric = choice("metric ", names.map((name) => [name, name]), view.metric, (value) => change({ metric: value, zoom: "" }));
  const axis = choice("interactions ", [["alone", "of the stage alone"], ["all", "pre-training counted in"]], view.x, (value) => change({ x: value, zoom: "" }));
  redraws.push(() => { metric.list.value = view.metric; axis.list.value = view.x; });
  const tasks = [...new Set(data.runs.flatMap((run) => run.stages.map((stage) => stage.task)))];
  return section("curves", "Curves",
    make("p", { class: "lead" }, "Thick lines: interquartile mean over seeds. Bands: its 95 % bootstrap interval. Thin lines: seeds. Dashed: flat policies. " +
      "Drag over a span to zoom; a double click shows the whole range."),
    make("div", { class: "controls" }, metric.node, axis.node, toggle("seeds", "seeds"), toggle("interval", "band"), toggle("logarithmic", "log")),
    make("div", { class: "charts" }, tasks.map(chartOf)));
}

function durationSection() {
  const figures = data.runs.flatMap((run) => run.histograms.map((histogram) => durationFigure(run, histogram)));
  if (!figures.length) return null;
  return section("durations", "Durations of options", make("div", { class: "charts small" }, figures));
}

function durationFigure(run, { label, share, of }) {
  const [width, height, left, bottom] = [320, 190, 52, 36];
  const inner = width - left - 8;
  const tall = height - bottom - 14;
  const step = inner / share.length;
  const most = Math.max(...share);
  const mean = share.reduce((sum, value, i) => sum + value * (i + 1), 0);
  const svg = draw("svg", {
    viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": `Share of options by ticks: ${share.map((value, i) => `${i + 1}: ${number(100 * value, 3)} %`).join(", ")}`,
  });
  for (const value of roundNumbers(0, most, 3)) {
    const y = 14 + (1 - value / most) * tall;
    svg.append(draw("line", { class: "grid", x1: left, x2: width - 8, y1: y, y2: y }),
      draw("text", { class: "tick", x: left - 6, y: y + 4, "text-anchor": "end" }, number(100 * value, 3) + " %"));
  }
  const every = Math.ceil(share.length / 12);
  share.forEach((value, i) => {
    const high = (value / most) * tall;
    svg.append(draw("rect", { class: "bar", x: left + i * step + step * 0.1, y: 14 + tall - high, width: step * 0.8, height: high },
      draw("title", {}, `${i + 1} ticks: ${number(100 * value, 3)} %`)));
    if (i % every === 0) svg.append(draw("text", { class: "tick", x: left + (i + 0.5) * step, y: height - bottom + 14, "text-anchor": "middle" }, String(i + 1)));
  });
  svg.append(draw("text", { class: "label", x: left + inner / 2, y: height - 4, "text-anchor": "middle" }, "ticks an option took"));
  return make("figure", { class: "chart" }, make("figcaption", {}, make("b", {}, run.name), ` ${label}, mean ${number(mean, 3)}`), svg,
    make("p", { class: "fine" }, `All seeds, ${of}.`));
}

function optionSection() {
  const figures = optionFigures();
  const groups = Map.groupBy(data.runs.filter((run) => run.options.missing), (run) => run.options.missing);
  const why = [...groups].map(([reason, runs]) => make("li", {}, `${runs.length > 3 ? `${runs.length} runs` : runs.map((run) => run.name).join(", ")}: ${reason}`));
  return section("options", "Option spaces", make("div", { class: "charts" }, figures),
    why.length ? make("div", { class: "missing" }, make("p", {}, "Not drawn:"), make("ul", {}, why)) : null);
}

// A picture that moves must have a way to stand still; who asked for less motion gets it still.
function videoFigure(run) {
  const image = make("img", { src: run.video, width: 320, height: 240, alt: `Video: the first seed's policy over options in ${run.name}, on ${run.facts.task}` });
  const still = make("canvas", { width: 320, height: 240, role: "img", "aria-label": image.alt + ", its first frame" });
  const button = make("button", { type: "button", click: () => show(still.hidden) });
  const show = (pause) => {
    if (pause) still.getContext("2d").drawImage(image, 0, 0, still.width, still.height);
    [still.hidden, image.hidden] = [!pause, pause];
    button.textContent = pause ? "Play" : "Pause";
  };
  show(false);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) image.addEventListener("load", () => show(true), { once: true });
  return make("figure", { class: "chart video" }, make("figcaption", {}, make("b", {}, run.name), " ", button), image, still);
}

function videoSection() {
  const figures = data.runs.filter((run) => run.video).map(videoFigure);
  return figures.length ? section("videos", "Videos", make("div", { class: "charts small" }, figures)) : null;
}

readAddress();
assignColours();
document.getElementById("main").replaceChildren(...[
  section("results", "Results", make("p", { class: "lead" }, "Returns of the policy as it explores and of its mean options: interquartile mean over seeds (95 % bootstrap interval). Interactions are per seed."), resultTables()),
  curveSection(),
  durationSection(),
  optionSection(),
  data.sweeps.length ? section("sweeps", "Sweeps", sweepFigures()) : null,
  videoSection(),
  section("runs", "What was run", factsTable(), versionsTable()),
  section("configs", "Configs", configTable()),
].filter(Boolean));
heading();
redraw();
window.addEventListener("hashchange", () => { readAddress(); redraw(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
document.body.dataset.ready = "true";
